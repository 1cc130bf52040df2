"""Gymnasium environments of the scenes, registered when this module is imported: `cpn/TASK-v0` for each task."""

from functools import cached_property
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.render import process_renderer
from cpn_sim_worker.simulator import Simulator, scene_type
from cpn_sim_worker.spaces import IMAGE_SIZE
from cpn_sim_worker.tasks import EPISODE_STEPS, FIRST_EVALUATION_SEED, JENGA_TASKS, METAWORLD_TASKS


class SceneEnv(gymnasium.Env[NDArray[np.uint8], NDArray[np.float32]]):
    """Environment of a task.

    An observation is the camera image, uint8 [84, 84, 3], RGB, without goal markers; an action is float32 [A] in
    [-1, 1], with A = 4 for Meta-World and 3 for Jenga. The reward is the scene's. An episode terminates when the task
    is solved; `gymnasium.make` truncates it after 150 steps, or after `max_episode_steps`.

    `info` has the simulator's `state`, float64 [S], and `success`; that of a reset also has the `seed` of the
    variation, and with `goal_image` the `goal`, uint8 [84, 84, 3].
    """

    # The rate is that of videos: the control rate depends on the scene.
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(self, task: str, *, goal_image: bool = False, render_mode: Literal["rgb_array"] | None = None) -> None:
        """Makes the environment; the scene and its renderer are loaded by the first reset.

        Args:
            task: Name of the task, for example `door-lock`.
            goal_image: Whether each reset runs the scripted expert, whose last frame is the goal.
            render_mode: `rgb_array`, for which `render` returns the observation.

        Raises:
            UnknownTaskError: If the task is unknown.
        """
        self.task = task
        self.goal_image = goal_image
        self.render_mode = render_mode
        self.observation_space = Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        self.action_space = Box(-1, 1, (scene_type(task).action_size,), np.float32)

    @cached_property
    def _simulator(self) -> Simulator:
        # Not in the constructor: gymnasium's vector environments construct one, and then fork.
        return Simulator(process_renderer())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Starts the variation of a seed; returns its first frame and `info`.

        Args:
            seed: Seed of the variation; if None, one below 1,000,000, the seeds of demonstrations, is drawn from the
                environment's generator, with `goal_image` until the expert solves its variation.
            options: None or empty.

        Raises:
            ValueError: If there are options.
            SeedError: If the seed has no variation.
            ExpertFailedError: With `goal_image`, if the expert does not solve the variation of a given seed.
            MissingExtraError: If the task needs an extra that is not installed.
            OpenGLError: If OpenGL is missing or does not draw.
        """
        if options:
            raise ValueError(f"options: expected none, got {options}")
        super().reset(seed=seed)
        if seed is not None:
            return self._start(seed)
        while True:
            try:
                return self._start(int(self.np_random.integers(FIRST_EVALUATION_SEED)))
            except ExpertFailedError:
                continue

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Applies an action, [A] in [-1, 1]; returns frame, reward, whether the task is solved, False, and `info`.

        Raises:
            ValueError: If the action has another shape, or values beyond [-1, 1].
        """
        values = np.asarray(action, np.float32)
        if values not in self.action_space:
            raise ValueError(f"action: expected {self.action_space.shape} in [-1, 1], got {values.tolist()}")
        arrival = self._simulator.step(values)
        return self._simulator.frame(), arrival.reward, arrival.success, False, _info(arrival.state, arrival.success)

    def render(self) -> NDArray[np.uint8] | None:
        """Camera image of the current state, [84, 84, 3]; None without a render mode."""
        return self._simulator.frame() if self.render_mode else None

    def _start(self, seed: int) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        goal = {"goal": self._goal(seed)} if self.goal_image else {}
        state = self._simulator.reset(self.task, seed)
        info = _info(state, self._simulator.scene.solved) | {"seed": seed} | goal
        return self._simulator.frame(), info

    def _goal(self, seed: int) -> NDArray[np.uint8]:
        """Last frame of the expert, [84, 84, 3]."""
        for _ in solve(self._simulator, self.task, seed):
            pass
        return self._simulator.frame()


def _info(state: NDArray[np.float64], success: bool) -> dict[str, Any]:
    return {"state": state.copy(), "success": success}


for _task in METAWORLD_TASKS + JENGA_TASKS:
    gymnasium.register(
        f"cpn/{_task}-v0",
        entry_point=f"{__name__}:{SceneEnv.__name__}",
        kwargs={"task": _task},
        max_episode_steps=EPISODE_STEPS,
    )
