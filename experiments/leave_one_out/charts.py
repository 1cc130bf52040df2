"""Charts of the report, as SVG: the same bytes on every run, and text that can be searched."""

import io
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from results import Results

mpl.use("Agg")
import matplotlib.pyplot as plt

Summary = dict[str, Any]  # As aggregate.py wrote it.

mpl.rcParams |= {"svg.hashsalt": "leave_one_out", "svg.fonttype": "none"}


def charts(results: Results, summary: Summary) -> dict[str, str]:
    """The charts that the results suffice for, by name."""
    found = {
        "success": success(summary),
        "learning": learning(results),
        "distance": distance(summary),
        "updates": updates(summary),
    }
    return {name: _svg(figure) for name, figure in found.items() if figure}


def success(summary: Summary) -> Figure:
    """Success rates with their intervals, a column for each method and a row for each task."""
    tasks, methods = summary["tasks"], summary["methods"]
    figure, axes = _columns(methods, height=1.2 + 0.24 * len(tasks), width=1.3)
    for axis, method in zip(axes, methods, strict=True):
        for row in (row for row in summary["rates"] if row["method"] == method):
            share, height = row["successes"] / row["trials"], tasks.index(row["task"])
            axis.plot(row["interval"], [height, height], color="0.6", linewidth=1.5)
            axis.plot(share, height, "o", color="C0" if row["successes"] else "0.6", markersize=4)
        axis.set_xlim(-0.04, 1.04)
        axis.set_xticks([0, 0.5, 1], ["0", "½", "1"])
        axis.grid(axis="x", color="0.9")
    axes[0].set_yticks(range(len(tasks)), tasks)
    axes[0].set_ylim(len(tasks) - 0.5, -0.5)
    figure.supxlabel("first-attempt success rate, with its 95 % interval", fontsize=9)
    return figure


def learning(results: Results) -> Figure | None:
    """Loss over samples, a column for each trained method and a line for each fold and training seed."""
    if not results.trained:
        return None
    figure, axes = _columns(results.trained, height=2.6)
    for axis, method in zip(axes, results.trained, strict=True):
        for cell in results.of(method):
            samples, losses = zip(*cell["trained"]["curve"], strict=True)
            axis.plot([n / 1e3 for n in samples], losses, color="C0", alpha=0.5, linewidth=0.8)
        axis.set_yscale("log")
        axis.grid(color="0.9")
    axes[0].set_ylabel("running mean of the loss", fontsize=9)
    figure.supxlabel("samples, thousands", fontsize=9)
    return figure


def distance(summary: Summary) -> Figure | None:
    """Latent distance to the goal by step, a column for each method with an embedding, successes and failures apart."""
    methods = [name for name, outcomes in summary["latent_distance"].items() if any(outcomes.values())]
    if not methods:
        return None
    figure, axes = _columns(methods, height=2.6)
    for axis, method in zip(axes, methods, strict=True):
        for outcome, colour in (("success", "C2"), ("failure", "C3")):
            points = summary["latent_distance"][method][outcome]
            steps, means = [point[0] for point in points], [point[1] for point in points]
            axis.plot(steps, means, color=colour, label=outcome, marker="." if len(points) == 1 else None)
        axis.grid(color="0.9")
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("mean latent distance", fontsize=9)
    axes[0].legend(fontsize=8, frameon=False)
    figure.supxlabel("step", fontsize=9)
    return figure


def updates(summary: Summary) -> Figure | None:
    """Mean success rate with its interval by the number of updates, each with the time of the search."""
    methods = list(dict.fromkeys(row["method"] for row in summary["updates"]))
    if not methods:
        return None
    figure, axes = _columns(methods, height=2.8, width=2.6, sharex=False)
    for axis, method in zip(axes, methods, strict=True):
        rows = [row for row in summary["updates"] if row["method"] == method]
        for place, row in enumerate(rows):
            axis.plot([place, place], row["interval"], color="0.6", linewidth=1.5)
        axis.plot(range(len(rows)), [row["mean"] for row in rows], "o-", color="C0", markersize=4, linewidth=0.8)
        axis.set_xticks(range(len(rows)), [f"{row['updates']}\n{row['plan_ms']:.2g} ms" for row in rows], fontsize=8)
        axis.set_xlim(-0.5, len(rows) - 0.5)
        axis.grid(axis="y", color="0.9")
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("mean success rate", fontsize=9)
    figure.supxlabel("updates U, and the time of the search", fontsize=9)
    return figure


def _columns(titles: list[str], height: float, width: float = 2.0, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """A figure with an axis for each title, side by side; sizes in inches."""
    size = (2 + width * len(titles), height)
    figure, axes = plt.subplots(
        1, len(titles), sharex=sharex, sharey=True, squeeze=False, figsize=size, layout="constrained"
    )
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    return figure, list(axes[0])


def _svg(figure: Figure) -> str:
    with io.StringIO() as file:
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
        plt.close(figure)
        svg = file.getvalue()
    return svg[svg.index("<svg") :]
