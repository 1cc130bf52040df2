"""Environment of a task with the goal image among the observations."""

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Dict
from numpy.typing import NDArray

from lerobot_policy_cpn.environment_configuration import CAMERA, GOAL

try:
    from cpn_sim_worker.expert import ExpertFailedError
    from cpn_sim_worker.gym import SceneEnv
    from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED, METAWORLD_TASKS
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"env.type=cpn: expected cpn-sim-worker to be installed, got {error}") from error

Frame = NDArray[np.uint8]
Observation = dict[str, Any]

VARIATIONS = 20
"""Most variations that a reset tries."""


class GoalImageEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Environment of a Meta-World task, over the evaluation variations.

    An observation has `pixels`: the images `camera` and `goal`, each uint8 [84, 84, 3], RGB. The goal is the last frame
    of the scripted expert in the episode's variation. Actions, rewards, ends of episodes and the rest of `info` are
    those of `SceneEnv`; `info["is_success"]` says whether the task is solved.
    """

    metadata = SceneEnv.metadata

    def __init__(self, task: str | None, *, render_mode: Literal["rgb_array"] | None = None) -> None:
        """Makes the environment; the first reset loads the scene.

        Args:
            task: Name of the task, for example `coffee-button`.
            render_mode: `rgb_array`, for which `render` returns the camera image.

        Raises:
            ValueError: If there is no such Meta-World task.
        """
        if task not in METAWORLD_TASKS:
            raise ValueError(f"env.task: expected one of {', '.join(METAWORLD_TASKS)}, got {task!r}")
        # LeRobot 0.6 reads both names.
        self.task = self.task_description = task
        self._scene = SceneEnv(task, goal_image=True, render_mode=render_mode)
        self.render_mode = render_mode
        image = self._scene.observation_space
        self.observation_space = Dict({"pixels": Dict({CAMERA: image, GOAL: image})})
        self.action_space = self._scene.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a variation; returns the first observation, and `info` with the `seed` of the variation.

        A variation that the expert does not solve has no goal image: that of the seed greater by 1,000,000 takes its
        place, so that no other seed of an evaluation is repeated.

        Args:
            seed: Seed of the variation, at least 1,000,000; if None, one is drawn from the environment's generator.
            options: Ignored; LeRobot 0.6 tells the beginning of a rollout by one.

        Raises:
            ValueError: If the seed is one of demonstrations.
            ExpertFailedError: If the expert solves none of 20 variations.
            OpenGLError: If OpenGL is missing or does not draw.
        """
        super().reset(seed=seed)
        if seed is None:
            seed = FIRST_EVALUATION_SEED + int(self.np_random.integers(FIRST_EVALUATION_SEED))
        if seed < FIRST_EVALUATION_SEED:
            raise ValueError(
                f"seed: expected at least {FIRST_EVALUATION_SEED}, since lesser ones are of demonstrations, got {seed}"
            )
        frame, info = self._start(seed)
        self._goal: Frame = info.pop("goal")
        return self._observation(frame), info | {"is_success": info["success"]}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Applies an action, [4] in [-1, 1]; see `SceneEnv.step`."""
        frame, reward, terminated, truncated, info = self._scene.step(action)
        return self._observation(frame), reward, terminated, truncated, info | {"is_success": info["success"]}

    def render(self) -> Frame | None:
        """Camera image of the current state, [84, 84, 3]; None without a render mode."""
        return self._scene.render()

    def _start(self, seed: int) -> tuple[Frame, dict[str, Any]]:
        for _ in range(VARIATIONS - 1):
            try:
                return self._scene.reset(seed=seed)
            except ExpertFailedError:
                seed += FIRST_EVALUATION_SEED
        return self._scene.reset(seed=seed)

    def _observation(self, frame: Frame) -> Observation:
        return {"pixels": {CAMERA: frame, GOAL: self._goal.copy()}}
