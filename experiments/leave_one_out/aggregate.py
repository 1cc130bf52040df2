"""Statistics of the results: `aggregate.py RESULTS` reads RESULTS/TASK/METHOD-SEED.json, writes RESULTS/summary.json.

Rates have Wilson score intervals; two methods are compared on the same variations, by McNemar's exact test. Means over
tasks and their differences have percentile intervals of a stratified bootstrap: tasks are kept, and within each the
training seeds and the variations are drawn anew.
"""

import hashlib
import json
import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from cells import ROOT
from numpy.typing import NDArray
from results import HERE, Cell, Results
from scipy.stats import binomtest

sys.path.append(str(ROOT / "sim-worker/src"))
from cpn_sim_worker.tasks import TASKS

Row = dict[str, Any]  # JSON, of summary.json.

CONFIDENCE = 0.95
RESAMPLES = 10_000


def rate(results: Results, task: str, method: str) -> Row:
    """Success rate of a method at a task."""
    cells = results.cells[task, method]
    outcomes = results.outcomes(task, method)
    wilson = binomtest(int(outcomes.sum()), outcomes.size).proportion_ci(CONFIDENCE, method="wilson")
    steps = [n for cell in cells for n, success in zip(cell["steps"], cell["successes"], strict=True) if success]
    return {
        "task": task,
        "method": method,
        "training_seeds": len(cells),
        "successes": int(outcomes.sum()),
        "trials": outcomes.size,
        "interval": _rounded(wilson.low, wilson.high),
        "mean_success_steps": round(float(np.mean(steps)), 1) if steps else None,
        "mean_best_progress": _mean([value for cell in cells for value in cell["best_progress"]]),
    }


def mean(results: Results, method: str, tasks: list[str]) -> Row:
    """Mean success rate of a method over tasks."""
    outcomes = [results.outcomes(task, method) for task in tasks]
    draws = _bootstrap([(values,) for values in outcomes])[0]
    return {
        "method": method,
        "tasks": len(tasks),
        "mean": round(float(np.mean([values.mean() for values in outcomes])), 4),
        "interval": _percentiles(draws),
        "mean_best_progress": _mean([rate(results, task, method)["mean_best_progress"] for task in tasks]),
    }


def compare(results: Results, a: str, b: str) -> Row:
    """Two methods on the same variations; McNemar's test pairs trials of the same training seed."""
    tasks = results.common(a, b)
    only_a = only_b = pairs = 0
    for task in tasks:
        of_a, of_b = ({cell["seed"]: cell["successes"] for cell in results.cells[task, name]} for name in (a, b))
        for seed in of_a.keys() & of_b.keys():
            for success_a, success_b in zip(of_a[seed], of_b[seed], strict=True):
                pairs += 1
                only_a += success_a > success_b
                only_b += success_b > success_a
    outcomes = [(results.outcomes(task, a), results.outcomes(task, b)) for task in tasks]
    draws = _bootstrap(outcomes)
    return {
        "a": a,
        "b": b,
        "tasks": len(tasks),
        "pairs": pairs,
        "only_a": only_a,
        "only_b": only_b,
        "p": float(f"{binomtest(only_a, only_a + only_b).pvalue:.3g}") if only_a + only_b else 1.0,
        "difference": round(float(np.mean([of_a.mean() - of_b.mean() for of_a, of_b in outcomes])), 4),
        "interval": _percentiles(draws[0] - draws[1]),
    }


def _bootstrap(tasks: list[tuple[NDArray[np.float64], ...]]) -> list[NDArray[np.float64]]:
    """Means over tasks in each resample, for each of the methods whose outcomes a task has.

    Within a task the methods share the variations, and each draws its own training seeds.
    """
    generator = np.random.default_rng(0)
    sums = [np.zeros(RESAMPLES) for _ in tasks[0]]
    for methods in tasks:
        variations = generator.integers(methods[0].shape[1], size=(RESAMPLES, 1, methods[0].shape[1]))
        for total, outcomes in zip(sums, methods, strict=True):
            seeds = generator.integers(len(outcomes), size=(RESAMPLES, len(outcomes), 1))
            total += outcomes[seeds, variations].mean((1, 2))
    return [total / len(tasks) for total in sums]


def _mean(values: list[float | None]) -> float | None:
    """Mean; none if a value is missing."""
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 3) if len(known) == len(values) else None


def _percentiles(draws: NDArray[np.float64]) -> list[float]:
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return _rounded(low, high)


def _rounded(*values: float) -> list[float]:
    return [round(float(value), 4) for value in values]


def cost(results: Results, task: str, method: str) -> list[Row]:
    """Cost and origin of the cells of a task and method."""
    return [
        {
            "task": task,
            "method": method,
            "seed": cell["seed"],
            "train_seconds": cell["trained"] and cell["trained"]["seconds"],
            "samples": cell["trained"] and cell["trained"]["samples"],
            "loss": cell["trained"] and cell["trained"]["loss"],
            "encode_ms": cell["encode_ms"],
            "plan_ms": cell["plan_ms"],
            "processor": cell["processor"],
            "data_digest": cell["trained"] and cell["trained"]["data_digest"],
            "weights": cell["weights"],
            "training": cell["cell"]["training"],
            "training_code": cell["trained"] and cell["trained"]["cell"]["code"],
            "evaluation_code": cell["cell"]["code"],
        }
        for cell in results.cells.get((task, method), [])
    ]


def updates(results: Results, method: str) -> list[Row]:
    """Mean success rate and time of a plan by the number of updates U, over the tasks with results of each U."""
    names = results.updates(method)
    tasks = results.common(*names.values())
    if len(names) < 2 or not tasks:
        return []
    rows = []
    for number, name in names.items():
        cells = [cell for task in tasks for cell in results.cells[task, name]]
        plan_ms = round(float(np.mean([cell["plan_ms"] for cell in cells])), 3)
        rows.append(mean(results, name, tasks) | {"method": method, "updates": number, "plan_ms": plan_ms})
    return rows


def latent_distance(cells: list[Cell]) -> dict[str, list[list[float]]]:
    """Mean latent distance to the goal of successes and of failures: [step, mean, episodes that last so long]."""
    pooled = {}
    for outcome in ("success", "failure"):
        by_step: dict[int, list[tuple[float, int]]] = {}
        for step, value, episodes in (point for cell in cells for point in cell["latent_distance"][outcome]):
            by_step.setdefault(step, []).append((value, episodes))
        pooled[outcome] = [
            [step, round(sum(value * n for value, n in found) / (total := sum(n for _, n in found)), 4), total]
            for step, found in sorted(by_step.items())
        ]
    return pooled


def variations_digest(results: Results) -> str:
    """SHA-256 of a line `TASK SEED` for each variation, by task and seed."""
    lines = [f"{task} {seed}\n" for task in results.tasks for seed in sorted(results.variations[task])]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def summarise(results: Results, folds: int) -> Row:
    """All statistics of an experiment of so many folds, in JSON."""
    methods, names = results.methods, sorted({name for _, name in results.cells})
    complete = results.common(*methods)
    return {
        "confidence": CONFIDENCE,
        "resamples": RESAMPLES,
        "folds": folds,
        "tasks": results.tasks,
        "methods": methods,
        "variations": results.variations,
        "variations_digest": variations_digest(results),
        "solved_at_reset": results.solved_at_reset,
        "rates": [
            rate(results, task, name) for task in results.tasks for name in methods if task in results.common(name)
        ],
        "means": [mean(results, method, complete) for method in methods] if complete else [],
        "comparisons": [compare(results, *pair) for pair in combinations(methods, 2) if results.common(*pair)],
        "updates": [row for method in results.trained for row in updates(results, method)],
        "latent_distance": {method: latent_distance(results.of(method)) for method in results.trained},
        "cells": [row for task in results.tasks for name in names for row in cost(results, task, name)],
    }


def folds(profile: str) -> int:
    """Number of folds of a profile."""
    settings = yaml.safe_load((HERE / "profiles" / f"{profile}.yaml").read_text())
    return len(settings.get("folds", settings.get("tasks", TASKS)))


def main(folder: Path) -> None:
    """Writes the statistics beside the results."""
    summary = summarise(Results.read(folder), folds(folder.resolve().name))
    (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
