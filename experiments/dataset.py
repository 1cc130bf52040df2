"""Demonstrations of all 24 tasks: simulators stream expert episodes to a trainer, which records and checks them.

An interrupted run resumes.
"""

import os
from pathlib import Path

from lab import PROGRAMS, ROOT, Lab, main

DATASET = ROOT / "data/demonstrations"
TASKS = 24
EPISODES = int(os.environ.get("EPISODES") or 100)


def record(dataset: Path = DATASET, episodes: int = EPISODES, noise: float = 0) -> None:
    """Records episodes of each task, with noise injection if `noise` is above 0."""
    with Lab(ROOT / "runs/dataset") as lab:
        lab.trainer(dataset)
        lab.demonstrate("--episodes", str(episodes), "--noise", str(noise))
        verify = ["verify", "--dataset", str(dataset), "--tasks", str(TASKS), "--episodes", str(episodes)]
        lab.run([str(PROGRAMS / "cpn-trainer"), *verify])


if __name__ == "__main__":
    main(record)
