"""Episodes of the scripted experts."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.scene import Transition
from cpn_sim_worker.simulator import Simulator

MAX_EXPERT_STEPS = 200
"""Step limit of an expert: twice the steps of most."""

HOLD_STEPS = 3
"""Steps at rest after the first success, so that the goal image shows the finished task at rest and a policy trained on
it learns to stop there. The hand lags behind its set point: after more than five steps handle-press has sunk past its
target and no longer counts as solved."""


class ExpertFailedError(Exception):
    """The expert did not solve a variation."""

    def __init__(self, task: str, seed: int) -> None:
        super().__init__(f"the scripted expert does not solve {task} with seed {seed}")
        self.task = task
        self.seed = seed


@dataclass(frozen=True)
class Moment:
    """Step of an episode, before its action."""

    arrival: Transition
    """State, with the reward and success of the previous action; a reward of 0 at the first step."""
    action: NDArray[np.float32] | None
    """Next action of the expert, [A] in [-1, 1]; None at the end."""


def solve(simulator: Simulator, task: str, seed: int) -> Iterator[Moment]:
    """Solves a variation; yields before every action and at the end, with `simulator` in the state of that step.

    Raises:
        ExpertFailedError: If the task is not solved within the step limit, or no longer solved at rest.
    """
    arrival = Transition(simulator.reset(task, seed), reward=0, success=False)
    action = np.empty(0, np.float32)
    for _ in range(MAX_EXPERT_STEPS):
        action = simulator.scene.expert(arrival.state)
        yield Moment(arrival, action)
        arrival = simulator.step(action)
        if arrival.success:
            break

    # The hand rests, and the gripper keeps its grip.
    hold = np.append(np.zeros(3, np.float32), action[3:])
    for _ in range(HOLD_STEPS):
        yield Moment(arrival, hold)
        arrival = simulator.step(hold)
    if not arrival.success:
        raise ExpertFailedError(task, seed)
    yield Moment(arrival, None)
