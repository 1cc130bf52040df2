"""Charts of rates against the sizes of model and batch."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from cpn_bench.harness import Row


def figure() -> Figure:
    """Empty figure for panels in a row."""
    return Figure(figsize=(12, 3.2), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Writes an SVG with text as text; equal figures give equal bytes."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "cpn"}):
        figure.savefig(path, metadata={"Date": None})


def draw(rows: Sequence[Row], growth: Mapping[str, Sequence[int]], label: str, path: Path) -> None:
    """Draws a panel for each varied size, with a line for each contender and a logarithmic axis of rates."""
    wide = figure()
    panels = wide.subplots(1, len(growth), sharey=True)
    for panel, (grown, values) in zip(panels, growth.items(), strict=True):
        of = {value: [row for row in rows if row.name == f"cpn, {grown} {value}"] for value in values}
        panel.plot(values, [of[value][0].ours for value in values], marker="o", label="ours")
        for peer in dict.fromkeys(row.peer_name for value in values for row in of[value]):
            rates = [row.peer for value in values for row in of[value] if row.peer_name == peer]
            panel.plot(values, rates, marker="o", label=peer)
        panel.set(xlabel=grown, yscale="log", xticks=values)
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[0].set_ylabel(label)
    panels[-1].legend()
    save(wide, path)
