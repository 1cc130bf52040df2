"""Tables of outcomes, with the statistics of docs/results/README.md."""

from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

BOOTSTRAP: dict[str, Any] = {"method": "percentile", "n_resamples": 10_000, "rng": 0}

Columns = dict[str, dict[str, list[int]]]
"""1 for a success, 0 for a failure, of each variation in the order of seeds, by heading and task."""


def task_table(columns: Columns) -> str:
    """Successes by task and heading, with Wilson intervals of the sums, in Markdown.

    Groups and training seeds are pooled, so that the intervals leave out the differences between seeds; cells that were
    not run are missing.
    """
    lines = ["| task | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for task in sorted({task for row in columns.values() for task in row}):
        counts = [count(row, (task,)) if task in row else None for row in columns.values()]
        lines.append(f"| {task} | " + " | ".join("/".join(map(str, cell)) if cell else "" for cell in counts) + " |")
    totals = [count(row, tuple(row)) for row in columns.values()]
    lines.append("| all | " + " | ".join(f"{solved}/{trials}" for solved, trials in totals) + " |")
    intervals = [binomtest(*total).proportion_ci(method="wilson") for total in totals]
    percent = [f"{100 * interval.low:.0f} to {100 * interval.high:.0f}" for interval in intervals]
    lines.append("| 95 %, in per cent | " + " | ".join(percent) + " |")
    return "\n".join(lines)


def differences(best: str, columns: Columns) -> str:
    """Paired differences of the success rate between a column and the others, in Markdown.

    Pairs are of the same variation; the intervals are bootstrapped over tasks. Columns of other tasks or another number
    of training seeds, as long as not all cells were run, are left out.
    """
    mine = columns.get(best, {})
    lines = [f"| {best} against | difference | 95 %, over tasks | it alone | the other alone |"]
    lines.append("|---" * 5 + "|")
    for column, other in columns.items():
        if column == best or _trials(mine) != _trials(other):
            continue
        pairs = [np.array([mine[task], other[task]]) for task in mine]
        by_task = np.array([np.mean(pair[0] - pair[1]) for pair in pairs])
        interval = bootstrap((by_task,), np.mean, **BOOTSTRAP).confidence_interval
        alone = [sum(int(np.sum(pair[i] > pair[1 - i])) for pair in pairs) for i in (0, 1)]
        percent = [f"{100 * value:+.0f} %" for value in (by_task.mean(), interval.low, interval.high)]
        lines.append(f"| {column} | {percent[0]} | {percent[1]} to {percent[2]} | {alone[0]} | {alone[1]} |")
    return "\n".join(lines)


def _trials(by_task: dict[str, list[int]]) -> dict[str, int]:
    """Number of trials by task."""
    return {task: len(outcomes) for task, outcomes in by_task.items()}


def count(by_task: dict[str, list[int]], tasks: tuple[str, ...]) -> tuple[int, int]:
    """Successes and trials."""
    outcomes = [outcome for task in tasks for outcome in by_task[task]]
    return sum(outcomes), len(outcomes)
