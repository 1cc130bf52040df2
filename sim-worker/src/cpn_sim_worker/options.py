"""Options of the subcommands. Imports no simulator, which a worker loads while it joins its network."""

import os
from dataclasses import dataclass, field

from cpn_sim_worker.session import ZenohConfig
from cpn_sim_worker.tasks import EPISODE_STEPS, FIRST_EVALUATION_SEED, TASKS, check_task

MAX_STEPS = 500
"""Largest step limit: Meta-World's environments refuse further steps, unlike Jenga."""


@dataclass(frozen=True)
class ServeConfig:
    """Serve Meta-World's and Jenga's tasks over zenoh until SIGTERM or SIGINT."""

    worker: str = "w0"
    """Name of the worker in its zenoh keys."""
    max_steps: int = EPISODE_STEPS
    """Maximum number of steps of an episode."""
    zenoh: ZenohConfig = field(default_factory=ZenohConfig)

    def __post_init__(self) -> None:
        if not self.worker or any(character in "/*$?#" for character in self.worker):
            raise ValueError(f"worker: expected a name without any of / * $ ? #, got {self.worker!r}")
        if not 1 <= self.max_steps <= MAX_STEPS:
            raise ValueError(f"max_steps: expected 1 to {MAX_STEPS}, got {self.max_steps}")


@dataclass(frozen=True)
class DemonstrateConfig:
    """Stream successful expert episodes to the trainer.

    Episodes that the trainer holds already cost one short query each, so an interrupted run is simply run again.
    """

    tasks: tuple[str, ...] = TASKS
    episodes: int = 25
    """Number of successful episodes of each task."""
    first_seed: int = 0
    """Seed of the first variation; the next seed follows after each episode, solved or not."""
    noise: float = 0
    """Noise injection: probability that the actions of a segment of 4 to 8 steps are applied with a random displacement
    of the hand added. A recording keeps the expert's actions, which a policy learns, and those that were applied."""
    processes: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    """Number of processes, which share the tasks."""
    zenoh: ZenohConfig = field(default_factory=ZenohConfig)

    def __post_init__(self) -> None:
        for task in self.tasks:
            check_task(task)
        if not 0 <= self.first_seed < FIRST_EVALUATION_SEED:
            raise ValueError(f"first_seed: expected 0 to {FIRST_EVALUATION_SEED - 1}, got {self.first_seed}")
        if not 0 <= self.noise < 1:
            raise ValueError(f"noise: expected 0 to less than 1, got {self.noise}")
        for name in ("episodes", "processes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
