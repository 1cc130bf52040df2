# pyright: reportAttributeAccessIssue=false
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from cpn_sim_worker.jenga import ACTION_METRES, WORKSPACE_HIGH, WORKSPACE_LOW, JengaScene
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED

DEMONSTRATIONS = range(21)
OFFSETS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 6)
"""One variation of each block."""

# Prints every state of the expert's first steps, to the last bit.
WALK = """
from cpn_sim_worker.jenga import JengaScene
scene = JengaScene("jenga-poke")
state = scene.reset(7)
for _ in range(24):
    print(state.tobytes().hex(), scene.data.qpos.tobytes().hex())
    state = scene.step(scene.expert(state)).state
"""


@pytest.fixture(scope="module")
def poke() -> JengaScene:
    return JengaScene("jenga-poke")


@pytest.fixture(scope="module")
def offset() -> JengaScene:
    return JengaScene("jenga-poke-offset")


def action(*values: float) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def solve(scene: JengaScene, seed: int) -> tuple[int, float]:
    """Steps until the expert succeeds, and the reward once the hand has come to rest."""
    state = scene.reset(seed)
    assert (scene.solved, scene.progress) == (False, 0)
    for step in range(1, 61):
        transition = scene.step(scene.expert(state))
        assert scene.solved == transition.success == (scene.progress == 1)
        state = transition.state
        if transition.success:
            for _ in range(3):
                transition = scene.step(action(0, 0, 0))
            assert transition.success
            return step, transition.reward
    raise AssertionError(f"seed {seed}: no success in 60 steps")


@pytest.mark.parametrize("seed", DEMONSTRATIONS)
def test_expert_pokes_the_lower_row(poke: JengaScene, seed: int) -> None:
    steps, reward = solve(poke, seed)
    assert 20 <= steps <= 60
    assert -0.01 < reward < 0


@pytest.mark.parametrize("seed", OFFSETS)
def test_expert_pokes_the_rows_above(offset: JengaScene, seed: int) -> None:
    _, reward = solve(offset, seed)
    assert -0.01 < reward < 0


def test_targets_are_offset_in_height_alone(poke: JengaScene, offset: JengaScene) -> None:
    lower, upper = [], []
    for scene, seeds, goals in ((poke, DEMONSTRATIONS, lower), (offset, OFFSETS, upper)):
        for seed in seeds:
            state = scene.reset(seed)
            assert np.array_equal(state[13:], scene.goal_position)
            goals.append(tuple(scene.goal_position))
    assert len({z for _, _, z in lower}) == 1
    assert {z for _, _, z in lower}.isdisjoint(z for _, _, z in upper)
    assert {(x, y) for x, y, _ in lower} == {(x, y) for x, y, _ in upper}
    assert sorted({goal: lower.count(goal) for goal in lower}.values()) == [7, 7, 7]
    assert len(set(upper)) == len(OFFSETS)


def test_starts_differ_and_the_hand_stands_there(poke: JengaScene) -> None:
    starts = np.array([poke.reset(seed)[:3] for seed in DEMONSTRATIONS])
    assert len(np.unique(starts.round(3), axis=0)) == len(DEMONSTRATIONS)
    start = poke.reset(3)
    rest = poke.step(action(0, 0, 0)).state
    assert np.abs(rest[:10] - start[:10]).max() < 1e-3


def test_same_actions_lead_through_the_same_states_in_another_process(poke: JengaScene) -> None:
    other = subprocess.Popen([sys.executable, "-c", WALK], stdout=subprocess.PIPE, text=True)
    poke.reset(2)
    poke.step(action(1, -1, 1))
    np.random.seed(1)
    states, state = [], poke.reset(7)
    for _ in range(24):
        states += [state.tobytes().hex(), poke.data.qpos.tobytes().hex()]
        state = poke.step(poke.expert(state)).state
    assert other.communicate()[0].split() == states


@pytest.mark.parametrize("seed", OFFSETS)
def test_tower_stands_still(offset: JengaScene, seed: int) -> None:
    offset.reset(seed)
    before = offset.data.xpos[offset._blocks]
    mujoco.mj_step(offset.model, offset.data, nstep=round(2 / offset.model.opt.timestep))
    assert np.abs(offset.data.xpos[offset._blocks] - before).max() < 2e-4


@pytest.mark.parametrize("direction", [*np.eye(3), *-np.eye(3)])
def test_hand_follows_its_command_and_keeps_its_orientation(poke: JengaScene, direction: NDArray[np.float64]) -> None:
    state = start = poke.reset(0)
    orientation = poke.data.site("hand/fingertip").xmat.copy()
    for values in [direction] * 5 + [np.zeros(3)] * 2:
        state = poke.step(values.astype(np.float32)).state
    assert np.abs(state[:3] - start[:3] - 5 * ACTION_METRES * direction).max() < 2e-3
    assert np.abs(poke.data.site("hand/fingertip").xmat - orientation).max() < 0.02


@pytest.mark.parametrize("y", [-1, 1])
@pytest.mark.parametrize("z", [-1, 1])
def test_hand_reaches_the_corners_of_its_workspace_and_no_further(poke: JengaScene, y: int, z: int) -> None:
    corner = np.where([False, y > 0, z > 0], WORKSPACE_HIGH, WORKSPACE_LOW)
    state = poke.reset(0)
    for _ in range(45):
        state = poke.step(action(-1, y, z)).state
    assert np.abs(state[:3] - corner).max() < 2e-3


def test_moving_other_blocks_is_no_poke(poke: JengaScene) -> None:
    """The closed hand between two blocks moves both."""
    state = poke.reset(1)
    seam = poke.goal_position + np.array([0, 0.045, 0])
    for _ in range(40):
        transition = poke.step(np.clip((seam - state[:3]) / ACTION_METRES, -1, 1).astype(np.float32))
        state = transition.state
        assert not transition.success
    assert np.linalg.norm(state[10:13] - poke._initial[poke._target]) > 0.005


def test_unknown_task_is_refused() -> None:
    with pytest.raises(ValueError, match="task: expected one of jenga-poke, jenga-poke-offset, got 'jenga-pull'"):
        JengaScene("jenga-pull")


@pytest.mark.parametrize(("task", "seed"), [("jenga-poke", -1), ("jenga-poke-offset", FIRST_EVALUATION_SEED - 1)])
def test_seed_out_of_range_is_refused(task: str, seed: int) -> None:
    with pytest.raises(ValueError, match=f"seed of {task}: expected at least .*, got {seed}"):
        JengaScene(task).reset(seed)


@pytest.mark.parametrize("values", [(0, 0), (0, 0, 0, 0), (0, 0, 1.001), (float("nan"), 0, 0)])
def test_bad_action_is_refused(poke: JengaScene, values: tuple[float, ...]) -> None:
    poke.reset(0)
    with pytest.raises(ValueError, match=r"action: expected 3 values in \[-1, 1\], got"):
        poke.step(action(*values))
