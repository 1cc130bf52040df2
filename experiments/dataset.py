"""Demonstrations of all 24 tasks: simulators stream expert episodes to a trainer, which records and checks them.

An interrupted run resumes.
"""

import os

from lab import PROGRAMS, ROOT, Lab, main

DATASET = ROOT / "data/demonstrations"
TASKS = 24


def record() -> None:
    """Records as many episodes of each task as EPISODES says, 100 by default."""
    episodes = os.environ.get("EPISODES") or "100"
    with Lab(ROOT / "runs/dataset") as lab:
        lab.trainer(DATASET)
        lab.demonstrate("--episodes", episodes)
        verify = ["verify", "--dataset", str(DATASET), "--tasks", str(TASKS), "--episodes", episodes]
        lab.run([str(PROGRAMS / "cpn-trainer"), *verify])


if __name__ == "__main__":
    main(record)
