"""Stand-in for CPN's bench in tests of the harness: writes random batches, and trains with PyTorch."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from safetensors.numpy import save_file

from cpn_bench.train.batches import Batches
from cpn_bench.train.peer_torch import Trainer

BATCHES, BATCH, FRAMES, LATENT, HIDDEN, ACTIONS = 3, 4, 7, 8, 6, 4


def write(path: Path) -> None:
    """Writes a small BC model with batches."""
    rng = np.random.default_rng(0)

    def noise(*shape: int) -> NDArray[np.float32]:
        return rng.normal(0, 0.1, shape).astype(np.float32)

    weights = {
        "step_size": np.ones((), np.float32),
        "encoder.conv.0.weight": noise(4, 3, 8, 8),
        "encoder.conv.0.bias": noise(4),
        "encoder.linear.weight": noise(LATENT, 4 * 10 * 10),
        "encoder.linear.bias": noise(LATENT),
        "encoder.norm.weight": np.ones(LATENT, np.float32),
        "encoder.norm.bias": noise(LATENT),
    }
    shapes = {"trunk": (HIDDEN, LATENT), "policy_0": (HIDDEN, HIDDEN), "policy_1": (ACTIONS, HIDDEN)}
    for name, (outputs, inputs) in shapes.items():
        weights |= {f"network.{name}.weight": noise(outputs, inputs), f"network.{name}.bias": noise(outputs)}
    tensors = {f"weight.{name}": weight for name, weight in weights.items()} | {
        "frames": rng.integers(0, 256, (FRAMES, 84, 84, 3), np.uint8),
        "observation_index": rng.integers(0, FRAMES, (BATCHES, BATCH)),
        "goal_index": rng.integers(0, FRAMES, (BATCHES, BATCH)),
        "actions": noise(BATCHES, BATCH, 1, ACTIONS),
        "mask": np.ones((BATCHES, BATCH, 1), np.float32),
    }
    encoder = {
        "kind": "image",
        "convolutions": [{"channels": 4, "kernel": 8, "stride": 8}],
        "latent": LATENT,
        "layer_norm": True,
    }
    model = {"method": "bc", "encoder": encoder, "hidden": HIDDEN, "gate_hidden": 1, "actions": ACTIONS}
    model |= {"horizon": 1, "updates": 0}
    save_file(tensors, path, metadata={"cpn": json.dumps(model)})


def serve(trainer: Trainer, loss_error: float) -> None:
    """Answers requests as CPN's bench does."""
    print(json.dumps({"ready": True, "loss": trainer.step(0)() * (1 + loss_error)}), flush=True)
    for line in sys.stdin:
        if line == "stages\n":
            print(json.dumps({"stages": {"everything": 0.001}}), flush=True)
            continue
        start = time.perf_counter()
        losses = [trainer.step(number)() for number in range(int(line))]
        print(json.dumps({"seconds": time.perf_counter() - start, "loss": losses[-1]}), flush=True)


def main(
    method: str,
    write_batches: Path | None = None,
    batches: Path | None = None,
    threads: int = 1,
    loss_error: float = 0,
) -> None:
    """Runs with the options of CPN's bench; the error of the loss is relative."""
    torch.set_num_threads(threads)
    if write_batches:
        write(write_batches)
    elif batches:
        serve(Trainer(Batches.read(batches, method)), loss_error)


if __name__ == "__main__":
    tyro.cli(main)
