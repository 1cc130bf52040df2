"""The paper's own statements beside the results: paper.yaml has the statements, this module their measures.

A measure answers in lines of text. The methods are the paper's: those that were trained, and `random` for chance.
"""

from collections.abc import Callable, Iterable
from typing import Any

import yaml
from results import HERE, Results

Measure = Callable[[Results, int, list[str]], list[str]]
"""Lines, of results of an experiment with so many folds and of the statement's tasks."""

NOT_RUN = "not run"


def beside(results: Results, folds: int) -> list[dict[str, Any]]:
    """The statements, each with `here`: the lines of its measure."""
    statements = yaml.safe_load((HERE / "paper.yaml").read_text())
    return [row | {"here": MEASURES[row["measure"]](results, folds, row.get("tasks", []))} for row in statements]


def design(results: Results, folds: int, _: list[str]) -> list[str]:
    """Folds, demonstrations, epochs and trials."""
    trained = [cell["trained"] for method in results.trained for cell in results.of(method)]
    return [
        f"folds: {len(results.tasks)} of {folds}",
        f"demonstrations a task: {_distinct(cell['demonstrations'] for cell in trained)}",
        f"epochs: {_distinct(cell['epochs'] for cell in trained)}",
        f"trials a fold: {_distinct(len(seeds) for seeds in results.variations.values())}",
    ]


def planning(results: Results, _: int, __: list[str]) -> list[str]:
    """Updates and horizon of the methods that plan."""
    trained = [cell["trained"] for method in results.trained for cell in results.of(method)]
    planners = [cell for cell in trained if cell["updates"]]
    return [f"{key}: {_distinct(cell[key] for cell in planners)}" for key in ("updates", "horizon")]


def solved(results: Results, folds: int, _: list[str]) -> list[str]:
    """Tasks that some trained method solved at least once."""
    tasks = _complete(results)
    found = [task for task in tasks if _best(results, task)]
    lines = [f"{len(found)} of {len(tasks)} tasks{': ' if found else ''}{', '.join(found)}"] if tasks else []
    return lines if len(tasks) == folds else [*lines, f"{folds - len(tasks)} of {folds} {NOT_RUN}"]


def rates(results: Results, _: int, tasks: list[str]) -> list[str]:
    """Successes at each of the tasks."""
    lines = []
    for task in tasks:
        found = {
            name: results.outcomes(task, name) for name in [*results.trained, "random"] if task in results.common(name)
        }
        counts = ", ".join(f"{name} {int(outcomes.sum())}/{outcomes.size}" for name, outcomes in found.items())
        lines.append(f"{task}: {counts or NOT_RUN}")
    return lines


def best(results: Results, _: int, __: list[str]) -> list[str]:
    """Number of tasks at which each trained method has the most successes."""
    tasks = _complete(results)
    winners = [names for task in tasks if (names := _best(results, task))]
    if not winners:
        return [f"none of {len(tasks)} tasks solved" if tasks else NOT_RUN]
    counts = ", ".join(f"{method} {sum(method in names for names in winners)}" for method in results.trained)
    return [f"tasks solved by any: {len(winners)}; with the most successes, ties for each: {counts}"]


def best_at(results: Results, _: int, tasks: list[str]) -> list[str]:
    """The trained method with the most successes at each of the tasks, and the mean success rates over the others."""
    complete = _complete(results)
    lines = [
        f"most successes at {task}: {(', '.join(_best(results, task)) or 'none') if task in complete else NOT_RUN}"
        for task in tasks
    ]
    others = [task for task in complete if task not in tasks]
    means = {name: sum(results.outcomes(task, name).mean() for task in others) for name in results.trained if others}
    shares = ", ".join(f"{name} {100 * total / len(others):.1f} %" for name, total in means.items())
    return [*lines, f"mean over the other tasks ({len(others)}): {shares or NOT_RUN}"]


def _complete(results: Results) -> list[str]:
    """Tasks with results of every trained method."""
    return results.common(*results.trained) if results.trained else []


def _best(results: Results, task: str) -> list[str]:
    """The trained methods with the most successes at a task; none if it was never solved."""
    shares = {method: float(results.outcomes(task, method).mean()) for method in results.trained}
    most = max(shares.values())
    return [method for method, share in shares.items() if share == most] if most else []


def _distinct(values: Iterable[int]) -> str:
    """The values without repetition: several, if the results do not agree."""
    return ", ".join(str(value) for value in sorted(set(values))) or NOT_RUN


MEASURES: dict[str, Measure] = {
    "design": design,
    "planning": planning,
    "solved": solved,
    "rates": rates,
    "best": best,
    "best_at": best_at,
}
