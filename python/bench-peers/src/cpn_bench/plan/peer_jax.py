"""Planner in JAX: encoder, rollout and updates as one compiled function.

Alternatives, measured for CPN at the paper's sizes, one thread (ms a batch, medians of 7 turns on a busy machine),
batch 1 and 64: with the weights as constants of the function, as implemented here, 0.73 and 39.5; as its arguments 1.58
and 40.1, and then with the gated product as a sum 1.97 and 42.3, with a `vmap` over plans 1.11 and 38.0.
"""

from pathlib import Path

import jax
import numpy as np
import tyro
from jax import Array
from numpy.typing import NDArray

from cpn_bench import networks_jax
from cpn_bench.harness import check_cores
from cpn_bench.plan.contender import Plans, serve
from cpn_bench.plan.model import PlanModel


class Planner:
    """Planner of compiled functions."""

    def __init__(self, data: PlanModel) -> None:
        weights, model = jax.device_put(data.weights), data.model

        def encode(images: Array) -> Array:
            return networks_jax.encode(weights, model, images)

        def plan(observations: Array, goals: Array) -> tuple[Array, Array]:
            return networks_jax.plan(weights, model, encode(observations), goals)

        self.encode, self.plan_arrays = jax.jit(encode), jax.jit(plan)

    def embed(self, goals: NDArray[np.uint8]) -> Array:
        """Embeddings `[B, Z]` of goals `[B, 84, 84, 3]`."""
        return self.encode(goals)

    def plan(self, observations: NDArray[np.uint8], goals: Array) -> Plans:
        """Plans from observations `[B, 84, 84, 3]` to goals `[B, Z]`."""
        actions, losses = self.plan_arrays(observations, goals)
        return np.asarray(actions), np.asarray(losses)


def main(model: Path, batch: int, threads: int) -> None:
    """Plans on request on standard input."""
    check_cores(threads)
    data = PlanModel.read(model)
    serve(Planner(data), data, batch)


if __name__ == "__main__":
    tyro.cli(main)
