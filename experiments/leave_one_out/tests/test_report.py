"""The report of small results, complete and not."""

import json
import re
from pathlib import Path

import aggregate
import pytest
from experiment_results import write
from paper import beside
from PIL import Image
from report import report
from results import Results

TRAINED = ("bc", "te-bc", "upn", "cpn")


def made(folder: Path) -> str:
    aggregate.main(folder)
    report(folder)
    return (folder / "report.html").read_text()


def here(folder: Path) -> dict[str, list[str]]:
    """Lines beside the statements, by the measure of a statement and its tasks."""
    rows = beside(Results.read(folder), 24)
    return {" ".join([row["measure"], *row.get("tasks", [])]): row["here"] for row in rows}


def test_the_papers_statements_stand_beside_what_was_measured(tmp_path: Path) -> None:
    for method in TRAINED:
        write(tmp_path, "door-lock", method, [1, 1, 1, 0] if method == "cpn" else [0, 0, 0, 0])
        write(tmp_path, "dial-turn", method, [1, 0, 0, 0])
        write(tmp_path, "reach", method, [0, 0, 0, 0])
    write(tmp_path, "door-lock", "random", [0, 0, 0, 1])
    write(tmp_path, "drawer-close", "cpn", [1, 1, 1, 1])
    found = here(tmp_path)
    assert found["design"] == ["folds: 4 of 24", "demonstrations a task: 2", "epochs: 5", "trials a fold: 4"]
    assert found["planning"] == ["updates: 1", "horizon: 5"]
    # Of drawer-close nothing is said: other methods are missing there.
    assert found["solved"] == ["2 of 3 tasks: dial-turn, door-lock", "21 of 24 not run"]
    assert found["rates door-lock"] == ["door-lock: bc 0/4, te-bc 0/4, upn 0/4, cpn 3/4, random 1/4"]
    assert found["rates drawer-close dial-turn coffee-button"] == [
        "drawer-close: cpn 4/4",
        "dial-turn: bc 1/4, te-bc 1/4, upn 1/4, cpn 1/4",
        "coffee-button: not run",
    ]
    counts = "bc 1, te-bc 1, upn 1, cpn 2"
    assert found["best"] == [f"tasks solved by any: 2; with the most successes, ties for each: {counts}"]
    assert found["best_at door-lock"] == [
        "most successes at door-lock: cpn",
        "mean over the other tasks (2): bc 12.5 %, te-bc 12.5 %, upn 12.5 %, cpn 12.5 %",
    ]


def test_a_fold_that_is_missing_is_not_run(tmp_path: Path) -> None:
    write(tmp_path, "reach", "random", [0, 0, 0, 0])
    found = here(tmp_path)
    assert found["solved"] == ["24 of 24 not run"]
    assert found["best"] == ["not run"]
    assert found["best_at door-lock"] == [
        "most successes at door-lock: not run",
        "mean over the other tasks (0): not run",
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Results of two of the profile's folds."""
    folder = tmp_path / "desk"
    for method in ("random", *TRAINED):
        write(folder, "door-lock", method, [1, 0, 0, 0])
    write(folder, "reach", "cpn", [0, 0, 0, 0])
    return folder


def test_a_partial_report_says_so_and_shows_what_there_is(folder: Path) -> None:
    html = made(folder)
    assert "Partial: 2 of 24 folds have results." in html
    assert "Over the 1 of 2 tasks with results of every method" in html
    assert "Learning curves" in html
    assert "Latent distance" in html
    assert "Updates of a plan" not in html
    assert "Pairs of episodes" not in html
    for chart in re.findall(r"\]\((.*?)\)", (folder / "report.md").read_text()):
        assert (folder / chart).exists(), chart


def test_the_updates_have_a_curve_with_the_time_of_a_plan(folder: Path) -> None:
    write(folder, "door-lock", "cpn", [1, 1, 1, 0], updates=5)
    html = made(folder)
    assert re.search(r"<tr><td>cpn<td>5<td>1<td>75.0<td>.*<td>0.20\n", html)
    assert "<tr><td>cpn<td>1<td>1<td>25.0" in html
    assert "0.2 ms" in (folder / "updates.svg").read_text()


def test_controls_alone_make_a_report(tmp_path: Path) -> None:
    write(tmp_path / "smoke", "reach", "random", [0, 0, 0, 0])
    html = made(tmp_path / "smoke")
    assert "Learning curves" not in html
    assert not (tmp_path / "smoke/learning.svg").exists()


def test_every_cell_has_its_cost(folder: Path) -> None:
    html = made(folder)
    assert html.count("<td>20.0<td>2000<td>0.0500<td>0.1<td>0.2<td>") == len(TRAINED) + 1
    assert html.count("a processor") == len(TRAINED) + 2


def test_pairs_are_within_the_page(folder: Path) -> None:
    (folder / "pairs").mkdir()
    for name in ("a.jpg", "a.webp"):
        Image.new("RGB", (84, 84)).save(folder / "pairs" / name)
    pair = {"task": "reach", "seed": 1, "solved": "cpn", "failed": "bc", "strip": "a.jpg", "animation": "a.webp"}
    (folder / "pairs/pairs.json").write_text(json.dumps([pair]))
    html = made(folder)
    assert "reach, seed 1: solved by cpn, not by bc" in html
    assert re.findall(r'src="(.{11})', html) == ["data:image/", "data:image/"]
