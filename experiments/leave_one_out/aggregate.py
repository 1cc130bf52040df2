"""Statistics of the results: `aggregate.py RESULTS` reads RESULTS/TASK/METHOD-SEED.json, writes RESULTS/summary.json.

Rates have Wilson score intervals; two methods are compared on the same variations, by McNemar's exact test. Means over
tasks and their differences have percentile intervals of a stratified bootstrap: tasks are kept, and within each the
training seeds and the variations are drawn anew.
"""

import hashlib
import json
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.stats import binomtest

Cell = dict[str, Any]  # A result, as jobs.py wrote it.

RECIPES = Path(__file__).with_name("methods.yaml")
CONFIDENCE = 0.95
RESAMPLES = 10_000


class ResultsError(ValueError):
    """Results that do not belong together."""


@dataclass(frozen=True)
class Results:
    """Results of an experiment, complete or not."""

    cells: dict[tuple[str, str], list[Cell]]
    """Of each task and method, in the order of their training seeds."""
    variations: dict[str, list[int]]
    """Seeds of the variations of each task, the same for all methods."""
    solved_at_reset: dict[str, list[int]]
    """Seeds of those that were refused as trials: the task was solved before any action."""

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """Reads a folder of results.

        Raises:
            ResultsError: If there are none, or those of a task are of different variations.
        """
        cells: dict[tuple[str, str], list[Cell]] = {}
        variations: dict[str, list[int]] = {}
        solved_at_reset: dict[str, list[int]] = {}
        for path in sorted(folder.glob("*/*-*.json")):
            cell = json.loads(path.read_text()) | {"seed": int(path.stem.rpartition("-")[2])}
            expected = variations.setdefault(path.parent.name, cell["seeds"])
            if cell["seeds"] != expected:
                raise ResultsError(f"{path}: expected the variations {expected}, got {cell['seeds']}")
            solved_at_reset[path.parent.name] = cell["solved_at_reset"]
            cells.setdefault((path.parent.name, cell["cell"]["method"]), []).append(cell)
        if not cells:
            raise ResultsError(f"{folder}: expected results of at least one cell, got none")
        return cls(cells, variations, solved_at_reset)

    @property
    def tasks(self) -> list[str]:
        """Tasks with a result."""
        return sorted(self.variations)

    @property
    def methods(self) -> list[str]:
        """Methods with a result, in the order of methods.yaml."""
        found = {method for _, method in self.cells}
        return [method for method in yaml.safe_load(RECIPES.read_text())["recipes"] if method in found]

    def outcomes(self, task: str, method: str) -> NDArray[np.float64]:
        """[training seeds, variations]: 1 for a success."""
        return np.array([cell["successes"] for cell in self.cells[task, method]], np.float64)

    def common(self, *methods: str) -> list[str]:
        """Tasks with results of all these methods."""
        return [task for task in self.tasks if all((task, method) in self.cells for method in methods)]


def rate(results: Results, task: str, method: str) -> Cell:
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


def mean(results: Results, method: str, tasks: list[str]) -> Cell:
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


def compare(results: Results, a: str, b: str) -> Cell:
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


def cost(results: Results, task: str, method: str) -> list[Cell]:
    """Cost and origin of the cells of a task and method."""
    return [
        {
            "task": task,
            "method": method,
            "seed": cell["seed"],
            "train_seconds": cell["trained"] and cell["trained"]["seconds"],
            "encode_ms": cell["encode_ms"],
            "plan_ms": cell["plan_ms"],
            "processor": cell["processor"],
            "data_digest": cell["trained"] and cell["trained"]["data_digest"],
            "weights": cell["weights"],
            "training": cell["cell"]["training"],
            "training_code": cell["trained"] and cell["trained"]["cell"]["code"],
            "evaluation_code": cell["cell"]["code"],
        }
        for cell in results.cells[task, method]
    ]


def variations_digest(results: Results) -> str:
    """SHA-256 of a line `TASK SEED` for each variation, by task and seed."""
    lines = [f"{task} {seed}\n" for task in results.tasks for seed in sorted(results.variations[task])]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def summarise(results: Results) -> Cell:
    """All statistics, in JSON."""
    methods, cells = results.methods, [(task, method) for task in results.tasks for method in results.methods]
    cells = [key for key in cells if key in results.cells]
    complete = results.common(*methods)
    return {
        "confidence": CONFIDENCE,
        "resamples": RESAMPLES,
        "tasks": results.tasks,
        "methods": methods,
        "variations": results.variations,
        "variations_digest": variations_digest(results),
        "solved_at_reset": results.solved_at_reset,
        "rates": [rate(results, *key) for key in cells],
        "means": [mean(results, method, complete) for method in methods] if complete else [],
        "comparisons": [compare(results, *pair) for pair in combinations(methods, 2) if results.common(*pair)],
        "cells": [row for key in cells for row in cost(results, *key)],
    }


def main(folder: Path) -> None:
    """Writes the statistics beside the results."""
    (folder / "summary.json").write_text(json.dumps(summarise(Results.read(folder)), indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
