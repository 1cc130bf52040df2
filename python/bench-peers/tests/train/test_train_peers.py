"""Losses and gradients of the peers against the golden tensors of `tests/golden/reference.py`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cpn_bench.model import read
from cpn_bench.train import peer_jax, peer_torch
from cpn_bench.train.batches import Batches

GOLDEN = Path(__file__).resolve().parents[4] / "tests/golden"
GRADIENT = "gradient."
Gradients = dict[str, NDArray[Any]]


def golden(method: str) -> tuple[Batches, float, Gradients]:
    """One batch in float64, with its outer loss and gradients."""
    model, weights, tensors = read(GOLDEN / f"{method}.safetensors")
    size = len(tensors["observations"])
    batches = Batches(
        model=model,
        weights=weights,
        frames=np.concatenate([tensors["observations"], tensors["goals"]]),
        observation_index=np.arange(size)[None],
        goal_index=np.arange(size, 2 * size)[None],
        actions=tensors["demonstrated"][None],
        mask=tensors["mask"][None],
    )
    gradients = {name.removeprefix(GRADIENT): value for name, value in tensors.items() if name.startswith(GRADIENT)}
    return batches, tensors["outer_loss"].item(), gradients


def by_torch(batches: Batches, compiled: bool = False) -> tuple[float, Gradients]:
    trainer = peer_torch.Trainer(batches)
    # Traced like the peer, without code generation, which takes minutes.
    outer_loss = torch.compile(trainer.agent, fullgraph=True, backend="aot_eager") if compiled else trainer.agent
    loss = outer_loss(*trainer.batch(0))
    weights = dict(trainer.agent.named_parameters())
    gradients = torch.autograd.grad(loss, list(weights.values()))
    return loss.item(), {name: gradient.numpy() for name, gradient in zip(weights, gradients, strict=True)}


def by_compiled_torch(batches: Batches) -> tuple[float, Gradients]:
    return by_torch(batches, compiled=True)


def by_jax(batches: Batches) -> tuple[float, Gradients]:
    with jax.enable_x64(True):
        trainer = peer_jax.Trainer(batches)
        loss, gradients = jax.value_and_grad(peer_jax.outer_loss)(
            trainer.weights, trainer.model, *peer_jax.gather(trainer.data, 0)
        )
        return loss.item(), {name: np.asarray(gradient) for name, gradient in gradients.items()}


@pytest.mark.parametrize("method", ["upn", "cpn"])
@pytest.mark.parametrize("peer", [by_torch, by_compiled_torch, by_jax])
def test_loss_and_gradients_are_golden(peer: Callable[[Batches], tuple[float, Gradients]], method: str) -> None:
    batches, expected_loss, expected = golden(method)
    loss, gradients = peer(batches)
    assert loss == pytest.approx(expected_loss, rel=1e-9)
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        np.testing.assert_allclose(gradient, expected[name], rtol=1e-7, atol=1e-9, err_msg=name)
