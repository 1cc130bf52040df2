"""Episodes of the scripted experts."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, repeat

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

NOISE_STEPS = (4, 8)
"""Shortest and longest segment of an episode whose actions get the same noise, or none: long enough to move the hand by
centimetres, short enough that the experts find their way back."""


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
    applied: NDArray[np.float32] | None = None
    """Action that is applied, [A] in [-1, 1], if it is another: with noise added."""


def solve(simulator: Simulator, task: str, seed: int, noise: float = 0) -> Iterator[Moment]:
    """Solves a variation; yields before every action and at the end, with `simulator` in the state of that step.

    Args:
        simulator: Simulator of the episode.
        task: Task.
        seed: Seed of the variation, and of the noise.
        noise: Probability that the actions of a segment of the episode, until it is solved, are applied with noise: a
            displacement drawn from [-1, 1]^3 and added, within the bounds of an action. The expert corrects what it
            does, as in DART (arXiv 1703.09327).

    Raises:
        ExpertFailedError: If the task is not solved within the step limit, or no longer solved at rest.
    """
    arrival = Transition(simulator.reset(task, seed), reward=0, success=False)
    action = np.empty(0, np.float32)
    for offset in islice(_noise(task, seed, noise), MAX_EXPERT_STEPS):
        action = simulator.scene.expert(arrival.state)
        applied = None if offset is None else _with_noise(action, offset)
        yield Moment(arrival, action, applied)
        arrival = simulator.step(action if applied is None else applied)
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


def _noise(task: str, seed: int, probability: float) -> Iterator[NDArray[np.float64] | None]:
    """Noise of each step, a displacement [3], or None; without end."""
    rng = np.random.default_rng([seed, *task.encode()])
    while True:
        steps = int(rng.integers(*NOISE_STEPS, endpoint=True))
        offset = rng.uniform(-1, 1, 3) if rng.random() < probability else None
        yield from repeat(offset, steps)


def _with_noise(action: NDArray[np.float32], offset: NDArray[np.float64]) -> NDArray[np.float32]:
    """Action with the displacement added, within its bounds."""
    applied = action.copy()
    applied[:3] = np.clip(action[:3] + offset, -1, 1)
    return applied
