"""Meta-World tasks, with variations that depend on (task, seed) alone."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules, and Meta-World adds `seed` to its constructors at run time.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

import warnings
import zlib

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
from metaworld.policies import ENV_POLICY_MAP
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from numpy.typing import NDArray

from cpn_sim_worker.scene import Camera, Transition


class MetaWorldScene:
    """Meta-World tabletop task with the Sawyer arm.

    States are [39]: hand, gripper, objects, the same one step earlier, goal.
    """

    # Close pose, in which 84 pixels still resolve a handle. Meta-World mounts this camera upside down.
    camera = Camera("corner4", flip="columns")
    libraries = ("metaworld",)
    revision = ""
    action_size = 4
    """Hand displacement x, y, z and gripper effort, each in [-1, 1]; a displacement of 1 is 1 cm."""

    def __init__(self, task: str) -> None:
        self._task = task
        # "Goal observable" variants put the goal into the state, for the scripted expert only. This seed does not
        # affect variations; it keeps the constructor from using NumPy's global generator.
        self._env: SawyerXYZEnv = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=0)
        self.control_hz = 1 / self._env.dt
        self.action_metres = self._env.action_scale
        self.goal_position = np.empty(0)

    @property
    def model(self) -> mujoco.MjModel:
        """Compiled model."""
        return self._env.model

    @property
    def data(self) -> mujoco.MjData:
        """State of the physics."""
        return self._env.data

    @property
    def solved(self) -> bool:
        """Whether the task is solved in the present state."""
        return bool(self._info["success"])

    @property
    def progress(self) -> float:
        """How far the object is in place, 0 to 1.

        Of Meta-World's measures the one that all tasks have: `obj_to_target` is always 0 in assembly, disassemble and
        door-open. Where success asks for less than the whole way, less than 1 is solved.
        """
        return float(self._info["in_place_reward"])

    def reset(self, seed: int) -> NDArray[np.float64]:
        """Starts the variation of `seed`; returns the state, [39].

        Meta-World's own `reset(seed)` ignores the seed. Some tasks redraw until their objects are far enough apart, so
        the task first draws from our generator, and is then reset with the accepted vector: `reset` places the objects
        twice, and with two different vectors would return the observations of the first.
        """
        env = self._env
        env.np_random = np.random.Generator(np.random.PCG64([zlib.crc32(self._task.encode()), seed]))
        env.seeded_rand_vec = True
        env._freeze_rand_vec = False
        env.reset_model()
        env._freeze_rand_vec = True
        env.reset()

        # Some tasks move an object last without updating its geometry, so that the first frame, and the observation
        # that `reset` returned, would have the old position.
        mujoco.mj_forward(env.model, env.data)
        env._prev_obs = env._get_curr_obs_combined_no_goal()
        self._policy = ENV_POLICY_MAP[f"{self._task}-v3"]()
        state = env._get_obs()
        _, self._info = env.evaluate_state(state, np.zeros(self.action_size, np.float32))
        return state

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [4] in [-1, 1]."""
        state, reward, _, _, self._info = self._env.step(action)
        return Transition(state, float(reward), self.solved)

    def expert(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """Next action of the scripted policy, [4] in [-1, 1]."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Constant.s. may be too high")
            # A copy, because some policies modify their argument.
            return np.clip(self._policy.get_action(state.copy()), -1, 1).astype(np.float32)
