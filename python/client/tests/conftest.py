import asyncio
import inspect
import os
import random
import re
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import cpn_client

ROOT = Path(__file__).resolve().parents[3]
PROGRAMS = Path(os.environ.get("CPN_PROGRAMS", ROOT / "target/debug"))
FRAME, GOAL = ROOT / "examples/frame.png", ROOT / "examples/goal.png"

# One runtime for all tests of the process, as TLS needs it; see `cpn_client.zenoh`.
os.environ["ZENOH_RUNTIME"] = "(rx: (worker_threads: 1), tx: (handover: rx))"


def free_port() -> int:
    """Free port, below the ephemeral ports of the system, so that it stays free between two planners."""
    while True:
        port = random.randrange(20_000, 32_000)  # noqa: S311
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port


class PlannerProcess:
    """Planner with the shipped checkpoints, which may be killed and started again at the same addresses."""

    def __init__(self, *options: str, scheme: str = "tcp", host: str = "127.0.0.1") -> None:
        zenoh, grpc = free_port(), free_port()
        self.zenoh, self.grpc = f"{scheme}/{host}:{zenoh}", f"grpc{'s' * (scheme == 'tls')}://{host}:{grpc}"
        self._command = [str(PROGRAMS / "cpn-planner"), "--models-dir", str(ROOT / "models"), *options]
        self._command += ["--listen", self.zenoh, "--grpc-listen", f"127.0.0.1:{grpc}"]
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._command, stderr=subprocess.PIPE, text=True)
        assert self._process.stderr
        log = ""
        for line in self._process.stderr:
            log += line
            if re.search("planner is ready", line):
                return
        pytest.fail(log)

    def freeze(self) -> None:
        self._process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self._process.pid, os.WSTOPPED)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@contextmanager
def running(*options: str, **addresses: str) -> Iterator[PlannerProcess]:
    process = PlannerProcess(*options, **addresses)
    try:
        yield process
    finally:
        process.kill()


@pytest.fixture(scope="session")
def process() -> Iterator[PlannerProcess]:
    with running() as process:
        yield process


@pytest.fixture
def restartable() -> Iterator[PlannerProcess]:
    """Planner of one test, which may kill it."""
    with running() as process:
        yield process


class Blocking:
    """Blocking face of an asynchronous planner or episode."""

    def __init__(self, loop: asyncio.AbstractEventLoop, target: object) -> None:
        self._loop, self._target = loop, target

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        value = getattr(self._target, name)
        if not inspect.ismethod(value):
            return value
        return lambda *args, **options: self._settled(value(*args, **options))

    def _settled(self, result: Any) -> Any:  # noqa: ANN401
        if inspect.isawaitable(result):
            return self._loop.run_until_complete(result)
        return Blocking(self._loop, result) if isinstance(result, cpn_client.AsyncEpisode) else result

    def __enter__(self) -> "Blocking":
        return self

    def __exit__(self, *exception: object) -> None:
        getattr(self._target, "__exit__")(*exception)  # noqa: B009


Connect = Callable[..., Any]


@dataclass
class Variant:
    """Transport and kind of a client under test."""

    transport: str
    kind: str

    def address(self, process: PlannerProcess) -> str:
        return process.zenoh if self.transport == "zenoh" else process.grpc


@pytest.fixture(params=["zenoh-sync", "zenoh-async", "grpc-sync", "grpc-async"])
def variant(request: pytest.FixtureRequest) -> Variant:
    return Variant(*request.param.split("-"))


@pytest.fixture
def connect(variant: Variant) -> Iterator[Connect]:
    """Connects a planner, blocking or not, until the test's end."""
    with ExitStack() as stack:
        loop = asyncio.new_event_loop()
        stack.callback(loop.close)

        def connect_sync(address: str, **options: Any) -> cpn_client.Planner:  # noqa: ANN401
            return stack.enter_context(cpn_client.connect(address, **options))

        def connect_async(address: str, **options: Any) -> Blocking:  # noqa: ANN401
            context = cpn_client.connect_async(address, **options)
            planner = loop.run_until_complete(context.__aenter__())
            stack.callback(lambda: loop.run_until_complete(context.__aexit__(None, None, None)))
            return Blocking(loop, planner)

        yield connect_sync if variant.kind == "sync" else connect_async


@pytest.fixture
def planner(connect: Connect, variant: Variant, process: PlannerProcess) -> cpn_client.Planner:
    """Planner of each transport; an asynchronous one is made blocking."""
    return connect(variant.address(process))
