"""Training steps of CPN, PyTorch and JAX on the same batches; writes runs/bench/train.json and train.svg.

make bench-train
"""

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from cpn_bench import chart, harness
from cpn_bench.harness import COMPILED, CURVE, EAGER, JAX, MAIN, OURS, QUICK, Effort, Row, module

COMMAND = "make bench-train"
BFLOAT16 = "PyTorch eager, bfloat16"
"""With the encoder in bfloat16 by `torch.autocast`, as in CPN on processors with instructions for it."""
METHODS = ("bc", "te-bc", "upn", "cpn")
PEERS = {
    EAGER: module("train.peer_torch"),
    BFLOAT16: module("train.peer_torch", "--bfloat16"),
    COMPILED: module("train.peer_torch", "--compile"),
    JAX: module("train.peer_jax"),
}
GROWTH = {
    "latent": (32, 64, 128),
    "horizon": (1, 5, 10),
    "updates": (0, 1, 2),
    "batch": (32, 128, 512),
}
"""Varied sizes of CPN, one at a time; the others are the paper's, and the batch is 128.

Longer plans of an untrained model are chaotic and amplify rounding errors: first losses would not be comparable.
"""
BATCH = 128
UNIT = "samples/s"
LOSS_TOLERANCE = 1e-3
"""Relative tolerance between the first losses of contenders."""


@dataclass(frozen=True)
class Setting:
    """Setting of a comparison."""

    method: str
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
        name = f"{self.method}, {self.threads} thread{'s'[: self.threads > 1]}"
        return name if self.engine == "native" else f"{name}, engine {self.engine} on {self.device}"

    @property
    def batch(self) -> int:
        """B, the batch size."""
        return self.value if self.grown == "batch" else BATCH


FLOORS = {
    (Setting("bc").name, EAGER): 1.5,
    (Setting("te-bc").name, EAGER): 1.5,
    (Setting("cpn").name, EAGER): 4.0,
    (Setting("cpn").name, JAX): 2.0,
    (Setting("cpn", engine="torch").name, EAGER): 1.0,
}


def write_batches(ours: Sequence[str], path: Path, setting: Setting) -> None:
    """Writes the batches and weights of a setting, by CPN's bench."""
    options = ["--write-batches", str(path), "--method", setting.method]
    if setting.grown:
        options += [f"--{setting.grown}", str(setting.value)]
    subprocess.run([*ours, *options], check=True, stdout=sys.stderr)


def compare(ours: Sequence[str], peers: Sequence[str], setting: Setting, effort: Effort) -> tuple[list[Row], dict]:
    """Compares contenders in interleaved turns; returns a row for each peer, and the seconds of CPN's stages."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "batches.safetensors"
        write_batches(ours, path, setting)
        options = ["--batches", str(path), "--method", setting.method, "--threads", str(setting.threads)]
        options += ["--device", setting.device] if setting.device != "cpu" else []
        engine = ["--engine", setting.engine] if setting.engine != "native" else []
        commands = {OURS: [*ours, *options, *engine]} | {peer: [*PEERS[peer], *options] for peer in peers}
        with harness.contenders(commands, setting.threads) as started:
            harness.agree(started, "loss", setting.name, LOSS_TOLERANCE)
            rates = harness.take_turns(started, effort) * setting.batch
            stages = started[0].ask("stages")["stages"]
    return harness.tell(setting.name, peers, rates, UNIT, COMMAND), stages


def main(ours: str, out: Path, quick: bool = False) -> str | None:
    """Runs all comparisons, and writes the rows after each; returns the shortfalls.

    Args:
        ours: Command of CPN's contender.
        out: Folder of the results.
        quick: Few short turns, only against eager PyTorch and JAX, without varied sizes: a smoke test.
    """
    command = shlex.split(ours)
    rows: list[Row] = []

    def measure(peers: Sequence[str], setting: Setting, effort: Effort) -> dict[str, float]:
        found, stages = compare(command, peers, setting, effort)
        rows.extend(found)
        harness.write(rows, out / "train.json")
        return stages

    peers, effort = ((EAGER, JAX), QUICK) if quick else ((EAGER, BFLOAT16, COMPILED, JAX), MAIN)
    settings = [Setting(method) for method in METHODS]
    if len(os.sched_getaffinity(0)) > 1:
        settings.append(Setting("cpn", threads=2))
    for setting in settings:
        harness.print_stages(setting.name, "a step", measure(peers, setting, effort))
    for device in harness.torch_devices():
        setting = Setting("cpn", engine="torch", device=device)
        harness.print_stages(setting.name, "a step", measure((EAGER,), setting, effort))
    if not quick:
        for grown, values in GROWTH.items():
            for value in values:
                measure((EAGER, JAX), Setting("cpn", grown=grown, value=value), CURVE)
        chart.draw(rows, GROWTH, f"{UNIT}, one thread", out / "train.svg")
    print(f"wrote {out / 'train.json'}")
    return "\n".join(harness.shortfalls(rows, FLOORS)) or None


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
