"""Load tests of CPN's planning service and of LitServe, each with its clients on the same cores."""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cpn_bench.harness import ENVIRONMENT, Row, median, module

LITSERVE = "LitServe + PyTorch"
LIBRARY = "library"
"""CPN's planner without a service, with the number of clients as the batch size."""
COMPARED = ("zenoh tcp", "gRPC")
"""CPN's transports over TCP, for comparison with HTTP."""
FEW, MANY = 1, 32
"""Numbers of clients."""
START_SECONDS, STOP_SECONDS = 120.0, 10.0


@dataclass(frozen=True)
class Measurement:
    """Throughput and latencies of a number of clients, each of which sends its next request after the answer."""

    transport: str
    clients: int
    plans_per_second: float
    p50_ms: float
    """Median latency of a plan at the client."""
    p99_ms: float
    n: int
    """Number of plans."""
    server_ms_p50: float | None = None
    """Median time of a plan, reported by the server."""


@dataclass(frozen=True)
class Overload:
    """Results of an overload of requests with a deadline."""

    overload: float
    """Rate of requests, as a multiple of the capacity."""
    capacity_plans_per_second: float
    deadline_ms: int
    n: int
    """Number of requests: answered, refused, or answered with an error after the deadline."""
    answered: int
    answered_in_time: int
    refused: int
    late: int
    refused_p50_ms: float
    """Median latency of a refusal."""
    refused_p99_ms: float


def ours(command: Sequence[str], seconds: float, turns: int) -> tuple[list[Measurement], Overload]:
    """Measures CPN's service by its bench, over all transports, in `turns` of `seconds` each."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "load.jsonl"
        options = ["--out", str(path), "--seconds", str(seconds), "--turns", str(turns)]
        subprocess.run([*command, *options], check=True, stdout=sys.stderr)
        lines = [json.loads(line) for line in path.read_text().splitlines()]
    (overload,) = [Overload(**line) for line in lines if "overload" in line]
    return [Measurement(**line) for line in lines if "overload" not in line], overload


def litserve(model: Path, seconds: float) -> list[Measurement]:
    """Measures LitServe with few and many clients, for `seconds` each."""
    with _server(model) as address:
        options = ["--url", f"{address}/predict", "--model", str(model), "--seconds", str(seconds)]

        def load(clients: int) -> Measurement:
            command = module("plan.load", *options, "--clients", str(clients))
            loaded = subprocess.run(command, check=True, stdout=subprocess.PIPE)
            return Measurement(LITSERVE, **json.loads(loaded.stdout))

        return [load(clients) for clients in (FEW, MANY)]


@contextmanager
def _server(model: Path) -> Iterator[str]:
    """Address of a LitServe server, once it is ready."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = module("plan.litserve_server", "--model", str(model), "--port", str(port))
    # A separate session, so that its workers are ended with it.
    process = subprocess.Popen(command, stdout=sys.stderr, env=os.environ | ENVIRONMENT, start_new_session=True)
    try:
        address = f"http://127.0.0.1:{port}"
        _wait(process, f"{address}/health")
        yield address
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _wait(process: "subprocess.Popen[bytes]", url: str) -> None:
    """Waits until a server is healthy."""
    end = time.monotonic() + START_SECONDS
    while process.poll() is None and time.monotonic() < end:
        try:
            with urllib.request.urlopen(url, timeout=1):  # noqa: S310 - http
                return
        except (urllib.error.URLError, TimeoutError):
            time.sleep(0.1)
    raise RuntimeError(f"{LITSERVE}: expected it to be healthy within {START_SECONDS:.0f} s, got no answer from {url}")


def tell(measured: Sequence[Measurement]) -> None:
    """Prints measurements."""
    for m in measured:
        server = "" if m.server_ms_p50 is None else f", {m.server_ms_p50:.2f} ms in the server"
        print(
            f"{m.transport:20s} {m.clients:3d} client{'s'[: m.clients > 1]:1s} {m.plans_per_second:8.0f} plans/s, "
            f"p50 {m.p50_ms:.2f} ms, p99 {m.p99_ms:.2f} ms{server} (n = {m.n})",
            flush=True,
        )


def tell_overload(o: Overload) -> None:
    """Prints the results under overload."""
    print(
        f"overload, {o.overload:.0f} times {o.capacity_plans_per_second:.0f} plans/s, deadline {o.deadline_ms} ms: "
        f"of {o.n} requests {o.answered} answered, {o.answered_in_time} of them in time, {o.refused} refused (p50 "
        f"{o.refused_p50_ms:.2f} ms, p99 {o.refused_p99_ms:.2f} ms), {o.late} late",
        flush=True,
    )


def medians(measured: Sequence[Measurement]) -> list[Measurement]:
    """Medians over turns, for each transport and number of clients."""
    turns: dict[tuple[str, int], list[Measurement]] = {}
    for m in measured:
        turns.setdefault((m.transport, m.clients), []).append(m)

    def over(of: Sequence[Measurement]) -> Measurement:
        rate, p50, p99 = np.median([(m.plans_per_second, m.p50_ms, m.p99_ms) for m in of], axis=0)
        servers = [m.server_ms_p50 for m in of if m.server_ms_p50 is not None]
        server, n = float(np.median(servers)) if servers else None, sum(m.n for m in of)
        return Measurement(of[0].transport, of[0].clients, float(rate), float(p50), float(p99), n, server)

    return [over(of) for of in turns.values()]


def tell_cost(measured: Sequence[Measurement]) -> None:
    """Prints the added latency with one client and the relative throughput with many, against the library."""

    def turns(transport: str, clients: int) -> list[Measurement]:
        return [m for m in measured if m.transport == transport and m.clients == clients]

    library = np.array([m.plans_per_second for m in turns(LIBRARY, MANY)])
    for transport in dict.fromkeys(m.transport for m in measured if m.transport != LIBRARY):
        added = median(np.array([m.p50_ms - (m.server_ms_p50 or 0) for m in turns(transport, FEW)]))
        share = median(np.array([m.plans_per_second for m in turns(transport, MANY)]) / library)
        print(
            f"{transport:20s} adds {added[0]:.2f} ms ({added[1]:.2f} to {added[2]:.2f}) to a plan at {FEW} client, and "
            f"with {MANY} has {share[0]:.0%} ({share[1]:.0%} to {share[2]:.0%}) of the plans/s of the library alone "
            f"(n = {len(library)})",
            flush=True,
        )


def rows(measured: Sequence[Measurement], command: str) -> list[Row]:
    """Rows of throughput with many clients and latency with one, against LitServe."""
    of = {(m.transport, m.clients): m for m in measured}
    found = []
    for transport in COMPARED:
        one, peer = of[transport, FEW], of[LITSERVE, FEW]
        ratio = peer.p50_ms / one.p50_ms
        name = f"{transport}, {FEW} client"
        found.append(Row(name, one.p50_ms, peer.p50_ms, LITSERVE, ratio, "ms", one.n, command))
        many, peer = of[transport, MANY], of[LITSERVE, MANY]
        ratio = many.plans_per_second / peer.plans_per_second
        name, rates = f"{transport}, {MANY} clients", (many.plans_per_second, peer.plans_per_second)
        found.append(Row(name, *rates, LITSERVE, ratio, "plans/s", many.n, command))
    return found
