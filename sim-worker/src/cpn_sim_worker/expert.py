"""Episodes of the scripted experts."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.scene import Transition
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


@dataclass(frozen=True)
class Moment:
    """A step of an episode, before its action."""

    arrival: Transition
    """The state, and what the action before brought; a reward of 0 at the first step."""
    action: NDArray[np.float32] | None
    """What the expert does next, [A] in [-1, 1]; None at the end."""


def solve(simulator: Simulator, task: str, seed: int) -> Iterator[Moment]:
    """Solves a variation, and lets the caller look at `simulator` before every action and at the end.

    Raises:
        ExpertFailedError: If the task is not solved in time, or not at rest.
    """
    arrival = Transition(simulator.reset(task, seed), reward=0, success=False)
    action = np.empty(0, np.float32)
    for _ in range(MAX_EXPERT_STEPS):
        action = simulator.scene.expert(arrival.state)
        yield Moment(arrival, action)
        arrival = simulator.step(action)
        if arrival.success:
            break
    # The hand rests, the gripper keeps its grip.
    hold = np.append(np.zeros(3, np.float32), action[3:])
    for _ in range(HOLD_STEPS):
        yield Moment(arrival, hold)
        arrival = simulator.step(hold)
    if not arrival.success:
        raise ExpertFailedError(task, seed)
    yield Moment(arrival, None)
