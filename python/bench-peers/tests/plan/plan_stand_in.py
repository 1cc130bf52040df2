"""Stand-in for CPN's bench in tests of the harness: writes a random model, and plans with PyTorch."""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from safetensors.numpy import save_file

from cpn_bench.plan.model import PlanModel
from cpn_bench.plan.peer_torch import Planner

FRAMES, CHANNELS, KERNEL, LATENT, HIDDEN, GATE_HIDDEN, ACTIONS, UPDATES = 64, 4, 8, 8, 6, 5, 4, 2


def write(path: Path, method: str, horizon: int = 3) -> None:
    """Writes a small model with observations and goals."""
    rng = np.random.default_rng(0)
    weights: dict[str, NDArray[np.float32]] = {"step_size": np.ones((), np.float32)}

    def layer(name: str, *shape: int) -> None:
        bound = np.prod(shape[1:]) ** -0.5
        weights[f"{name}.weight"] = rng.uniform(-bound, bound, shape).astype(np.float32)
        weights[f"{name}.bias"] = rng.uniform(-bound, bound, shape[0]).astype(np.float32)

    def dense(name: str, outputs: int, inputs: int) -> None:
        layer(name, outputs, inputs)
        if method == "cpn":
            for gate, gates in (("u", outputs * inputs), ("v", outputs)):
                layer(f"{name}.{gate}.hidden", GATE_HIDDEN, inputs)
                layer(f"{name}.{gate}.output", gates, GATE_HIDDEN)

    size = 84 // KERNEL
    layer("encoder.conv.0", CHANNELS, 3, KERNEL, KERNEL)
    layer("encoder.linear", LATENT, CHANNELS * size * size)
    layer("encoder.norm", LATENT)
    dense("network.trunk", HIDDEN, LATENT * (2 if method == "cpn" else 1))
    dense("network.policy_0", HIDDEN, HIDDEN)
    dense("network.policy_1", ACTIONS, HIDDEN)
    dense("network.dynamics_0", HIDDEN, HIDDEN + ACTIONS)
    dense("network.dynamics_1", LATENT, HIDDEN)
    tensors: dict[str, NDArray[Any]] = {f"weight.{name}": weight for name, weight in weights.items()}
    tensors |= {name: rng.integers(0, 256, (FRAMES, 84, 84, 3), np.uint8) for name in ("frames", "goals")}
    convolution = {"channels": CHANNELS, "kernel": KERNEL, "stride": KERNEL}
    encoder = {"kind": "image", "convolutions": [convolution], "latent": LATENT, "layer_norm": True}
    model = {"method": method, "encoder": encoder, "hidden": HIDDEN, "gate_hidden": GATE_HIDDEN, "actions": ACTIONS}
    model |= {"horizon": horizon, "updates": UPDATES}
    save_file(tensors, path, metadata={"cpn": json.dumps(model)})


def serve(data: PlanModel, batch: int, action_error: float) -> None:
    """Answers requests as CPN's bench does."""
    planner = Planner(data)
    observations, goals = data.frames[:batch], planner.embed(data.goals[:batch])
    actions = planner.plan(observations, goals)[0][0] + action_error
    print(json.dumps({"ready": True, "actions": actions.tolist()}), flush=True)
    for line in sys.stdin:
        if line == "stages\n":
            print(json.dumps({"stages": {"encoder": 0.001, "planner": 0.003}}), flush=True)
            continue
        start = time.perf_counter()
        for _ in range(int(line)):
            planner.plan(observations, goals)
        print(json.dumps({"seconds": time.perf_counter() - start}), flush=True)


def main(
    write_model: Path | None = None,
    method: str = "cpn",
    horizon: int = 3,
    model: Path | None = None,
    batch: int = 1,
    threads: int = 1,
    action_error: float = 0,
) -> None:
    """Runs with the options of CPN's bench; the error of the actions is absolute."""
    torch.set_num_threads(threads)
    if write_model:
        write(write_model, method, horizon)
    elif model:
        serve(PlanModel.read(model), batch, action_error)


if __name__ == "__main__":
    tyro.cli(main)
