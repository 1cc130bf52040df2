"""A Meta-World task whose variation depends on (task, seed) alone."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules, and Meta-World adds `seed` to its constructors at run time.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

import zlib
from dataclasses import dataclass

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from numpy.typing import NDArray

from cpn_sim_worker.render import Renderer
from cpn_sim_worker.tasks import check_task


@dataclass(frozen=True)
class Transition:
    """What one action led to."""

    state: NDArray[np.float64]
    """[39], the scripted expert's view: hand, gripper, objects, the same one step earlier, goal."""
    reward: float
    success: bool


class Simulator:
    """One Meta-World environment at a time."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._task: str | None = None

    def _load(self, task: str) -> SawyerXYZEnv:
        check_task(task)
        if task != self._task:
            # "Goal observable" shows the goal to the scripted expert; nothing else of the state leaves the process.
            # This seed has no effect on variations: it keeps the constructor off NumPy's global generator.
            self._env: SawyerXYZEnv = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=0)
            self._task = task
        return self._env

    def reset(self, task: str, seed: int) -> NDArray[np.float64]:
        """Starts the variation of `task` that `seed` draws; returns the state, [39].

        Meta-World's own `reset(seed)` ignores the seed. Some tasks redraw until their objects are far enough apart,
        so the task draws from our generator first, and then resets with the vector that it accepted: `reset` places
        the objects twice, and with two different vectors would return the first one's observations.
        """
        env = self._load(task)
        env.np_random = np.random.Generator(np.random.PCG64([zlib.crc32(task.encode()), seed]))
        env.seeded_rand_vec = True
        env._freeze_rand_vec = False
        env.reset_model()
        env._freeze_rand_vec = True
        state, _ = env.reset()
        # Some tasks move an object last and leave its geometry where it was; the first frame would show it there.
        mujoco.mj_forward(env.model, env.data)
        return state

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [4] in [-1, 1]."""
        state, reward, _, _, info = self._env.step(action)
        return Transition(state, float(reward), bool(info["success"]))

    def frame(self) -> NDArray[np.uint8]:
        """The camera's image of the current state: [84, 84, 3], RGB."""
        return self._renderer.render(self._env.model, self._env.data)
