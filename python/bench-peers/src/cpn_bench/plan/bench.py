"""Planning by CPN, PyTorch, JAX and ONNX Runtime, then by services; writes plan.json, plan.svg and load.svg.

make bench-plan
"""

import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import tyro

from cpn_bench import chart, harness
from cpn_bench.harness import COMPILED, CURVE, EAGER, JAX, MAIN, OURS, QUICK, Effort, Row, module
from cpn_bench.plan import load_chart, service
from cpn_bench.plan.model import PlanModel

COMMAND = "make bench-plan"
ONNX = "ONNX Runtime (forward only)"
PEERS = {
    EAGER: module("plan.peer_torch"),
    COMPILED: module("plan.peer_torch", "--compile"),
    JAX: module("plan.peer_jax"),
    ONNX: module("plan.peer_onnx"),
}
BATCHES = (1, 64)
GROWTH = {
    "latent": (32, 64, 128),
    "horizon": (1, 5, 10, 20),
    "updates": (0, 1, 2, 4),
}
"""Varied sizes of CPN, one at a time; the others are the paper's, and the batch is 1."""
UNIT = "plans/s"
BFLOAT16 = "ours, bfloat16"
RELATIVE_TOLERANCE = ABSOLUTE_TOLERANCE = 1e-3
"""Tolerances between the first plans of contenders."""


@dataclass(frozen=True)
class Setting:
    """Setting of a comparison."""

    method: str
    batch: int = 1
    threads: int = 1
    engine: str = "native"
    device: str = "cpu"
    grown: str | None = None
    """Name of the varied size."""
    value: int = 0

    @property
    def name(self) -> str:
        """Name in rows and output."""
        if self.grown:
            return f"{self.method}, {self.grown} {self.value}"
        name = f"{self.method}, batch {self.batch}, {self.threads} thread{'s'[: self.threads > 1]}"
        return name if self.engine == "native" else f"{name}, engine {self.engine} on {self.device}"


FLOORS = {
    (Setting("cpn").name, EAGER): 20.0,
    (Setting("cpn").name, JAX): 2.0,
    (Setting("cpn", batch=64).name, EAGER): 2.0,
    (Setting("cpn", batch=64).name, COMPILED): 2.0,
    (Setting("cpn", batch=64).name, JAX): 2.0,
}
"""Minimum ratios on one thread. ONNX Runtime has none, since it computes no updates."""


@contextmanager
def written_model(ours: Sequence[str], setting: Setting) -> Iterator[Path]:
    """File of a setting, written by CPN's bench."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        options = ["--write-model", str(path), "--method", setting.method]
        if setting.grown:
            options += [f"--{setting.grown}", str(setting.value)]
        subprocess.run([*ours, *options], check=True, stdout=sys.stderr)
        yield path


def compare(ours: Sequence[str], peers: Sequence[str], setting: Setting, effort: Effort) -> list[Row]:
    """Compares contenders in interleaved turns, and prints the results; returns a row for each peer."""
    with written_model(ours, setting) as path:
        options = ["--model", str(path), "--batch", str(setting.batch), "--threads", str(setting.threads)]
        options += ["--device", setting.device] if setting.device != "cpu" else []
        engine = ["--engine", setting.engine] if setting.engine != "native" else []
        commands = {OURS: [*ours, *options, *engine]} | {peer: [*PEERS[peer], *options] for peer in peers}
        with harness.contenders(commands, setting.threads) as started:
            planners = [contender for contender in started if contender.name != ONNX]
            harness.agree(planners, "actions", setting.name, RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE)
            rates = harness.take_turns(started, effort) * setting.batch
            stages = started[0].ask("stages")["stages"]
        operations = PlanModel.read(path).operations
    rows = harness.tell(setting.name, peers, rates, UNIT, COMMAND)
    harness.print_stages(setting.name, f"a batch of {setting.batch}", stages)
    rate = operations_per_second(setting.threads)
    print(
        f"{setting.name:24s} the {operations / 1e6:.1f} million operations of a plan's matrix products take "
        f"{1e3 * operations / rate:.3f} ms at the {rate / 1e9:.0f} GFLOP/s of a large product",
        flush=True,
    )
    return rows


def compare_precisions(ours: Sequence[str], effort: Effort) -> list[Row]:
    """Compares CPN in bfloat16 with CPN in float32, and prints the differences of the shipped model's actions."""
    setting = Setting("cpn", max(BATCHES))
    checkpoint = str(Path(__file__).resolve().parents[5] / "models/cpn.safetensors")
    with written_model([*ours, "--checkpoint", checkpoint], setting) as path:
        options = ["--model", str(path), "--batch", str(setting.batch)]
        commands = {BFLOAT16: [*ours, *options, "--bfloat16"], OURS: [*ours, *options]}
        with harness.contenders(commands, setting.threads) as started:
            half, full = (np.clip(contender.ask("plans")["plans"], -1, 1) for contender in started)
            rates = harness.take_turns(started, effort) * setting.batch
    rows = harness.tell(f"{setting.name}, bfloat16", [OURS], rates, UNIT, COMMAND)
    first, whole = np.abs(half - full)[:, 0], np.abs(half - full)
    print(
        f"{setting.name}, bfloat16: actions, from -1 to 1, of {len(full)} plans between pictures of noise differ by "
        f"{whole.mean():.4f} on average and {whole.max():.3f} at most, the first of each by {first.mean():.4f} and "
        f"{first.max():.3f}",
        flush=True,
    )
    return rows


@cache
def operations_per_second(threads: int) -> float:
    """Floating-point operations a second of this machine on `threads` cores."""
    command = [*harness.pinned(threads), *module("plan.arithmetic", "--threads", str(threads))]
    measured = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return json.loads(measured.stdout)["operations_per_second"]


def settings() -> list[Setting]:
    """Settings for all peers, on one core and, if available, on two."""
    threads = (1, 2)[: len(os.sched_getaffinity(0))]
    return [Setting("cpn", batch, count) for batch in BATCHES for count in threads] + [Setting("upn")]


def main(ours: str, serve: str, out: Path, quick: bool = False) -> str | None:
    """Runs all comparisons, and writes the rows after each; returns the shortfalls.

    Args:
        ours: Command of CPN's contender.
        serve: Command that measures CPN's service.
        out: Folder of the results.
        quick: Few short turns, only against eager PyTorch and JAX, without varied sizes: a smoke test.
    """
    command = shlex.split(ours)
    rows: list[Row] = []

    def keep(found: list[Row]) -> None:
        rows.extend(found)
        harness.write(rows, out / "plan.json")

    peers, effort = ((EAGER, JAX), QUICK) if quick else (tuple(PEERS), MAIN)
    for setting in settings():
        keep(compare(command, peers, setting, effort))
    for device in harness.torch_devices():
        keep(compare(command, (EAGER,), Setting("cpn", max(BATCHES), engine="torch", device=device), effort))
    keep(compare_precisions(command, effort))
    if not quick:
        for grown, values in GROWTH.items():
            for value in values:
                keep(compare(command, (EAGER, JAX), Setting("cpn", grown=grown, value=value), CURVE))
        chart.draw(rows, GROWTH, f"{UNIT}, batch 1, one thread", out / "plan.svg")
    with written_model(command, Setting("cpn")) as path:
        load = QUICK if quick else CURVE
        turns, overload = service.ours(shlex.split(serve), load.turn_seconds, load.turns)
        measured = service.medians(turns) + service.litserve(path, load.turns * load.turn_seconds)
    service.tell(measured)
    service.tell_cost(turns)
    service.tell_overload(overload)
    keep(service.rows(measured, COMMAND))
    load_chart.draw(measured, out / "load.svg")
    print(f"wrote {out / 'plan.json'}")
    return "\n".join(harness.shortfalls(rows, FLOORS)) or None


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
