"""Harness of the planning bench, with real processes."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import plan_stand_in
import pytest

from cpn_bench import chart, harness
from cpn_bench.harness import EAGER, JAX
from cpn_bench.plan import bench, load_chart, service
from cpn_bench.plan.service import LITSERVE, Measurement, Overload

OURS = [sys.executable, str(Path(plan_stand_in.__file__))]
EFFORT = harness.Effort(turns=2, turn_seconds=0.05)


def row(name: str, peer: str, ratio: float) -> harness.Row:
    return harness.Row(name, ratio, 1.0, peer, ratio, bench.UNIT, 1, bench.COMMAND)


def measured() -> list[Measurement]:
    of = {"zenoh tcp": (400.0, 2.0), "gRPC": (200.0, 4.0), LITSERVE: (100.0, 8.0)}
    return [
        Measurement(transport, clients, rate * clients**0.5, p50, 2 * p50, 1000)
        for transport, (rate, p50) in of.items()
        for clients in (1, 32)
    ]


def test_turns_become_rows(capfd: pytest.CaptureFixture[str]) -> None:
    rows = bench.compare(OURS, [EAGER, JAX, bench.ONNX], bench.Setting("cpn", batch=2), EFFORT)
    assert [row.peer_name for row in rows] == [EAGER, JAX, bench.ONNX]
    assert {row.name for row in rows} == {"cpn, batch 2, 1 thread"}
    assert all(row.ours > 0 and row.peer > 0 and row.ratio > 0 and row.n == EFFORT.turns for row in rows)
    printed = capfd.readouterr().out
    assert "a batch of 2: encoder 1 ms (25%), planner 3 ms (75%)" in printed
    assert "GFLOP/s of a large product" in printed


def test_varied_sizes_are_passed_on() -> None:
    (row,) = bench.compare(OURS, [EAGER], bench.Setting("upn", grown="horizon", value=2), EFFORT)
    assert row.name == "upn, horizon 2"


def test_contenders_must_agree_on_the_first_plan() -> None:
    tilted = [*OURS, "--action-error", "0.01"]
    with pytest.raises(RuntimeError, match="first actions of PyTorch eager, cpn, batch 1, 1 thread: expected"):
        bench.compare(tilted, [EAGER], bench.Setting("cpn"), EFFORT)


def test_rows_below_their_floor_are_named() -> None:
    rows = [
        row("cpn, batch 1, 1 thread", EAGER, 19.9),
        row("cpn, batch 1, 1 thread", JAX, 2.0),
        row("cpn, batch 64, 1 thread", harness.COMPILED, 1.5),
        row("cpn, batch 1, 1 thread", bench.ONNX, 0.1),
    ]
    assert harness.shortfalls(rows, bench.FLOORS) == [
        "cpn, batch 1, 1 thread against PyTorch eager: expected at least 20.0 times, got 19.90",
        "cpn, batch 64, 1 thread against torch.compile: expected at least 2.0 times, got 1.50",
    ]


def test_litserve_is_measured(tmp_path: Path) -> None:
    plan_stand_in.write(tmp_path / "model.safetensors", "cpn")
    one, many = service.litserve(tmp_path / "model.safetensors", seconds=0.5)
    assert (one.transport, one.clients, many.clients) == (LITSERVE, 1, 32)
    assert all(m.n > 0 and m.plans_per_second > 0 and 0 < m.p50_ms <= m.p99_ms for m in (one, many))


def test_our_service_is_measured_by_its_bench() -> None:
    line = {"transport": "gRPC", "clients": 1, "plans_per_second": 2.0, "p50_ms": 1.0, "p99_ms": 3.0, "n": 9}
    overload = Overload(4.0, 10.0, 100, 40, 9, 9, 30, 1, 0.2, 0.3)
    lines = json.dumps(line | {"server_ms_p50": 0.5}) + "\n" + json.dumps(asdict(overload))
    script = f"import sys, pathlib; pathlib.Path(sys.argv[2]).write_text({lines!r} + chr(10))"
    measured = service.ours([sys.executable, "-c", script], seconds=1.0, turns=1)
    assert measured == ([Measurement("gRPC", 1, 2.0, 1.0, 3.0, 9, 0.5)], overload)


def test_the_cost_of_a_service_is_computed_turn_by_turn(capfd: pytest.CaptureFixture[str]) -> None:
    # Three turns on a machine that is slow, fast and medium.
    turns = [
        Measurement(transport, clients, rate * speed, p50, 2 * p50, 10, server)
        for speed, share, wait in ((1.0, 0.7, 0.4), (3.0, 0.8, 0.5), (2.0, 0.9, 0.6))
        for transport, rate, p50, server in ((service.LIBRARY, 100.0, 1.0, 1.0), ("gRPC", 100.0 * share, 1 + wait, 1.0))
        for clients in (1, 32)
    ]
    service.tell_cost(turns)
    printed = capfd.readouterr().out
    assert "gRPC                 adds 0.50 ms (0.40 to 0.60) to a plan at 1 client" in printed
    assert "with 32 has 80% (70% to 90%) of the plans/s of the library alone (n = 3)" in printed
    library, _, grpc, _ = service.medians(turns)
    assert (library.plans_per_second, library.n) == (200.0, 30)
    assert grpc == Measurement("gRPC", 1, 180.0, 1.5, 3.0, 30, 1.0)


def test_services_become_rows() -> None:
    rows = {row.name: row for row in service.rows(measured(), bench.COMMAND)}
    assert rows.keys() == {"zenoh tcp, 1 client", "zenoh tcp, 32 clients", "gRPC, 1 client", "gRPC, 32 clients"}
    assert (rows["zenoh tcp, 1 client"].ratio, rows["zenoh tcp, 1 client"].unit) == (4.0, "ms")
    assert (rows["gRPC, 32 clients"].ratio, rows["gRPC, 32 clients"].unit) == (pytest.approx(2.0), "plans/s")


def test_charts_show_varied_sizes(tmp_path: Path) -> None:
    growth = {"horizon": (1, 5), "updates": (0, 1)}
    rows = [row(f"cpn, {grown} {v}", peer, v + 1) for grown in growth for v in growth[grown] for peer in (EAGER, JAX)]
    chart.draw(rows, growth, "plans/s, batch 1, one thread", tmp_path / "plan.svg")
    drawn = (tmp_path / "plan.svg").read_text()
    assert all(text in drawn for text in ("horizon", "updates", "ours", "plans/s, batch 1, one thread", JAX))
    load_chart.draw(measured(), tmp_path / "load.svg")
    drawn = (tmp_path / "load.svg").read_text()
    assert all(text in drawn for text in ("clients", "latency, p99, ms", "zenoh tcp", LITSERVE))
