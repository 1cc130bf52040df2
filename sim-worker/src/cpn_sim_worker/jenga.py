"""Jaco arm and oversized Jenga tower: the simulated counterpart of the paper's physical experiment.

The paper has 21 demonstrations of poking a block of the lower row from different starting positions, and evaluates on
target blocks that are offset along an axis without variation in the demonstrations. Here that axis is the height. The
goal is a position, which no object in the scene marks.
"""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

import hashlib
import zlib
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.scene import Camera, Transition
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED, MissingExtraError, SeedError

SCENE = Path(__file__).with_name("jenga_scene.xml")

LEVELS = {"jenga-poke": (0,), "jenga-poke-offset": (1, 2)}
"""Target levels of each task, from below, of the three whose blocks point at the arm; they are 12 cm apart."""
COLUMNS = 3

ACTION_METRES = 0.01
"""Displacement of the hand's set point by an action of 1."""

POKE_METRES = 0.03
"""Displacement of the target block that counts as a poke, unless another block moves by half of it."""
LOOSE_FRICTION = 0.05
"""Friction of the target block, which is loose, as in the game: a block under load would drag along those on it."""

# Box of starting positions, in metres, world frame. The target faces are at x = 0.7, the lower row's at z = 0.18.
START_LOW, START_HIGH = np.array([0.46, -0.12, 0.12]), np.array([0.54, 0.12, 0.32])
# Workspace of the hand: off the floor, away from the arm's singularities, and bounded in depth inside the tower.
WORKSPACE_LOW, WORKSPACE_HIGH = np.array([0.45, -0.14, 0.11]), np.array([0.78, 0.14, 0.52])

HOME = np.array([0.27, 2.26, 4.91, -2.47, -1.29, -1.36])
"""Joint angles, in radians, from which inverse kinematics reaches every start with the elbow up."""
CLOSED_FINGERS = 1.35
"""Angle of the closed fingers, in radians."""
FORWARD = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Constant orientation of the hand: the fingers, at its -z, point along the world's x."""

DAMPING = 1e-4
START_ITERATIONS, STEP_ITERATIONS = 100, 5


def _load_model() -> mujoco.MjModel:
    """Compiles the scene with dm_control's arm and hand; only its XML files are used."""
    try:
        kinova = files("dm_control") / "third_party" / "kinova"
    except ModuleNotFoundError:
        raise MissingExtraError("jenga", "dm_control") from None
    scene = mujoco.MjSpec.from_file(str(SCENE))
    arm = mujoco.MjSpec.from_file(str(kinova / "jaco_arm.xml"))
    hand = mujoco.MjSpec.from_file(str(kinova / "jaco_hand.xml"))
    # Meeting point of the closed fingertips.
    hand.body("hand").add_site(name="fingertip", pos=[0, 0, -0.198])
    scene.attach(arm, site=scene.site("mount"), prefix="arm/")
    scene.attach(hand, site=scene.site("arm/wristsite"), prefix="hand/")
    for body in scene.bodies:
        if "/" in body.name:
            # Gravity compensation, as in the real arm's firmware.
            body.gravcomp = 1
    return scene.compile()


class JengaScene:
    """Jenga task of one arm and one tower.

    The state is [16]: the fingertip's position (3), the opening of the fingers, 0 to 1 (1), the arm's joint angles in
    radians (6), the position of the target block's centre (3) and the goal position (3); metres, world frame.
    """

    action_size = 3
    """Displacement of the hand along the world's x, y and z, each in [-1, 1]; 1 is 1 cm."""
    action_metres = ACTION_METRES
    control_hz = 10.0
    """At 1 cm per step this is 10 cm/s, half of the real arm's speed; its servos lag by a quarter of a step."""
    camera = Camera("view", flip="rows")
    libraries = ("dm_control",)
    revision = hashlib.sha256(SCENE.read_bytes()).hexdigest()[:16]

    solved: bool
    """Whether the target block is pushed in, and the rest of the tower stands."""
    progress: float
    """Pushed share of the target block's way, 0 to 1."""
    goal_position: NDArray[np.float64]
    """[3], position of the fingertip after a minimal poke: the centre of the target block's face, pushed in."""

    def __init__(self, task: str) -> None:
        if task not in LEVELS:
            raise ValueError(f"task: expected one of {', '.join(LEVELS)}, got {task!r}")
        self._task = task
        self.model = _load_model()
        self.data = mujoco.MjData(self.model)
        self._default_contacts = self.model.geom_priority.copy(), self.model.geom_friction.copy()
        self._kinematics = mujoco.MjData(self.model)
        joint = self.model.joint("arm/joint_1")
        self._arm = slice(joint.qposadr[0], joint.qposadr[0] + len(HOME))
        self._arm_dofs = slice(joint.dofadr[0], joint.dofadr[0] + len(HOME))
        self._fingers = slice(self._arm.stop, self._arm.stop + 3)
        self._blocks = [i for i in range(self.model.nbody) if self.model.body(i).name.startswith(("end", "side"))]

    def reset(self, seed: int) -> NDArray[np.float64]:
        """Starts the variation of `seed`; returns the state, [16].

        Consecutive seeds cycle through the task's blocks, so that 21 seeds poke each of three blocks from seven starts.
        The start of the hand is uniform in a box, drawn by a PCG64 generator seeded with the task and the seed.

        Raises:
            SeedError: If the seed is negative, or below the evaluation seeds for the evaluation-only task.
        """
        first = 0 if self._task == "jenga-poke" else FIRST_EVALUATION_SEED
        if seed < first:
            raise SeedError(self._task, f"at least {first}", seed)
        level, column = divmod(seed % (len(LEVELS[self._task]) * COLUMNS), COLUMNS)
        block = self.model.body(f"end_{column}_{LEVELS[self._task][level]}")
        generator = np.random.Generator(np.random.PCG64([zlib.crc32(self._task.encode()), seed]))
        self._set_point = generator.uniform(START_LOW, START_HIGH)

        mujoco.mj_resetData(self.model, self.data)
        self.model.geom_priority[:], self.model.geom_friction[:] = self._default_contacts
        # MuJoCo uses the friction of the surface with the higher priority.
        self.model.geom_priority[block.geomadr] += 1
        self.model.geom_friction[block.geomadr, 0] = LOOSE_FRICTION
        self.data.qpos[self._arm] = self._inverse_kinematics(HOME, START_ITERATIONS)
        self.data.qpos[self._fingers] = CLOSED_FINGERS
        self.data.ctrl[:] = self.data.qpos[self._arm.start : self._fingers.stop]
        mujoco.mj_forward(self.model, self.data)

        self._target = self._blocks.index(block.id)
        self._initial = self.data.xpos[self._blocks]
        self.solved, self.progress = False, 0.0
        half_length = self.model.geom_size[block.geomadr[0], 0]
        self.goal_position = block.pos + np.array([POKE_METRES - half_length, 0, 0])
        return self._state()

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Moves the hand by an action, [3] in [-1, 1].

        The reward is minus the distance between fingertip and goal position, in metres. Success is a poke: the target
        block is pushed in, and the rest of the tower stands.

        Raises:
            ValueError: If the action has another shape or leaves its limits.
        """
        # In this form NaN, which compares false with everything, is refused too.
        if action.shape != (self.action_size,) or not np.all(np.abs(action) <= 1):
            raise ValueError(f"action: expected {self.action_size} values in [-1, 1], got {action.tolist()}")
        self._set_point = np.clip(self._set_point + ACTION_METRES * action, WORKSPACE_LOW, WORKSPACE_HIGH)
        joints = self.data.ctrl[: len(HOME)]
        joints[:] = self._inverse_kinematics(joints, STEP_ITERATIONS)
        mujoco.mj_step(self.model, self.data, nstep=round(1 / (self.control_hz * self.model.opt.timestep)))
        # MuJoCo's step leaves the positions of bodies and sites from before its last integration.
        mujoco.mj_kinematics(self.model, self.data)

        moved = self.data.xpos[self._blocks] - self._initial
        others = np.delete(np.linalg.norm(moved, axis=1), self._target)
        pushed = moved[self._target, 0]
        self.solved = bool(pushed >= POKE_METRES and others.max() < POKE_METRES / 2)
        self.progress = float(np.clip(pushed / POKE_METRES, 0, 1))
        state = self._state()
        return Transition(state, -float(np.linalg.norm(state[:3] - self.goal_position)), self.solved)

    def expert(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """Action of the heuristic expert, [3] in [-1, 1]: move in front of the face, then push straight in."""
        to_goal = state[13:] - state[:3]
        in_front = np.hypot(to_goal[1], to_goal[2]) < 0.01
        # Way point 6 cm before the face, which is POKE_METRES before the goal; for the push, 1 cm past the goal.
        to_goal[0] += 0.01 if in_front else -POKE_METRES - 0.06
        # Gain below 1, so that the hand decelerates smoothly.
        return np.clip(0.4 * to_goal / ACTION_METRES, -1, 1).astype(np.float32)

    def _state(self) -> NDArray[np.float64]:
        low, high = self.model.joint("hand/finger_1").range
        opening = (high - self.data.qpos[self._fingers].mean()) / (high - low)
        hand, block = self.data.site("hand/fingertip").xpos, self.data.xpos[self._blocks[self._target]]
        return np.concatenate([hand, [opening], self.data.qpos[self._arm], block, self.goal_position])

    def _inverse_kinematics(self, joints: NDArray[np.float64], iterations: int) -> NDArray[np.float64]:
        """Joint angles, [6], with the fingertip at the set point: damped least squares, starting from `joints`."""
        data, site = self._kinematics, self._kinematics.site("hand/fingertip")
        jacobian = np.zeros((6, self.model.nv))
        for _ in range(iterations):
            data.qpos[self._arm] = joints
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_jacSite(self.model, data, jacobian[:3], jacobian[3:], site.id)
            arm = jacobian[:, self._arm_dofs]
            # Orientation error: half the sum of the axes' cross products is the rotation axis times the sine of its
            # angle.
            turn = np.cross(site.xmat.reshape(3, 3), FORWARD, axis=0).sum(axis=1) / 2
            error = np.concatenate([self._set_point - site.xpos, turn])
            joints = joints + arm.T @ np.linalg.solve(arm @ arm.T + DAMPING * np.eye(6), error)
        return joints
