"""Simulator of a process: one scene at a time, and its renderer."""

import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.jenga import JengaScene
from cpn_sim_worker.metaworld_scene import MetaWorldScene
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.scene import Scene, Transition
from cpn_sim_worker.tasks import METAWORLD_TASKS, check_task


def scene_type(task: str) -> type[MetaWorldScene | JengaScene]:
    """Class of the scene of `task`.

    Raises:
        UnknownTaskError: If the task is unknown.
    """
    check_task(task)
    return MetaWorldScene if task in METAWORLD_TASKS else JengaScene


class Simulator:
    """Simulator that hosts one scene at a time."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._task: str | None = None

    def load(self, task: str) -> None:
        """Loads the scene of `task`, unless it is loaded already.

        Raises:
            UnknownTaskError: If the task is unknown.
            MissingExtraError: If the task needs an extra that is not installed.
        """
        if task != self._task:
            self.scene: Scene = scene_type(task)(task)
            self.render_spec = self._renderer.spec(self.scene)
            self._task = task

    def reset(self, task: str, seed: int) -> NDArray[np.float64]:
        """Starts the variation of `task` and `seed`; returns the state, [S].

        Raises:
            UnknownTaskError: If the task is unknown.
            MissingExtraError: If the task needs an extra that is not installed.
            SeedError: If the seed has no variation.
        """
        self.load(task)
        return self.scene.reset(seed)

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [A] in [-1, 1]."""
        return self.scene.step(action)

    def frame(self) -> NDArray[np.uint8]:
        """Camera image of the current state, [84, 84, 3], RGB, rendered as in `render_spec`."""
        return self._renderer.render(self.scene)
