"""The report: `report.py RESULTS` reads RESULTS/summary.json, writes report.md, report.html and success.svg."""

import io
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

mpl.use("Agg")
import matplotlib.pyplot as plt

Summary = dict[str, Any]  # As aggregate.py wrote it.

# The same bytes on every run, and text that can be searched.
mpl.rcParams |= {"svg.hashsalt": "leave_one_out", "svg.fonttype": "none"}


def draw(summary: Summary) -> str:
    """Success rates with their intervals, a column for each method and a row for each task, as SVG."""
    tasks, methods = summary["tasks"], summary["methods"]
    size = (2 + 1.3 * len(methods), 1.2 + 0.24 * len(tasks))
    figure, axes = plt.subplots(
        1, len(methods), sharex=True, sharey=True, squeeze=False, figsize=size, layout="constrained"
    )
    for axis, method in zip(axes[0], methods, strict=True):
        for row in (row for row in summary["rates"] if row["method"] == method):
            share, height = row["successes"] / row["trials"], tasks.index(row["task"])
            axis.plot(row["interval"], [height, height], color="0.6", linewidth=1.5)
            axis.plot(share, height, "o", color="C0" if row["successes"] else "0.6", markersize=4)
        axis.set_title(method, fontsize=9)
        axis.set_xlim(-0.04, 1.04)
        axis.set_xticks([0, 0.5, 1], ["0", "½", "1"])
        axis.grid(axis="x", color="0.9")
    axes[0][0].set_yticks(range(len(tasks)), tasks)
    axes[0][0].set_ylim(len(tasks) - 0.5, -0.5)
    figure.supxlabel("first-attempt success rate, with its 95 % interval", fontsize=9)
    with io.StringIO() as file:
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
        plt.close(figure)
        svg = file.getvalue()
    return svg[svg.index("<svg") :]


def percent(value: float) -> str:
    """A share in percent."""
    return f"{100 * value:.0f}"


def report(folder: Path) -> None:
    """Writes the report beside the summary."""
    summary = json.loads((folder / "summary.json").read_text())
    rates = {(row["task"], row["method"]): row for row in summary["rates"]}
    costs = {method: [cell for cell in summary["cells"] if cell["method"] == method] for method in summary["methods"]}
    figure = draw(summary)
    (folder / "success.svg").write_text(figure + "\n")
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=select_autoescape(["html.jinja"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"percent": percent}
    for name in ("report.md", "report.html"):
        template = environment.get_template(f"{name}.jinja")
        (folder / name).write_text(template.render(summary, rates=rates, costs=costs, figure=figure))


if __name__ == "__main__":
    report(Path(sys.argv[1]))
