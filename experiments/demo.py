"""The closed loop on this machine: a planner and two simulators, and each method on each of three tasks."""

import shutil

from lab import ROOT, Lab, main

# Two tasks that no model has seen, one that it was trained on; see docs/decisions/0004-demonstration-tasks.md.
TASKS = "door-lock,drawer-close,plate-slide"


def demo() -> None:
    """Evaluates the shipped checkpoints, and leaves the report in runs/demo."""
    out = ROOT / "runs/demo"
    shutil.rmtree(out, ignore_errors=True)
    with Lab(out) as lab:
        lab.planner(ROOT / "models")
        for worker in ("w0", "w1"):
            lab.worker(worker)
        options = ["--workers", "2", "--models", "cpn,te-bc,random", "--tasks", TASKS, "--trials", "20"]
        lab.evaluate(*options, "--out", str(out))


if __name__ == "__main__":
    main(demo)
