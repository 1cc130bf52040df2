"""Networks and planning in JAX, with batched arrays and unrolled steps."""

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax

from cpn_bench.model import ModelConfig

Weights = dict[str, Array]


def linear(weights: Weights, name: str, x: Array) -> Array:
    """Linear layer from `[B, inputs]` to `[B, outputs]`."""
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def gate(weights: Weights, name: str, x: Array) -> Array:
    """Attenuation network with one hidden layer, from `[B, inputs]` to `[B, outputs]` in (0, 1)."""
    return jax.nn.sigmoid(linear(weights, f"{name}.output", jax.nn.relu(linear(weights, f"{name}.hidden", x))))


def dense(weights: Weights, name: str, x: Array) -> Array:
    """Fully connected layer, neuromodulated if it has gates."""
    if f"{name}.u.hidden.weight" not in weights:
        return linear(weights, name, x)
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    attenuated = gate(weights, f"{name}.u", x).reshape(-1, *weight.shape) * weight
    return jnp.einsum("boi,bi->bo", attenuated, x) + gate(weights, f"{name}.v", x) * bias


def encode(weights: Weights, model: ModelConfig, images: Array) -> Array:
    """Embeddings `[B, Z]` of images `[B, 84, 84, 3]`, bytes."""
    y = images.astype(weights["encoder.linear.weight"].dtype) / 255 - 0.5
    for number, stride in enumerate(model.strides):
        name = f"encoder.conv.{number}"
        layout = ("NHWC", "OIHW", "NHWC")
        y = lax.conv_general_dilated(y, weights[f"{name}.weight"], (stride, stride), "VALID", dimension_numbers=layout)
        y = jax.nn.relu(y + weights[f"{name}.bias"])
    # The linear layer's weights expect features with channels first.
    x = linear(weights, "encoder.linear", y.transpose(0, 3, 1, 2).reshape(len(y), -1))
    if model.layer_norm:
        x = jax.nn.standardize(x, epsilon=1e-5) * weights["encoder.norm.weight"] + weights["encoder.norm.bias"]
    return x


def features(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """Trunk: features of a state."""
    inputs = jnp.concatenate([x, goal], 1) if model.goal_conditioned else x
    return jax.nn.relu(dense(weights, "network.trunk", inputs))


def policy(weights: Weights, features: Array) -> Array:
    """Policy branch: the action from a state's features."""
    hidden = jax.nn.relu(dense(weights, "network.policy_0", features))
    return jnp.tanh(dense(weights, "network.policy_1", hidden))


def next_state(weights: Weights, x: Array, features: Array, action: Array) -> Array:
    """Dynamics branch: the state after an action."""
    hidden = jax.nn.relu(dense(weights, "network.dynamics_0", jnp.concatenate([features, action], 1)))
    return x + dense(weights, "network.dynamics_1", hidden)


def rollout(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """Policy's actions along the predicted states, `[B, H, A]`, from x to the goal, both `[B, Z]`."""
    state_features = features(weights, model, x, goal)
    actions = [policy(weights, state_features)]
    for _ in range(model.horizon - 1):
        x = next_state(weights, x, state_features, actions[-1])
        state_features = features(weights, model, x, goal)
        actions.append(policy(weights, state_features))
    return jnp.stack(actions, 1)


def inner_losses(actions: Array, weights: Weights, model: ModelConfig, x: Array, goal: Array) -> Array:
    """Huber losses between the predicted state after the plans' actions and the goal, `[B]`."""
    for step in range(model.horizon):
        x = next_state(weights, x, features(weights, model, x, goal), actions[:, step])
    return optax.losses.huber_loss(x, goal).sum(1)


def inner_loss(actions: Array, weights: Weights, model: ModelConfig, x: Array, goal: Array) -> tuple[Array, Array]:
    """Sum of the inner losses, whose gradient is that of each plan since plans are independent, and the losses."""
    losses = inner_losses(actions, weights, model, x, goal)
    return losses.sum(), losses


def improve(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> tuple[Array, list[Array]]:
    """Rollout with gradient updates on the inner loss; returns the actions, and the losses before each update."""
    actions, losses = rollout(weights, model, x, goal), []
    for _ in range(model.updates):
        gradient, before = jax.grad(inner_loss, has_aux=True)(actions, weights, model, x, goal)
        actions = actions - weights["step_size"] * gradient
        losses.append(before)
    return actions, losses


def plan(weights: Weights, model: ModelConfig, x: Array, goal: Array) -> tuple[Array, Array]:
    """Plans: actions `[B, H, A]`, and inner losses `[U + 1, B]` before each update and after the last."""
    actions, losses = improve(weights, model, x, goal)
    return actions, jnp.stack([*losses, inner_losses(actions, weights, model, x, goal)])
