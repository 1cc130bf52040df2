"""The peers compute what the golden tensors of `tests/golden/reference.py` say, so that all contenders do the same."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open

from cpn_bench_train import peer_jax, peer_torch
from cpn_bench_train.batches import WEIGHT, Batches, ModelConfig

GOLDEN = Path(__file__).resolve().parents[3] / "tests/golden"
Gradients = dict[str, NDArray[Any]]


def golden(method: str) -> tuple[Batches, float, Gradients]:
    """One batch in float64, its outer loss and gradients."""
    with safe_open(GOLDEN / f"{method}.safetensors", "numpy") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        model = ModelConfig.from_document(json.loads(file.metadata()["cpn"]))

    def of(prefix: str) -> dict[str, NDArray[Any]]:
        return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

    size = len(tensors["observations"])
    batches = Batches(
        model=model,
        weights=of(WEIGHT),
        frames=np.concatenate([tensors["observations"], tensors["goals"]]),
        observation_index=np.arange(size)[None],
        goal_index=np.arange(size, 2 * size)[None],
        actions=tensors["demonstrated"][None],
        mask=tensors["mask"][None],
    )
    return batches, tensors["outer_loss"].item(), of("gradient.")


def by_torch(batches: Batches, compiled: bool = False) -> tuple[float, Gradients]:
    trainer = peer_torch.Trainer(batches)
    # Traced as the peer is, without the minutes that generated code takes.
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
