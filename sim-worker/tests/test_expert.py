from itertools import pairwise

import numpy as np
import pytest

from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import TASKS
from tests.support import UNSOLVED


@pytest.mark.parametrize("task", TASKS)
def test_expert_solves_task_and_its_actions_replay(simulator: Simulator, task: str) -> None:
    moments = list(solve(simulator, task, 1))
    goal_state = simulator.scene.data.qpos.copy()
    assert moments[-1].action is None
    assert moments[-1].arrival.success
    solved_progress = simulator.scene.progress
    start = simulator.reset(task, 1)
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


def test_failure_names_the_variation(simulator: Simulator) -> None:
    with pytest.raises(ExpertFailedError, match="door-open with seed 2"):
        list(solve(simulator, *UNSOLVED))
