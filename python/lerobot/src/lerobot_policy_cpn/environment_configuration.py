"""Configuration of the environments, under the name `cpn`; the simulator is imported when one is made."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES

ENVIRONMENT_ID = "lerobot_policy_cpn/GoalImage-v0"
CAMERA, GOAL = "camera", "goal"
"""Keys of the two images among the pixels of an observation."""
FRAME = PolicyFeature(FeatureType.VISUAL, (84, 84, 3))

gymnasium.register(ENVIRONMENT_ID, entry_point="lerobot_policy_cpn.environment:GoalImageEnv")


# Not `cpn_metaworld`: LeRobot 0.4 makes its own environment of every type whose name has "metaworld" in it.
@EnvConfig.register_subclass("cpn")
@dataclass
class CpnEnvConfig(EnvConfig):
    """Configuration of an environment of a Meta-World task, seen as in the training data of the shipped checkpoints."""

    task: str | None = None
    """Name of the task, for example `coffee-button`."""
    episode_length: int = 150
    """Step limit of an episode, at most 500."""
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(FeatureType.ACTION, (4,)),
            f"pixels/{CAMERA}": FRAME,
            f"pixels/{GOAL}": FRAME,
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            f"pixels/{CAMERA}": f"{OBS_IMAGES}.{CAMERA}",
            f"pixels/{GOAL}": f"{OBS_IMAGES}.{GOAL}",
        }
    )

    @property
    def gym_id(self) -> str:
        """Id of the environment, the same for all tasks."""
        return ENVIRONMENT_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {"task": self.task, "max_episode_steps": self.episode_length, "render_mode": "rgb_array"}
