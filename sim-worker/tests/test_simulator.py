import subprocess
import sys

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from cpn_sim_worker.render import Renderer
from cpn_sim_worker.scene import CameraPose, camera_pose
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.spaces import IMAGE_SIZE
from cpn_sim_worker.tasks import METAWORLD_TASKS, UnknownTaskError

# Prints one digest per frame of a short walk through the tasks named on its command line.
WALK = """
import hashlib, sys
import numpy as np
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.simulator import Simulator
simulator = Simulator(Renderer())
for task in sys.argv[1:]:
    simulator.reset(task, 7)
    for x in (1, -1, 1):
        print(hashlib.sha256(simulator.frame().tobytes()).hexdigest())
        simulator.step(np.array([x, 0.5, -0.5, 1], np.float32))
"""


MODEL_ARRAYS = ("mesh_vert", "mesh_face", "mesh_facenum", "geom_pos", "geom_size", "body_inertia", "body_mass")


def start_walk(*tasks: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", WALK, *tasks], stdout=subprocess.PIPE, text=True)


def physics(simulator: Simulator) -> NDArray[np.float64]:
    """Positions and velocities of everything that moves."""
    data = simulator.scene.data
    return np.concatenate([data.qpos, data.qvel, data.mocap_pos.ravel()])


@pytest.mark.parametrize("task", METAWORLD_TASKS)
def test_variation_depends_on_task_and_seed_alone(simulator: Simulator, task: str) -> None:
    first_state = simulator.reset(task, 3)
    first = physics(simulator)
    assert not np.array_equal(simulator.reset(task, 4), first_state)
    for _ in range(5):
        simulator.step(np.array([1, 1, -1, 1], np.float32))
    np.random.seed(1)  # The generator that Meta-World draws from by default.
    assert np.array_equal(simulator.reset(task, 3), first_state)
    assert np.array_equal(physics(simulator), first)


def test_unknown_task_is_refused(simulator: Simulator) -> None:
    with pytest.raises(UnknownTaskError, match="make-coffee"):
        simulator.reset("make-coffee", 0)


def test_frame_changes_when_the_arm_moves(simulator: Simulator) -> None:
    simulator.reset("reach", 0)
    frames = []
    for _ in range(3):
        frames.append(simulator.frame())
        for _ in range(5):
            simulator.step(np.array([0, 0, 1, 0], np.float32))
    assert np.count_nonzero(frames[0] != frames[1]) > 100
    assert np.count_nonzero(frames[1] != frames[2]) > 100


def test_two_processes_draw_every_task_alike() -> None:
    """Frames are equal in concurrent processes, whatever was drawn before: one goes through the tasks backwards."""
    forth, back = start_walk(*METAWORLD_TASKS), start_walk(*reversed(METAWORLD_TASKS))
    first, second = (process.communicate()[0].split() for process in (forth, back))
    frames = len(first) // len(METAWORLD_TASKS)
    assert frames == 3
    backwards = [second[i : i + frames] for i in range(0, len(second), frames)]
    assert first == [digest for task in reversed(backwards) for digest in task]
    assert len(set(first)) == len(first)


def test_rendering_leaves_the_physics_alone(simulator: Simulator) -> None:
    def trajectory(look: bool) -> list[NDArray[np.float64]]:
        simulator.reset("peg-insert-side", 5)
        states = []
        for _ in range(20):
            states.append(simulator.step(np.array([0.3, 1, -1, 1], np.float32)).state)
            if look:
                simulator.frame()
        return states

    simulator.reset("peg-insert-side", 5)
    before = {name: getattr(simulator.scene.model, name).copy() for name in MODEL_ARRAYS}
    assert np.array_equal(trajectory(look=False), trajectory(look=True))
    for name, values in before.items():
        assert np.array_equal(getattr(simulator.scene.model, name), values), name


@pytest.mark.usefixtures("simulator")
def test_a_second_renderer_is_refused() -> None:
    with pytest.raises(RuntimeError, match="one Renderer only"):
        Renderer()


def test_image_is_upright_and_not_mirrored(simulator: Simulator) -> None:
    """The camera faces -x: +y, where the table stands, is to the right of the arm's base, and the table is below."""
    simulator.reset("reach", 0)
    frame = simulator.frame().astype(int)
    arm = (frame[..., 0] > 80) & (frame[..., 1] < 50)
    table = (frame[..., 0] - frame[..., 2] > 25) & ~arm
    rows, columns = (np.nonzero(mask) for mask in (arm, table))
    assert rows[1].mean() < 42 < columns[1].mean()
    assert rows[0].mean() < columns[0].mean()
    assert columns[0].mean() > 42


@pytest.mark.parametrize("task", ["reach", "drawer-open", "lever-pull"])
def test_goal_site_is_hidden(simulator: Simulator, task: str) -> None:
    simulator.reset(task, 0)
    hidden = simulator.frame()
    renderer, scene = simulator._renderer, simulator.scene
    renderer._option.sitegroup[:] = 1
    shown = simulator.frame()
    renderer._option.sitegroup[:] = 0
    assert np.count_nonzero(shown != hidden) > 0
    scene.model.site("goal").pos[2] += 0.1
    mujoco.mj_forward(scene.model, scene.data)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.array_equal(simulator.frame(), hidden)


# Along the third axis, Jenga's hand passes before its tower.
@pytest.mark.parametrize(
    ("task", "axis"), [("reach", 0), ("reach", 1), ("reach", 2), ("jenga-poke", 0), ("jenga-poke", 1)]
)
def test_camera_pose_follows_the_hand(simulator: Simulator, task: str, axis: int) -> None:
    state = simulator.reset(task, 0)
    before = pixel(camera_pose(simulator.scene), state[:3])
    frame_before = simulator.frame().astype(int)
    action = np.zeros(simulator.scene.action_size, np.float32)
    action[axis] = -1
    *_, arrival = (simulator.step(action) for _ in range(6))
    after = pixel(camera_pose(simulator.scene), arrival.state[:3])
    frame_after = simulator.frame().astype(int)

    hand = patch(frame_before, before)
    moved = np.abs(patch(frame_after, after) - hand).mean()
    assert moved < np.abs(patch(frame_after, before) - hand).mean()
    assert moved < np.abs(patch(frame_after, 2 * before - after) - hand).mean()


def pixel(pose: CameraPose, position: NDArray[np.float64]) -> NDArray[np.int64]:
    """Row and column of a position, by a pinhole camera."""
    right, up, away = pose.rotation.T @ (position - pose.position)
    focal = IMAGE_SIZE / 2 / np.tan(np.radians(pose.field_of_view_degrees) / 2)
    return np.round(IMAGE_SIZE / 2 + focal * np.array([-up, right]) / -away).astype(int)


def patch(frame: NDArray[np.int64], centre: NDArray[np.int64]) -> NDArray[np.int64]:
    row, column = centre
    return frame[row - 5 : row + 6, column - 5 : column + 6]
