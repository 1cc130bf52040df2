"""The closed loop on this machine: a planner and two simulators, and each model on each of three tasks."""

from lab import ROOT, evaluate_shipped, main

MODELS = ("cpn-position", "cpn", "te-bc", "random")
# Two tasks that no model has seen, one that it was trained on; see docs/decisions/0004-demonstration-tasks.md.
TASKS = ("door-lock", "drawer-close", "plate-slide")


def demo() -> None:
    """Evaluates the shipped checkpoints, and leaves the report in runs/demo."""
    evaluate_shipped(ROOT / "runs/demo", MODELS, TASKS, trials=20)


if __name__ == "__main__":
    main(demo)
