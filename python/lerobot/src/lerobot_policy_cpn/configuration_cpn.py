"""Configuration of the policy, under the name `cpn`."""

from dataclasses import dataclass, field
from typing import NoReturn

from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import OBS_IMAGES

UNTRAINABLE = "policy cpn: its models are trained by cpn-trainer and served by cpn-planner; here it has no weights"


@PreTrainedConfig.register_subclass("cpn")
@dataclass
class CpnConfig(PreTrainedConfig):
    """Configuration of a policy that asks a planner for each action."""

    address: str = ""
    """Address of the planner: a zenoh endpoint, `grpc://HOST:PORT` or `grpcs://HOST:PORT`; by default `CPN_CONNECT`.

    Certificates, a token and the rest of the connection are never part of a configuration, which is saved with datasets
    and results: they come from environment variables, see `cpn_client.connect_from_environment`."""
    model: str = "cpn"
    """Name of the planner's model."""
    goal: str = ""
    """Image file of the finished task, for tasks without one in `goals`; if empty, the goal is observed."""
    goals: dict[str, str] = field(default_factory=dict)
    """Image file of the finished task, by the task's description as the environment gives it."""
    updates: int | None = None
    """Number of updates of a plan; the model's own if None."""
    approaches: bool = True
    """Whether a model of position dynamics tries the sides of the goal in turn where the hand stalls; false for an arm
    that must rest at the goal, since the planner is not told of success."""
    seed: int = 0
    """Seed of the first plan of an episode; each step adds one."""
    image_key: str | None = None
    """Key of the camera image among the observations; if None, that of the only image beside the goal."""
    goal_key: str = f"{OBS_IMAGES}.goal"
    """Key of the goal image among the observations, for tasks without an image file."""
    # A request is made of pixels on the host.
    device: str | None = "cpu"

    @property
    def observation_delta_indices(self) -> None:
        """None, since a plan depends on the present observation alone."""
        return

    @property
    def action_delta_indices(self) -> None:
        """None, since the policy is not trained here."""
        return

    @property
    def reward_delta_indices(self) -> None:
        """None, since the policy is not trained here."""
        return

    def get_optimizer_preset(self) -> NoReturn:
        """Raises `NotImplementedError`, as `CpnPolicy.forward`."""
        raise NotImplementedError(UNTRAINABLE)

    def get_scheduler_preset(self) -> None:
        """None, since the policy is not trained here."""
        return

    @property
    def camera_key(self) -> str:
        """Key of the camera image among the input features.

        Raises:
            ValueError: If `image_key` is not among the input features, or is None and there is not exactly one choice.
        """
        keys = [key for key in self.image_features if key != self.goal_key]
        if self.image_key is None and len(keys) == 1:
            return keys[0]
        if self.image_key in keys:
            return self.image_key
        expected = f"one of {', '.join(keys)}" if keys else "an environment or dataset with images"
        raise ValueError(f"image_key: expected {expected}, got {self.image_key}")

    @property
    def observes_goal(self) -> bool:
        """Whether the goal image is among the input features."""
        return self.goal_key in self.image_features

    def validate_features(self) -> None:
        """Checks the observation and the goal.

        Raises:
            ValueError: If there is no camera image among the input features, or no goal image there nor in a file.
        """
        _ = self.camera_key
        if not (self.goal or self.goals or self.observes_goal):
            raise ValueError(
                f"goal: expected an image file of the finished task, goals, or {self.goal_key} among the observations, "
                "got none of them"
            )
