"""The report: `report.py RESULTS` reads results, summary.json and pairs, writes report.md, report.html and charts."""

import base64
import json
import sys
from pathlib import Path
from typing import Any

from charts import charts
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from paper import beside
from results import HERE, Results

TYPES = {".jpg": "image/jpeg", ".webp": "image/webp"}


def percent(value: float) -> str:
    """A share in percent."""
    return f"{100 * value:.0f}"


def points(value: float) -> str:
    """A share in percent, with a decimal."""
    return f"{100 * value:.1f}"


def data_url(path: Path) -> str:
    """A picture within a page."""
    return f"data:{TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def read_pairs(folder: Path) -> list[dict[str, Any]]:
    """The pairs of episodes, as pairs.py left them; none where no recordings were at hand."""
    listed = folder / "pairs/pairs.json"
    return json.loads(listed.read_text()) if listed.exists() else []


def report(folder: Path) -> None:
    """Writes the report beside the summary."""
    results, summary = Results.read(folder), json.loads((folder / "summary.json").read_text())
    figures = charts(results, summary)
    for name, svg in figures.items():
        (folder / f"{name}.svg").write_text(svg + "\n")

    environment = Environment(
        loader=FileSystemLoader(HERE / "templates"),
        autoescape=select_autoescape(["html.jinja"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"percent": percent, "points": points}
    environment.filters["data_url"] = lambda name: data_url(folder / "pairs" / name)
    parts = {
        "rates": {(row["task"], row["method"]): row for row in summary["rates"]},
        "costs": {name: [cell for cell in summary["cells"] if cell["method"] == name] for name in summary["methods"]},
        "paper": beside(results, summary["folds"]),
        "pairs": read_pairs(folder),
        "figures": figures,
    }
    for name in ("report.md", "report.html"):
        template = environment.get_template(f"{name}.jinja")
        (folder / name).write_text(template.render(summary, **parts))


if __name__ == "__main__":
    report(Path(sys.argv[1]))
