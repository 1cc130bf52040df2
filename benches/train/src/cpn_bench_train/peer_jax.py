"""The methods in JAX: a whole training step, its gather included, as one compiled function with donated weights.

Tried for CPN at the paper's sizes, batch 128, one thread (samples per second of CPU time, medians of 4 interleaved
turns on a busy machine): batched arrays with unrolled steps 330, which is what stands here; the gated product as a sum
instead of an einsum 321; a `vmap` over plans 239; `lax.scan` over the steps, with the sum, 151. Most of the time goes
into the convolutions: forward and backward of 256 pictures take 0.36 s of CPU time with channels last, 0.35 to 0.37
with channels first and with XLA's flags `ynn_fusion_type`, `use_onednn` and `fast_math`, 0.42 as matrix products of
patches.
"""

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import optax
import tyro
from jax import Array, lax

from cpn_bench_train.batches import Batches, ModelConfig
from cpn_bench_train.contender import LEARNING_RATE, MAX_GRADIENT_NORM, serve

Weights = dict[str, Array]
OPTIMIZER = optax.chain(optax.clip_by_global_norm(MAX_GRADIENT_NORM), optax.adam(LEARNING_RATE))


def linear(weights: Weights, name: str, x: Array) -> Array:
    """`[B, inputs]` to `[B, outputs]`."""
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def gate(weights: Weights, name: str, x: Array) -> Array:
    """An attenuation network, with one hidden layer: `[B, inputs]` to `[B, outputs]` in (0, 1)."""
    return jax.nn.sigmoid(linear(weights, f"{name}.output", jax.nn.relu(linear(weights, f"{name}.hidden", x))))


def dense(weights: Weights, name: str, x: Array) -> Array:
    """A linear layer, neuromodulated where it has gates."""
    if f"{name}.u.hidden.weight" not in weights:
        return linear(weights, name, x)
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    attenuated = gate(weights, f"{name}.u", x).reshape(-1, *weight.shape) * weight
    return jnp.einsum("boi,bi->bo", attenuated, x) + gate(weights, f"{name}.v", x) * bias


def encode(weights: Weights, model: ModelConfig, images: Array) -> Array:
    """`[B, 84, 84, 3]` bytes to `[B, Z]`."""
    y = images.astype(weights["encoder.linear.weight"].dtype) / 255 - 0.5
    for number, stride in enumerate(model.strides):
        name = f"encoder.conv.{number}"
        layout = ("NHWC", "OIHW", "NHWC")
        y = lax.conv_general_dilated(y, weights[f"{name}.weight"], (stride, stride), "VALID", dimension_numbers=layout)
        y = jax.nn.relu(y + weights[f"{name}.bias"])
    # The linear layer's weights are those of an encoder with channels first.
    x = linear(weights, "encoder.linear", y.transpose(0, 3, 1, 2).reshape(len(y), -1))
    if model.layer_norm:
        x = jax.nn.standardize(x, epsilon=1e-5) * weights["encoder.norm.weight"] + weights["encoder.norm.bias"]
    return x


def features(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """What the trunk makes of a state."""
    inputs = jnp.concatenate([x, goal], 1) if model.goal_conditioned else x
    return jax.nn.relu(dense(weights, "network.trunk", inputs))


def policy(weights: Weights, features: Array) -> Array:
    """The action for a state's features."""
    hidden = jax.nn.relu(dense(weights, "network.policy_0", features))
    return jnp.tanh(dense(weights, "network.policy_1", hidden))


def next_state(weights: Weights, x: Array, features: Array, action: Array) -> Array:
    """The state after an action."""
    hidden = jax.nn.relu(dense(weights, "network.dynamics_0", jnp.concatenate([features, action], 1)))
    return x + dense(weights, "network.dynamics_1", hidden)


def inner_loss(actions: Array, weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """Huber between the state predicted after the actions and the goal."""
    for step in range(model.horizon):
        x = next_state(weights, x, features(weights, model, x, goal), actions[:, step])
    return optax.losses.huber_loss(x, goal).sum()


def plan(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """The policy's rollout, improved by gradient descent on the predicted distance to the goal."""
    state, planned = x, []
    for _ in range(model.horizon):
        seen = features(weights, model, state, goal)
        planned.append(policy(weights, seen))
        state = next_state(weights, state, seen, planned[-1])
    actions = jnp.stack(planned, 1)
    for _ in range(model.updates):
        actions = actions - weights["step_size"] * jax.grad(inner_loss)(actions, weights, model, x, goal)
    return actions


def outer_loss(
    weights: Weights, model: ModelConfig, observations: Array, goals: Array, demonstrated: Array, mask: Array
) -> Array:
    """The outer loss of a batch."""
    if model.sees_goal:
        x, goal = jnp.split(encode(weights, model, jnp.concatenate([observations, goals])), 2)
    else:
        x = goal = encode(weights, model, observations)
    if model.plans:
        planned = plan(weights, model, x, goal)
    else:
        planned = policy(weights, features(weights, model, x, goal))[:, None]
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
    """Takes a step on the batch of this row."""
    loss, gradients = jax.value_and_grad(outer_loss)(weights, model, *gather(data, row))
    updates, state = OPTIMIZER.update(gradients, state, weights)
    return optax.apply_updates(weights, updates), state, loss


class Trainer:
    """The weights with the state of their optimiser, and the batches."""

    def __init__(self, batches: Batches) -> None:
        self.model, self.count = batches.model, len(batches)
        self.data = jax.device_put(batches.arrays)
        self.weights = jax.device_put(batches.weights)
        self.state = OPTIMIZER.init(self.weights)

    def step(self, number: int) -> Callable[[], float]:
        """Takes a training step."""
        row = number % self.count
        self.weights, self.state, loss = train_step(self.weights, self.state, self.model, self.data, row)
        return loss.item


def main(batches: Path, method: str, threads: int) -> None:
    """Trains as asked on stdin."""
    # XLA takes as many threads as there are cores to run on.
    if (cores := len(os.sched_getaffinity(0))) != threads:
        raise ValueError(f"threads: expected {cores}, as the process may run on so many cores, got {threads}")
    serve(Trainer(Batches.read(batches, method)))


if __name__ == "__main__":
    tyro.cli(main)
