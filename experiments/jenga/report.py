"""What the trials say: a table with intervals, paired differences, and a picture of the trajectories."""

import json
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap

mpl.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.float64]
Trials = list[dict]  # As execute.py wrote them.

METHODS = {
    "cpn": "CPN, one trajectory",
    "hindsight": "the same, goals in hindsight",
    "cpn-mpc": "CPN, planned anew at each step",
    "position": "position dynamics, one trajectory",
    "policy": "the same weights without updates",
    "position-mpc": "position dynamics, planned anew at each step",
    "nearest": "nearest demonstration",
    "line": "straight line, inverse kinematics",
}
REFERENCE = "position"
"""Method whose paired differences to the others are reported, and whose trajectories are drawn."""
TASKS = {"jenga-poke": "trained row", "jenga-poke-offset": "offset rows"}
SHOWN = 6
"""Offset variations in the picture: one of each target."""


def interval(values: Array) -> list[float]:
    """95 % of a mean, by bootstrap over variations."""
    if np.ptp(values) == 0:
        return [float(values[0])] * 2
    found = bootstrap((values,), np.mean, rng=np.random.default_rng(0)).confidence_interval
    return [float(found.low), float(found.high)]


def by_seed(trials: Trials, measure: str) -> Array:
    """[seeds, checkpoints], one value for each trial; the seeds in order, so that two methods pair."""
    models = sorted({trial["model"] for trial in trials})
    seeds = sorted({trial["seed"] for trial in trials})
    values = {(trial["seed"], trial["model"]): trial[measure] for trial in trials}
    return np.array([[values[seed, model] for model in models] for seed in seeds], np.float64)


def measured(trial: dict) -> dict:
    """The trial with its errors, in centimetres."""
    goal, path = np.array(trial["goal"]), np.array(trial["executed"])
    distances = 100 * np.linalg.norm(path - goal, axis=1)
    predicted = 100 * np.linalg.norm(np.array(trial["planned"][-1]) - goal) if trial["planned"] else np.nan
    return trial | {"endpoint_cm": distances[-1], "closest_cm": distances.min(), "predicted_cm": predicted}


def summarise(trials: Trials) -> list[dict]:
    """One row for each task and method."""
    rows = []
    for task in TASKS:
        of_task = [trial for trial in trials if trial["task"] == task]
        reference = by_seed([trial for trial in of_task if trial["method"] == REFERENCE], "endpoint_cm").mean(axis=1)
        for method in METHODS:
            mine = [trial for trial in of_task if trial["method"] == method]
            row: dict = {"task": task, "method": method, "variations": len({trial["seed"] for trial in mine})}
            row["checkpoints"] = len({trial["model"] for trial in mine})
            for measure in ("predicted_cm", "endpoint_cm", "closest_cm"):
                # A variation counts once: the checkpoints of a method are averaged.
                values = by_seed(mine, measure).mean(axis=1)
                if not np.isnan(values).any():
                    row[measure] = {"mean": float(values.mean()), "interval": interval(values)}
            values = by_seed(mine, "endpoint_cm")
            row["endpoint_cm_of_each_checkpoint"] = values.mean(axis=0).tolist()
            if method != REFERENCE:
                difference = reference - values.mean(axis=1)
                row["reference_minus_this_cm"] = {"mean": float(difference.mean()), "interval": interval(difference)}
            pokes = by_seed(mine, "success")
            wilson = binomtest(int(pokes.sum()), pokes.size).proportion_ci(method="wilson")
            row["pokes"] = {"successes": int(pokes.sum()), "n": pokes.size, "interval": [wilson.low, wilson.high]}
            row["pokes_of_each_checkpoint"] = pokes.sum(axis=0).astype(int).tolist()
            rows.append(row)
    return rows


def table(rows: list[dict]) -> str:
    """The rows in Markdown."""

    def cm(row: dict, measure: str) -> str:
        if measure not in row:
            return "-"
        low, high = row[measure]["interval"]
        return f"{row[measure]['mean']:.2f} ({low:.2f} to {high:.2f})"

    lines = [
        "| targets | method | predicted end, cm | executed end, cm | closest, cm | position minus this, cm | pokes |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        pokes = row["pokes"]
        low, high = (round(100 * value) for value in pokes["interval"])
        share = f"{pokes['successes']}/{pokes['n']} ({low} to {high} %)"
        cells = [cm(row, m) for m in ("predicted_cm", "endpoint_cm", "closest_cm", "reference_minus_this_cm")]
        lines.append(f"| {' | '.join([TASKS[row['task']], METHODS[row['method']], *cells, share])} |")
    return "\n".join(lines) + "\n"


def draw(demonstrations: list[list[list[float]]], trials: Trials, path: Path) -> None:
    """Trajectories from above and from the side: demonstrated, planned and executed, for one checkpoint."""
    model = min(trial["model"] for trial in trials if trial["method"] == REFERENCE)
    figure, axes = plt.subplots(2, 2, figsize=(9, 7), sharex=True, layout="constrained")
    for column, task in zip(axes.T, TASKS, strict=True):
        shown = [t for t in trials if (t["task"], t["method"], t["model"]) == (task, REFERENCE, model)][:SHOWN]
        for axis, (name, second) in zip(column, (("y", 1), ("z", 2)), strict=True):
            for number, demonstration in enumerate(demonstrations):
                line = np.array(demonstration)
                axis.plot(
                    line[:, 0], line[:, second], color="0.8", linewidth=1, label=None if number else "demonstrations"
                )
            for number, trial in enumerate(shown):
                planned, executed, colour = np.array(trial["planned"]), np.array(trial["executed"]), f"C{number}"
                first = number == 0
                axis.plot(planned[:, 0], planned[:, second], "--", color=colour, label="planned" if first else None)
                axis.plot(executed[:, 0], executed[:, second], color=colour, label="executed" if first else None)
                goal = trial["goal"]
                axis.plot(goal[0], goal[second], "*", color=colour, markersize=11, label="target" if first else None)
            axis.set_xlabel("x, m")
            axis.set_ylabel(f"{name}, m")
            axis.set_aspect("equal")
        column[0].set_title(f"{TASKS[task]}, from above")
        column[1].set_title(f"{TASKS[task]}, from the side")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def report(folder: Path) -> None:
    """Writes report.json, report.md and trajectories.png beside the files of choose.py and execute.py."""
    demonstrations = json.loads((folder / "demonstrations.json").read_text())
    selection = {path.stem: json.loads(path.read_text()) for path in sorted(folder.parent.glob("grid-*.json"))}
    # Two workers write as they come; the picture and the pairs want an order.
    lines = (folder / "trials.jsonl").read_text().splitlines()
    trials = sorted(map(measured, map(json.loads, lines)), key=lambda trial: trial["seed"])
    rows = summarise(trials)
    contents = {"command": "make jenga", "selection": selection, "rows": rows}
    (folder / "report.json").write_text(json.dumps(contents, indent=2) + "\n")
    (folder / "report.md").write_text(table(rows))
    draw(demonstrations, trials, folder / "trajectories.png")
    print(table(rows))
