"""Meta-World's scripted experts."""

import warnings

import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from numpy.typing import NDArray

from cpn_sim_worker.simulator import Simulator

MAX_EXPERT_STEPS = 200
"""Twice what most experts need."""

HOLD_STEPS = 3
"""How long the arm rests after the first success, so that the goal image shows the finished task at rest and a policy
trained on it learns to stop there. The hand trails its set point: after more than five steps handle-press has sunk
past its target and no longer counts as solved."""


class ExpertFailedError(Exception):
    """The expert did not solve a variation."""

    def __init__(self, task: str, seed: int) -> None:
        super().__init__(f"the scripted expert does not solve {task} with seed {seed}")
        self.task = task
        self.seed = seed


def run_expert(simulator: Simulator, task: str, seed: int) -> NDArray[np.float32]:
    """Solves a variation and leaves `simulator` in its goal state; returns the actions applied, [T, 4] in [-1, 1].

    Nothing is rendered. Physics is deterministic: `reset` and these actions lead through the same states again.

    Raises:
        ExpertFailedError: If the task is not solved in time, or not at rest.
    """
    state = simulator.reset(task, seed)
    policy = ENV_POLICY_MAP[f"{task}-v3"]()
    actions: list[NDArray[np.float32]] = []
    for _ in range(MAX_EXPERT_STEPS):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Constant.s. may be too high")
            action = np.clip(policy.get_action(state), -1, 1).astype(np.float32)
        transition = simulator.step(action)
        actions.append(action)
        if transition.success:
            break
        state = transition.state
    else:
        raise ExpertFailedError(task, seed)
    hold = np.array([0, 0, 0, action[3]], np.float32)
    for _ in range(HOLD_STEPS):
        transition = simulator.step(hold)
        actions.append(hold)
    if not transition.success:
        raise ExpertFailedError(task, seed)
    return np.stack(actions)
