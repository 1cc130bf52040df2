"""Rollouts by ONNX Runtime, exported from PyTorch: encoder and rollout, without updates, which need gradients."""

import tempfile
from pathlib import Path

import numpy as np
import onnxruntime
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor, nn

from cpn_bench.networks_torch import Agent, tensors
from cpn_bench.plan.contender import Plans, serve
from cpn_bench.plan.model import PlanModel


class Rollout(nn.Module):
    """Encoder and rollout as a module for export."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.agent = agent

    def forward(self, observations: Tensor, goals: Tensor) -> Tensor:
        """Actions `[B, H, A]` of observations `[B, 84, 84, 3]`, bytes, and goals `[B, Z]`."""
        return self.agent.rollout(self.agent.encoder(observations), goals)


def session(graph: nn.Module, inputs: dict[str, Tensor], threads: int) -> onnxruntime.InferenceSession:
    """Exports a module for the shapes of `inputs`, and loads it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "graph.onnx"
        torch.onnx.export(graph, kwargs=inputs, f=path, input_names=list(inputs), dynamo=True, verbose=False)
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


class Planner:
    """Planner for batches of one size, without updates."""

    def __init__(self, data: PlanModel, batch: int, threads: int) -> None:
        self.agent = Agent(data.model, tensors(data.weights)).requires_grad_(False)
        observations = torch.from_numpy(data.frames[:batch])
        inputs = {"observations": observations, "goals": self.agent.encoder(observations)}
        self.session = session(Rollout(self.agent).eval(), inputs, threads)

    def embed(self, goals: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Embeddings `[B, Z]` of goals `[B, 84, 84, 3]`."""
        return self.agent.encoder(torch.from_numpy(goals)).numpy()

    def plan(self, observations: NDArray[np.uint8], goals: NDArray[np.float32]) -> Plans:
        """Rollouts from observations `[B, 84, 84, 3]` to goals `[B, Z]`, without losses."""
        (actions,) = self.session.run(None, {"observations": observations, "goals": goals})
        return np.asarray(actions), np.empty((0, len(observations)), np.float32)


def main(model: Path, batch: int, threads: int) -> None:
    """Plans on request on standard input."""
    torch.set_num_threads(threads)
    data = PlanModel.read(model)
    serve(Planner(data, batch, threads), data, batch)


if __name__ == "__main__":
    tyro.cli(main)
