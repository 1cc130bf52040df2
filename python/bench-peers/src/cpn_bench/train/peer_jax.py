"""Training in JAX: a step, with its gather, as one compiled function with donated weights.

Alternatives, measured for CPN at the paper's sizes, batch 128, one thread (samples per second of CPU time, medians of 4
interleaved turns on a busy machine): batched arrays with unrolled steps, as implemented here, 330; the gated product as
a sum instead of an einsum 321; a `vmap` over plans 239; `lax.scan` over the steps, with the sum, 151. Most of the time
goes into the convolutions: forward and backward of 256 images take 0.36 s of CPU time with channels last, 0.35 to 0.37
with channels first and with XLA's flags `ynn_fusion_type`, `use_onednn` and `fast_math`, 0.42 as matrix products of
patches.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import optax
import tyro
from jax import Array

from cpn_bench.harness import check_cores
from cpn_bench.model import ModelConfig
from cpn_bench.networks_jax import Weights, encode, improve, rollout
from cpn_bench.train.batches import Batches
from cpn_bench.train.contender import LEARNING_RATE, MAX_GRADIENT_NORM, serve

OPTIMIZER = optax.chain(optax.clip_by_global_norm(MAX_GRADIENT_NORM), optax.adam(LEARNING_RATE))


def outer_loss(
    weights: Weights, model: ModelConfig, observations: Array, goals: Array, demonstrated: Array, mask: Array
) -> Array:
    """Outer loss of a batch."""
    if model.sees_goal:
        x, goal = jnp.split(encode(weights, model, jnp.concatenate([observations, goals])), 2)
    else:
        x = goal = encode(weights, model, observations)
    planned = improve(weights, model, x, goal)[0] if model.plans else rollout(weights, model, x, goal)
    squared = jnp.square(planned - demonstrated) * mask[..., None]
    return squared.sum() / (mask.sum() * demonstrated.shape[-1])


def gather(data: Mapping[str, Array], row: int) -> tuple[Array, Array, Array, Array]:
    """Observations, goals, demonstrated actions and their mask of a batch."""
    observations, goals = (data["frames"][data[f"{name}_index"][row]] for name in ("observation", "goal"))
    return observations, goals, data["actions"][row], data["mask"][row]


@partial(jax.jit, static_argnums=2, donate_argnums=(0, 1))
def train_step(
    weights: Weights, state: optax.OptState, model: ModelConfig, data: Mapping[str, Array], row: int
) -> tuple[optax.Params, optax.OptState, Array]:
    """Training step on the batch of index `row`."""
    loss, gradients = jax.value_and_grad(outer_loss)(weights, model, *gather(data, row))
    updates, state = OPTIMIZER.update(gradients, state, weights)
    return optax.apply_updates(weights, updates), state, loss


class Trainer:
    """Weights with their optimiser state, and the batches."""

    def __init__(self, batches: Batches) -> None:
        self.model, self.count = batches.model, len(batches)
        self.data = jax.device_put(batches.arrays)
        self.weights = jax.device_put(batches.weights)
        self.state = OPTIMIZER.init(self.weights)

    def step(self, number: int) -> Callable[[], float]:
        """Starts a training step."""
        row = number % self.count
        self.weights, self.state, loss = train_step(self.weights, self.state, self.model, self.data, row)
        return loss.item


def main(batches: Path, method: str, threads: int) -> None:
    """Trains on request on standard input."""
    check_cores(threads)
    serve(Trainer(Batches.read(batches, method)))


if __name__ == "__main__":
    tyro.cli(main)
