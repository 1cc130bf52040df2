"""Shipped checkpoints on Meta-World's 26 further tasks, of which no model has seen a demonstration.

Interrupted, it goes on. The outcomes are kept in docs/results/further_tasks.json, of which --table makes the tables.
"""

import argparse
import json

from ablations import APPROACHES, DEFAULT, TRIALS
from lab import ROOT, Lab, main
from outcome_tables import Columns, differences, task_table

from cpn_sim_worker.tasks import FURTHER_TASKS

OUTCOMES = ROOT / "docs/results/further_tasks.json"
PLANNER = "cpn-position"
OTHERS = ("oracle", "te-bc", "cpn")
VARIANTS = (
    "button-press-topdown-wall",
    "button-press-wall",
    "handle-press-side",
    "handle-pull-side",
    "plate-slide-back",
    "plate-slide-back-side",
    "plate-slide-side",
    "reach-wall",
)
"""Forms of trained tasks: behind a wall, turned, or backwards."""
RUNS = {
    APPROACHES: ("--models", ",".join((*OTHERS, PLANNER))),
    DEFAULT: ("--models", PLANNER, "--no-approaches"),
}
"""Options of the evaluations."""


def evaluate() -> None:
    """Evaluates the shipped checkpoints and the straight line to the hand's true position, and keeps the outcomes."""
    out = ROOT / "runs/further-tasks"
    with Lab(out) as lab:
        lab.planner(ROOT / "models")
        for worker in ("w0", "w1"):
            lab.worker(worker)
        for name, options in RUNS.items():
            tasks = ["--tasks", ",".join(FURTHER_TASKS), "--trials", str(TRIALS)]
            lab.evaluate("--workers", "2", *options, *tasks, "--out", str(out / name))
    OUTCOMES.write_text(json.dumps({name: kept(name) for name in RUNS}) + "\n")


def kept(name: str) -> dict[str, dict[str, list[int]]]:
    """1 for a success, 0 for a failure, of each variation in the order of seeds, by model and task."""
    outcomes: dict[str, dict[str, list[int]]] = {}
    for path in sorted((ROOT / "runs/further-tasks" / name / "trials").glob("*/*/*.json")):
        trial = json.loads(path.read_text())
        row = outcomes.setdefault(trial["model"], {}).setdefault(trial["task"], [])
        if trial["outcome"] != "solved-at-reset":
            row.append(int(trial["outcome"] == "success"))
    return outcomes


def tables() -> list[str]:
    """Tables of the kept outcomes, in Markdown, as in docs/results/README.md."""
    runs = json.loads(OUTCOMES.read_text())
    found: Columns = {model: runs[APPROACHES][model] for model in OTHERS}
    found |= {f"{PLANNER}, {name}": runs[name][PLANNER] for name in (DEFAULT, APPROACHES)}
    kinds: Columns = {
        column: {
            "forms of trained tasks": [outcome for task in VARIANTS for outcome in row[task]],
            "others": [outcome for task in row if task not in VARIANTS for outcome in row[task]],
        }
        for column, row in found.items()
    }
    return [task_table(found), task_table(kinds), differences(f"{PLANNER}, {APPROACHES}", found)]


def further_tasks() -> None:
    """Evaluates and prints the tables, or prints the tables alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--table", action="store_true", help="print the tables of the kept outcomes, and run nothing")
    if not parser.parse_args().table:
        evaluate()
    print(*tables(), sep="\n\n")


if __name__ == "__main__":
    main(further_tasks)
