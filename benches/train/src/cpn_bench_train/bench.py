"""Training steps of ours, PyTorch and JAX on the same batches in turns; writes runs/bench/train.json and train.svg.

make bench-train
"""

import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.stats import bootstrap

from cpn_bench_train import chart

COMMAND = "make bench-train"
METHODS = ("bc", "te-bc", "upn", "cpn")
EAGER, COMPILED, JAX = "PyTorch eager", "torch.compile", "JAX"
PEERS = {
    EAGER: ["cpn_bench_train.peer_torch"],
    COMPILED: ["cpn_bench_train.peer_torch", "--compile"],
    JAX: ["cpn_bench_train.peer_jax"],
}
GROWTH = {
    "latent": (32, 64, 128),
    "horizon": (1, 5, 10),
    "updates": (0, 1, 2),
    "batch": (32, 128, 512),
}
"""What grows of CPN, one at a time; the others are as in the paper, the batch 128.

Longer plans of an untrained model leap, and no two libraries round a leap alike: first losses could not be compared.
"""
BATCH = 128
FLOORS = {("bc", EAGER): 1.5, ("te-bc", EAGER): 1.5, ("cpn", EAGER): 4.0, ("cpn", JAX): 2.0}
"""Least ratios on one thread."""
LOSS_TOLERANCE = 1e-3
"""Relative, between the first losses of contenders."""
ENVIRONMENT = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**40)}
"""Of every contender: freed memory is kept, so that a step does not fault its activations' pages in anew."""


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    turns: int
    turn_seconds: float


MAIN, CURVE, QUICK = Effort(12, 1.0), Effort(5, 1.0), Effort(3, 0.3)


@dataclass(frozen=True)
class Setting:
    """What is trained."""

    method: str
    threads: int = 1
    grown: str | None = None
    """What differs from the paper's values."""
    value: int = 0

    @property
    def name(self) -> str:
        """For rows and people."""
        if self.grown:
            return f"{self.method}, {self.grown} {self.value}"
        return f"{self.method}, {self.threads} thread{'s'[: self.threads > 1]}"

    @property
    def batch(self) -> int:
        """B."""
        return self.value if self.grown == "batch" else BATCH


@dataclass(frozen=True)
class Row:
    """A comparison; a ratio above 1 says that we are better."""

    name: str
    ours: float
    peer: float
    peer_name: str
    ratio: float
    unit: str
    n: int
    command: str = COMMAND


class Contender:
    """A process that trains when asked, and else waits."""

    def __init__(self, name: str, process: "subprocess.Popen[str]") -> None:
        self.name, self.process = name, process
        self.first_loss = float(self._answer()["loss"])
        self.steps = 1

    def ask(self, question: object) -> dict[str, Any]:
        """Writes a line, and waits for one."""
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
        """Sets the steps of a turn, so that it takes so long."""
        self.steps = 1
        while (taken := self.ask(self.steps)["seconds"]) < seconds:
            self.steps = max(self.steps + 1, round(self.steps * min(8.0, 1.1 * seconds / taken)))

    def turn(self) -> float:
        """Steps a second."""
        answer = self.ask(self.steps)
        if not np.isfinite(answer["loss"]):
            raise RuntimeError(f"loss of {self.name}: expected a finite number, got {answer['loss']}")
        return self.steps / answer["seconds"]


@contextmanager
def contenders(ours: Sequence[str], peers: Sequence[str], batches: Path, setting: Setting) -> Iterator[list[Contender]]:
    """Processes of ours and of the peers, each warmed up in turn, all bound to the same cores."""
    cores = sorted(os.sched_getaffinity(0))[: setting.threads]
    pinned = ["taskset", "--cpu-list", ",".join(map(str, cores))]
    options = ["--batches", str(batches), "--method", setting.method, "--threads", str(setting.threads)]
    commands = {"ours": ours} | {name: [sys.executable, "-m", *PEERS[name]] for name in peers}
    with ExitStack() as stack:
        started: list[Contender] = []
        for name, command in commands.items():
            process = subprocess.Popen(
                [*pinned, *command, *options],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | ENVIRONMENT,
            )
            stack.enter_context(process)
            stack.callback(process.terminate)
            started.append(Contender(name, process))
        expected = started[0].first_loss
        for contender in started:
            if not np.isclose(contender.first_loss, expected, rtol=LOSS_TOLERANCE):
                got = contender.first_loss
                raise RuntimeError(f"first loss of {contender.name}, {setting.name}: expected {expected}, got {got}")
        yield started


def write_batches(ours: Sequence[str], path: Path, setting: Setting) -> None:
    """Has ours write the batches and weights of a setting."""
    options = ["--write-batches", str(path), "--method", setting.method]
    if setting.grown:
        options += [f"--{setting.grown}", str(setting.value)]
    subprocess.run([*ours, *options], check=True, stdout=sys.stderr)


def compare(ours: Sequence[str], peers: Sequence[str], setting: Setting, effort: Effort) -> tuple[list[Row], dict]:
    """Takes all in turns; answers a row for each peer, and the seconds of the stages of our step."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "batches.safetensors"
        write_batches(ours, path, setting)
        with contenders(ours, peers, path, setting) as started:
            for contender in started:
                contender.calibrate(effort.turn_seconds)
            turns = [[contender.turn() for contender in started] for _ in range(effort.turns)]
            stages = started[0].ask("stages")["stages"]
    rates = np.array(turns) * setting.batch
    own, *others = np.median(rates, axis=0)
    rows = []
    for column, (peer, other) in enumerate(zip(peers, others, strict=True), 1):
        ratios = rates[:, 0] / rates[:, column]
        interval = bootstrap((ratios,), np.median, rng=0).confidence_interval
        ratio = float(np.median(ratios))
        print(
            f"{setting.name:20s} {own:8.0f} samples/s, {peer:14s} {other:8.0f}: {ratio:6.2f} times "
            f"({interval.low:.2f} to {interval.high:.2f}, n = {effort.turns})",
            flush=True,
        )
        rows.append(Row(setting.name, float(own), float(other), peer, ratio, "samples/s", effort.turns))
    return rows, stages


def print_stages(setting: Setting, stages: Mapping[str, float]) -> None:
    """Where the time of one of our steps goes."""
    total = sum(stages.values())
    parts = ", ".join(f"{name} {1e3 * value:.1f} ms ({value / total:.0%})" for name, value in stages.items())
    print(f"{setting.name:20s} a step: {parts}", flush=True)


def shortfalls(rows: Sequence[Row]) -> list[str]:
    """What falls below its floor."""
    floors = {(Setting(method).name, peer): floor for (method, peer), floor in FLOORS.items()}
    return [
        f"{row.name} against {row.peer_name}: expected at least {floor} times, got {row.ratio:.2f}"
        for row in rows
        if (floor := floors.get((row.name, row.peer_name))) is not None and not row.ratio >= floor
    ]


def main(ours: str, out: Path, quick: bool = False) -> str | None:
    """Compares everything, and writes the rows after each setting; returns what is wrong with them.

    Args:
        ours: The command of our contender.
        out: Folder of the results.
        quick: A few short turns against eager PyTorch and JAX, without growth: to see that it runs, not to quote.
    """
    command = shlex.split(ours)
    rows: list[Row] = []

    def measure(peers: Sequence[str], setting: Setting, effort: Effort) -> dict[str, float]:
        found, stages = compare(command, peers, setting, effort)
        rows.extend(found)
        out.mkdir(parents=True, exist_ok=True)
        (out / "train.json").write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
        return stages

    peers, effort = ((EAGER, JAX), QUICK) if quick else ((EAGER, COMPILED, JAX), MAIN)
    settings = [Setting(method) for method in METHODS]
    if len(os.sched_getaffinity(0)) > 1:
        settings.append(Setting("cpn", threads=2))
    for setting in settings:
        print_stages(setting, measure(peers, setting, effort))
    if not quick:
        for grown, values in GROWTH.items():
            for value in values:
                measure((EAGER, JAX), Setting("cpn", grown=grown, value=value), CURVE)
        chart.draw(rows, GROWTH, out / "train.svg")
    print(f"wrote {out / 'train.json'}")
    return "\n".join(shortfalls(rows)) or None


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
