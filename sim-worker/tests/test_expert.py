import numpy as np
import pytest

from cpn_sim_worker.expert import MAX_EXPERT_STEPS, ExpertFailedError, run_expert
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import TASKS
from tests.support import UNSOLVED


@pytest.mark.parametrize("task", TASKS)
def test_expert_solves_task_and_its_actions_replay(simulator: Simulator, task: str) -> None:
    actions = run_expert(simulator, task, 1)
    goal_state = simulator._env.data.qpos.copy()
    assert actions.dtype == np.float32
    assert actions.shape[1:] == (4,)
    assert np.abs(actions).max() <= 1
    simulator.reset(task, 1)
    transitions = [simulator.step(action) for action in actions]
    assert transitions[-1].success
    assert np.array_equal(simulator._env.data.qpos, goal_state)


def test_failure_names_the_variation(simulator: Simulator) -> None:
    with pytest.raises(ExpertFailedError, match="door-open with seed 2"):
        run_expert(simulator, *UNSOLVED)
    assert simulator._env.curr_path_length == MAX_EXPERT_STEPS
