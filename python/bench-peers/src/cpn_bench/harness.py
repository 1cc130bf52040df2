"""Interleaved turns of contenders, which are processes that work on request, and the resulting rows."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import bootstrap

OURS, EAGER, COMPILED, JAX = "ours", "PyTorch eager", "torch.compile", "JAX"
ENVIRONMENT = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**40)}
"""Of every contender. glibc keeps freed memory, so that its pages are not faulted in again."""


@dataclass(frozen=True)
class Effort:
    """Amount of measurement."""

    turns: int
    turn_seconds: float


MAIN, CURVE, QUICK = Effort(12, 1.0), Effort(5, 1.0), Effort(3, 0.3)


@dataclass(frozen=True)
class Row:
    """Comparison of CPN with a peer; a ratio above 1 is in favour of CPN."""

    name: str
    ours: float
    peer: float
    peer_name: str
    ratio: float
    unit: str
    n: int
    command: str


class Contender:
    """Process that works on request, and idles otherwise."""

    def __init__(self, name: str, process: "subprocess.Popen[str]") -> None:
        self.name, self.process = name, process
        self.first = self._answer()
        """First answer, after the warm-up."""
        self.count = 1
        """Number of batches or steps in a turn."""

    def ask(self, question: object) -> dict[str, Any]:
        """Writes a line, and waits for the answer."""
        assert self.process.stdin  # noqa: S101 - for the type checker
        self.process.stdin.write(f"{question}\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout  # noqa: S101 - for the type checker
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name}: expected an answer, got none from {shlex.join(self.process.args)}")  # pyright: ignore[reportArgumentType]
        return json.loads(line)

    def calibrate(self, seconds: float) -> None:
        """Sets the count of a turn, so that the turn takes `seconds`."""
        self.count = 1
        while (taken := self.ask(self.count)["seconds"]) < seconds:
            self.count = max(self.count + 1, round(self.count * min(8.0, 1.1 * seconds / taken)))

    def turn(self) -> float:
        """Takes a turn; returns the rate, in batches or steps a second."""
        answer = self.ask(self.count)
        for field, value in answer.items():
            if not np.isfinite(value):
                raise RuntimeError(f"{field} of {self.name}: expected a finite number, got {value}")
        return self.count / answer["seconds"]


def pinned(threads: int) -> list[str]:
    """Prefix that binds a command to the first `threads` cores."""
    cores = sorted(os.sched_getaffinity(0))[:threads]
    return ["taskset", "--cpu-list", ",".join(map(str, cores))]


def check_cores(threads: int) -> None:
    """Checks the number of threads of a library that uses all available cores, as XLA does."""
    if (cores := len(os.sched_getaffinity(0))) != threads:
        raise ValueError(f"threads: expected {cores}, as the process may run on so many cores, got {threads}")


def module(name: str, *options: str) -> list[str]:
    """Command of a module of this package, in this environment."""
    return [sys.executable, "-m", f"cpn_bench.{name}", *options]


def torch_devices() -> list[str]:
    """Devices of libtorch to measure: the processor, and a CUDA device if available."""
    if torch.cuda.is_available():
        return ["cpu", "cuda"]
    print("no CUDA device: no rows for one", flush=True)
    return ["cpu"]


@contextmanager
def contenders(commands: Mapping[str, Sequence[str]], threads: int) -> Iterator[list[Contender]]:
    """Processes of commands by contender, warmed up one after the other, and bound to the same cores."""
    with ExitStack() as stack:
        started: list[Contender] = []
        for name, command in commands.items():
            process = subprocess.Popen(
                [*pinned(threads), *command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | ENVIRONMENT,
            )
            stack.enter_context(process)
            stack.callback(process.terminate)
            started.append(Contender(name, process))
        yield started


def agree(started: Sequence[Contender], what: str, setting: str, relative: float, absolute: float = 0) -> None:
    """Checks that the field `what` of the first answers is equal within the tolerances."""
    expected = np.asarray(started[0].first[what])
    for contender in started[1:]:
        got = np.asarray(contender.first[what])
        if got.shape != expected.shape or not np.allclose(got, expected, rtol=relative, atol=absolute):
            raise RuntimeError(f"first {what} of {contender.name}, {setting}: expected {expected}, got {got}")


def take_turns(started: Sequence[Contender], effort: Effort) -> NDArray[np.float64]:
    """Rates of all contenders in interleaved turns, `[turns, contenders]`."""
    for contender in started:
        contender.calibrate(effort.turn_seconds)
    return np.array([[contender.turn() for contender in started] for _ in range(effort.turns)])


def median(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Median over turns, with the bounds of its 95 % bootstrap interval."""
    interval = bootstrap((values,), np.median, rng=0).confidence_interval
    return float(np.median(values)), float(interval.low), float(interval.high)


def tell(name: str, peers: Sequence[str], rates: NDArray[np.float64], unit: str, command: str) -> list[Row]:
    """Prints and returns a row for each peer, from rates in `unit`, `[turns, 1 + peers]`, with those of CPN first."""
    own, *others = np.median(rates, axis=0)
    rows = []
    for column, (peer, other) in enumerate(zip(peers, others, strict=True), 1):
        ratio, low, high = median(rates[:, 0] / rates[:, column])
        print(
            f"{name:24s} {own:8.0f} {unit}, {peer:{max(map(len, peers))}s} {other:8.0f}: {ratio:6.2f} times "
            f"({low:.2f} to {high:.2f}, n = {len(rates)})",
            flush=True,
        )
        rows.append(Row(name, float(own), float(other), peer, ratio, unit, len(rates), command))
    return rows


def print_stages(name: str, what: str, stages: Mapping[str, float]) -> None:
    """Prints the time of CPN's stages, from their seconds."""
    total = sum(stages.values())
    parts = ", ".join(f"{stage} {1e3 * value:.3g} ms ({value / total:.0%})" for stage, value in stages.items())
    print(f"{name:24s} {what}: {parts}", flush=True)


def shortfalls(rows: Sequence[Row], floors: Mapping[tuple[str, str], float]) -> list[str]:
    """Messages for rows below their floors, the minimum ratios by name and peer."""
    return [
        f"{row.name} against {row.peer_name}: expected at least {floor} times, got {row.ratio:.2f}"
        for row in rows
        if (floor := floors.get((row.name, row.peer_name))) is not None and not row.ratio >= floor
    ]


def write(rows: Sequence[Row], path: Path) -> None:
    """Writes the rows as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
