"""The one simulator of a process: a scene at a time, and the renderer that shows it."""

import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.metaworld_scene import MetaWorldScene
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.render_spec import RenderSpec
from cpn_sim_worker.scene import Scene, Transition
from cpn_sim_worker.tasks import TASKS, check_task


def _load(task: str) -> Scene:
    check_task(task)
    if task in TASKS:
        return MetaWorldScene(task)
    # The arm's model comes with an extra that Meta-World's users do without.
    from cpn_sim_worker.jenga import JengaScene

    return JengaScene(task)


class Simulator:
    """One scene at a time, loaded when its task is first reset."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._task: str | None = None

    def reset(self, task: str, seed: int) -> NDArray[np.float64]:
        """Starts the variation of `task` that `seed` draws; returns the state, [S].

        Raises:
            UnknownTaskError: If there is no such task.
            SeedError: If it has no such variation.
        """
        if task != self._task:
            self.scene = _load(task)
            self._task = task
        return self.scene.reset(seed)

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [A] in [-1, 1]."""
        return self.scene.step(action)

    def frame(self) -> NDArray[np.uint8]:
        """The camera's image of the current state: [84, 84, 3], RGB."""
        return self._renderer.render(self.scene)

    @property
    def render_spec(self) -> RenderSpec:
        """How `frame` renders."""
        return self._renderer.spec(self.scene)
