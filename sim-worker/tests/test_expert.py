from itertools import pairwise

import numpy as np
import pytest

from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import METAWORLD_TASKS
from tests.support import UNSOLVED

SEED = 7
"""Seed of a variation that the experts of all tasks solve."""


@pytest.mark.parametrize("task", METAWORLD_TASKS)
def test_expert_solves_task_and_its_actions_replay(simulator: Simulator, task: str) -> None:
    moments = list(solve(simulator, task, SEED))
    goal_state = simulator.scene.data.qpos.copy()
    assert moments[-1].action is None
    assert moments[-1].arrival.success
    solved_progress = simulator.scene.progress
    start = simulator.reset(task, SEED)
    assert not simulator.scene.solved
    assert 0 <= simulator.scene.progress < solved_progress <= 1
    assert np.array_equal(start, moments[0].arrival.state)
    for before, after in pairwise(moments):
        assert before.action is not None
        assert before.action.dtype == np.float32
        assert before.action.shape == (4,)
        assert np.abs(before.action).max() <= 1
        transition = simulator.step(before.action)
        assert np.array_equal(transition.state, after.arrival.state)
        assert (transition.reward, transition.success) == (after.arrival.reward, after.arrival.success)
    assert np.array_equal(simulator.scene.data.qpos, goal_state)


def test_expert_corrects_noise_and_the_applied_actions_replay(simulator: Simulator) -> None:
    moments = list(solve(simulator, "door-lock", 1, 0.3))
    assert moments[-1].arrival.success
    disturbed = [moment for moment in moments if moment.applied is not None]
    assert 0 < len(disturbed) < len(moments) / 2
    simulator.reset("door-lock", 1)
    for before, after in pairwise(moments):
        assert before.action is not None
        applied = before.action if before.applied is None else before.applied
        assert applied.dtype == np.float32
        assert np.abs(applied).max() <= 1
        assert applied[3] == before.action[3]
        transition = simulator.step(applied)
        assert np.array_equal(transition.state, after.arrival.state)


def test_noise_follows_from_the_seed(simulator: Simulator) -> None:
    def lengths(seed: int) -> tuple[int, int]:
        moments = list(solve(simulator, "reach", seed, 0.3))
        return len(moments), sum(moment.applied is not None for moment in moments)

    assert lengths(1) == lengths(1) != lengths(2)


def test_failure_names_the_variation(simulator: Simulator) -> None:
    with pytest.raises(ExpertFailedError, match="door-open with seed 2"):
        list(solve(simulator, *UNSOLVED))
