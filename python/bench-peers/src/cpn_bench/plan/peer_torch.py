"""Planner in PyTorch, eager or compiled, in the style of its documentation.

Alternatives, measured for CPN at the paper's sizes, one thread, with glibc told to keep freed memory (ms a batch,
medians of 7 turns on a busy machine). Eager, batch 1 and 64: 5.9 and 34.6 as implemented here; the gated product as
`baddbmm` 5.4 and 42.3, as `matmul` 5.5 and 47.1; with channels first 6.4 and 36.3; `torch.func.grad` instead of
`autograd.grad` 9.8 and 39.2. Compiled as one graph, encoder and inner gradient in it: 1.83 and 23.6; with `cpp_wrapper`
1.40 and 23.5, as implemented here; with `freezing` 4.48 and 24.7.
"""

from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

from cpn_bench.networks_torch import Agent, tensors
from cpn_bench.plan.contender import Plans, serve
from cpn_bench.plan.model import PlanModel


class Planner:
    """Planner of an agent with frozen weights."""

    def __init__(self, data: PlanModel, compiled: bool = False, device: str = "cpu") -> None:
        self.device = device
        self.agent = Agent(data.model, tensors(data.weights)).requires_grad_(False).to(device)
        self.plan_tensors = (
            torch.compile(self.traced, fullgraph=True, options={"cpp_wrapper": True}) if compiled else self.eager
        )

    @torch.no_grad()
    def embed(self, goals: NDArray[np.uint8]) -> Tensor:
        """Embeddings `[B, Z]` of goals `[B, 84, 84, 3]`."""
        return self.agent.encoder(torch.from_numpy(goals).to(self.device))

    @torch.no_grad()
    def plan(self, observations: NDArray[np.uint8], goals: Tensor) -> Plans:
        """Plans from observations `[B, 84, 84, 3]` to goals `[B, Z]`."""
        actions, losses = self.plan_tensors(torch.from_numpy(observations).to(self.device), goals)
        return actions.cpu().numpy(), losses.cpu().numpy()

    def eager(self, observations: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Encoder, rollout, and updates, with a graph of the inner loss only."""
        x = self.agent.encoder(observations)
        actions, losses = self.agent.rollout(x, goals), []
        for _ in range(self.agent.model.updates):
            with torch.enable_grad():
                leaf = actions.requires_grad_()
                before = self.agent.inner_losses(leaf, x, goals)
                (gradient,) = torch.autograd.grad(before.sum(), leaf)
            actions = leaf.detach() - self.agent.step_size * gradient
            losses.append(before.detach())
        return actions, torch.stack([*losses, self.agent.inner_losses(actions, x, goals)])

    def traced(self, observations: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Computation of `eager` with `torch.func.grad`, which the compiler can trace."""

        def inner_loss(actions: Tensor) -> tuple[Tensor, Tensor]:
            losses = self.agent.inner_losses(actions, x, goals)
            return losses.sum(), losses

        x = self.agent.encoder(observations)
        actions, losses = self.agent.rollout(x, goals), []
        for _ in range(self.agent.model.updates):
            gradient, before = torch.func.grad(inner_loss, has_aux=True)(actions)
            actions = actions - self.agent.step_size * gradient
            losses.append(before)
        return actions, torch.stack([*losses, self.agent.inner_losses(actions, x, goals)])


def main(
    model: Path,
    batch: int,
    threads: int,
    compile: bool = False,  # noqa: A002 - the option's name
    device: str = "cpu",
) -> None:
    """Plans on request on standard input."""
    torch.set_num_threads(threads)
    data = PlanModel.read(model)
    serve(Planner(data, compiled=compile, device=device), data, batch)


if __name__ == "__main__":
    tyro.cli(main)
