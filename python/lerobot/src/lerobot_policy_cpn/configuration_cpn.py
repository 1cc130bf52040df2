"""Configuration of the policy, under the name `cpn`."""

from dataclasses import dataclass, field
from typing import NoReturn

from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import OBS_IMAGE

UNTRAINABLE = "policy cpn: its models are trained by cpn-trainer and served by cpn-planner; here it has no weights"


@PreTrainedConfig.register_subclass("cpn")
@dataclass
class CpnConfig(PreTrainedConfig):
    """Configuration of a policy that asks a planner for each action."""

    address: str = "tcp/127.0.0.1:7447"
    """Address of the planner: a zenoh endpoint, `grpc://HOST:PORT` or `grpcs://HOST:PORT`."""
    model: str = "cpn"
    """Name of the planner's model."""
    goal: str = ""
    """Image file of the finished task, for tasks without one in `goals`."""
    goals: dict[str, str] = field(default_factory=dict)
    """Image file of the finished task, by the task's description as the environment gives it."""
    updates: int | None = None
    """Number of updates of a plan; the model's own if None."""
    seed: int = 0
    """Seed of the first plan of an episode; each step adds one."""
    image_key: str = OBS_IMAGE
    """Key of the camera image among the observations."""
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

    def validate_features(self) -> None:
        """Checks the observation.

        Raises:
            ValueError: If there is no camera image `image_key` among the input features.
        """
        if self.image_key not in self.image_features:
            expected = ", ".join(self.image_features) or "an environment or dataset with images"
            raise ValueError(f"image_key: expected one of {expected}, got {self.image_key}")
