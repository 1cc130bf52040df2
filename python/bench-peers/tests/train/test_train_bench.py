"""Harness of the training bench, with real processes."""

import sys
from pathlib import Path

import pytest

from cpn_bench import chart, harness
from cpn_bench.train import bench

OURS = [sys.executable, str(Path(__file__).parent / "train_stand_in.py")]
EFFORT = harness.Effort(turns=2, turn_seconds=0.05)


def row(name: str, peer: str, ratio: float) -> harness.Row:
    return harness.Row(name, ratio, 1.0, peer, ratio, "samples/s", 1, bench.COMMAND)


def test_turns_become_rows() -> None:
    rows, stages = bench.compare(OURS, [harness.EAGER, harness.JAX], bench.Setting("bc"), EFFORT)
    assert [row.peer_name for row in rows] == [harness.EAGER, harness.JAX]
    assert {row.name for row in rows} == {"bc, 1 thread"}
    assert all(row.ours > 0 and row.peer > 0 and row.ratio > 0 and row.n == EFFORT.turns for row in rows)
    assert stages == {"everything": 0.001}


def test_contenders_must_agree_on_the_first_loss() -> None:
    tilted = [*OURS, "--loss-error", "0.01"]
    with pytest.raises(RuntimeError, match=r"first loss of PyTorch eager, bc, 1 thread: expected 0\.\d+, got 0\."):
        bench.compare(tilted, [harness.EAGER], bench.Setting("bc"), EFFORT)


def test_a_contender_that_dies_is_named() -> None:
    # The stand-in supports only BC, and refuses its batches for another method.
    with pytest.raises(RuntimeError, match="ours: expected an answer"):
        bench.compare(OURS, [harness.EAGER], bench.Setting("te-bc"), EFFORT)


def test_rows_below_their_floor_are_named() -> None:
    rows = [
        row("cpn, 1 thread", harness.EAGER, 3.9),
        row("cpn, 1 thread", harness.JAX, 2.0),
        row("cpn, 2 threads", harness.EAGER, 0.1),
        row("bc, 1 thread", harness.EAGER, float("nan")),
    ]
    assert harness.shortfalls(rows, bench.FLOORS) == [
        "cpn, 1 thread against PyTorch eager: expected at least 4.0 times, got 3.90",
        "bc, 1 thread against PyTorch eager: expected at least 1.5 times, got nan",
    ]


def test_the_chart_has_a_panel_for_each_varied_size(tmp_path: Path) -> None:
    rows = [row(f"cpn, horizon {value}", peer, value) for value in (1, 5) for peer in (harness.EAGER, harness.JAX)]
    rows += [row(f"cpn, batch {value}", peer, value) for value in (32, 128) for peer in (harness.EAGER, harness.JAX)]
    chart.draw(rows, {"horizon": (1, 5), "batch": (32, 128)}, "samples/s", tmp_path / "train.svg")
    drawn = (tmp_path / "train.svg").read_text()
    assert all(text in drawn for text in ("horizon", "batch", "ours", harness.EAGER, harness.JAX))
