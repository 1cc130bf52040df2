"""Independent PyTorch implementation of CPN, which writes the golden tensors of `crates/cpn-torch/tests/it/golden.rs`.

Written from the paper alone, with other building blocks than the Rust code (einsum, `torch.func`, explicit weights), so
that a shared mistake is unlikely. Run it again only when the mathematics changes:

    uv run --with torch==2.13.0 --with numpy --with safetensors tests/golden/reference.py
"""

import json
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import save_file
from torch.func import grad
from torch.nn import functional

Weights = dict[str, torch.Tensor]

LATENT, HIDDEN, GATE, ACTIONS, HORIZON, BATCH = 8, 6, 5, 4, 3, 2
POSITION = 3  # Elements of a state that actions move linearly, with position dynamics.
CONVOLUTIONS = [(4, 8, 8), (6, 4, 2)]  # channels, kernel, stride


def dense_shapes(prefix: str, inputs: int, outputs: int, gated: bool) -> dict[str, tuple[int, ...]]:
    """Shapes of a fully connected layer `[inputs] -> [outputs]`, with the two gates of a neuromodulated one."""
    shapes: dict[str, tuple[int, ...]] = {f"{prefix}.weight": (outputs, inputs), f"{prefix}.bias": (outputs,)}
    if gated:
        for gate, size in (("u", outputs * inputs), ("v", outputs)):
            shapes |= {
                f"{prefix}.{gate}.hidden.weight": (GATE, inputs),
                f"{prefix}.{gate}.hidden.bias": (GATE,),
                f"{prefix}.{gate}.output.weight": (size, GATE),
                f"{prefix}.{gate}.output.bias": (size,),
            }
    return shapes


def make_weights(method: str, position_dynamics: bool) -> Weights:
    """Random weights of a small model of the method, upn or cpn."""
    gated = method == "cpn"
    shapes: dict[str, tuple[int, ...]] = {"step_size": ()}
    channels, size = 3, 84
    for i, (out, kernel, stride) in enumerate(CONVOLUTIONS):
        shapes |= {f"encoder.conv.{i}.weight": (out, channels, kernel, kernel), f"encoder.conv.{i}.bias": (out,)}
        channels, size = out, (size - kernel) // stride + 1
    shapes |= {"encoder.linear.weight": (LATENT, channels * size * size), "encoder.linear.bias": (LATENT,)}
    shapes |= {"encoder.norm.weight": (LATENT,), "encoder.norm.bias": (LATENT,)}
    shapes |= dense_shapes("network.trunk", LATENT * (2 if gated else 1), HIDDEN, gated)
    shapes |= dense_shapes("network.policy_0", HIDDEN, HIDDEN, gated)
    shapes |= dense_shapes("network.policy_1", HIDDEN, ACTIONS, gated)
    shapes |= dense_shapes("network.dynamics_0", HIDDEN + ACTIONS, HIDDEN, gated)
    shapes |= dense_shapes("network.dynamics_1", HIDDEN, LATENT, gated)
    if position_dynamics:
        shapes["network.position.weight"] = (POSITION, ACTIONS)
    return {name: torch.randn(shape) * 0.3 for name, shape in shapes.items()}


def dense(w: Weights, prefix: str, x: torch.Tensor) -> torch.Tensor:
    """Fully connected layer of one sample `[inputs]`: (u(x) * a) x + v(x) * b, or a x + b where it has no gates."""
    a, b = w[f"{prefix}.weight"], w[f"{prefix}.bias"]
    if f"{prefix}.u.hidden.weight" in w:

        def gate(name: str) -> torch.Tensor:
            def layer(part: str, y: torch.Tensor) -> torch.Tensor:
                return w[f"{prefix}.{name}.{part}.weight"] @ y + w[f"{prefix}.{name}.{part}.bias"]

            return 1 / (1 + torch.exp(-layer("output", layer("hidden", x).clamp(min=0))))

        a, b = gate("u").reshape(a.shape) * a, gate("v") * b
    return torch.einsum("oi,i->o", a, x) + b


def encode(w: Weights, image: torch.Tensor) -> torch.Tensor:
    """Embedding `[LATENT]` of an image `[84, 84, 3]` of bytes."""
    y = image.movedim(-1, 0)[None].double() / 255 - 0.5
    for i, (_, _, stride) in enumerate(CONVOLUTIONS):
        y = functional.conv2d(y, w[f"encoder.conv.{i}.weight"], w[f"encoder.conv.{i}.bias"], stride=stride).clamp(min=0)
    x = w["encoder.linear.weight"] @ y.reshape(-1) + w["encoder.linear.bias"]
    centred = x - x.mean()
    return centred / (centred.square().mean() + 1e-5).sqrt() * w["encoder.norm.weight"] + w["encoder.norm.bias"]


def features(w: Weights, x: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Features `[HIDDEN]` of a state, and for CPN of the goal, both `[LATENT]`."""
    gated = "network.trunk.u.hidden.weight" in w
    return dense(w, "network.trunk", torch.cat([x, goal]) if gated else x).clamp(min=0)


def policy(w: Weights, h: torch.Tensor) -> torch.Tensor:
    """Action `[ACTIONS]` from features."""
    return torch.tanh(dense(w, "network.policy_1", dense(w, "network.policy_0", h).clamp(min=0)))


def step(w: Weights, x: torch.Tensor, h: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Next state `[LATENT]` from a state, its features and an action."""
    hidden = dense(w, "network.dynamics_0", torch.cat([h, action])).clamp(min=0)
    change = dense(w, "network.dynamics_1", hidden)
    if "network.position.weight" in w:
        change = torch.cat([w["network.position.weight"] @ action, change[POSITION:]])
    return x + change


def inner_loss(actions: torch.Tensor, w: Weights, x: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Huber loss between the state after the actions `[HORIZON, ACTIONS]` and the goal, over the compared elements."""
    for action in actions:
        x = step(w, x, features(w, x, goal), action)
    compared = POSITION if "network.position.weight" in w else LATENT
    error = (x - goal)[:compared].abs()
    return torch.where(error < 1, 0.5 * error**2, error - 0.5).sum()


def plan(w: Weights, x: torch.Tensor, goal: torch.Tensor, updates: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Actions `[HORIZON, ACTIONS]` after the updates, and the inner loss before and after each, `[updates + 1]`."""
    actions, state = [], x
    for _ in range(HORIZON):
        h = features(w, state, goal)
        actions.append(policy(w, h))
        state = step(w, state, h, actions[-1])
    actions = torch.stack(actions)
    losses = [inner_loss(actions, w, x, goal)]
    for _ in range(updates):
        actions = actions - w["step_size"] * grad(inner_loss)(actions, w, x, goal)
        losses.append(inner_loss(actions, w, x, goal))
    return actions, torch.stack(losses)


class Batch(NamedTuple):
    """Samples for one outer step."""

    observations: torch.Tensor
    """`[BATCH, 84, 84, 3]`."""
    goals: torch.Tensor
    """`[BATCH, 84, 84, 3]`."""
    demonstrated: torch.Tensor
    """Actions `[BATCH, HORIZON, ACTIONS]`."""
    mask: torch.Tensor
    """`[BATCH, HORIZON]`: 1 where there is a demonstrated action."""


def outer_loss(w: Weights, batch: Batch, updates: int) -> torch.Tensor:
    """Mean squared error of the planned actions, over those that were demonstrated."""
    pairs = zip(batch.observations, batch.goals, strict=True)
    planned = torch.stack([plan(w, encode(w, o), encode(w, g), updates)[0] for o, g in pairs])
    squared = (planned - batch.demonstrated).square() * batch.mask[..., None]
    return squared.sum() / (batch.mask.sum() * ACTIONS)


def main() -> None:
    """Writes a file for each of the methods that plan, and one with position dynamics."""
    torch.set_default_dtype(torch.float64)
    for name, updates, position_dynamics in (("upn", 1, False), ("cpn", 2, False), ("cpn-position", 2, True)):
        torch.manual_seed(7)
        method = name.removesuffix("-position")
        weights = make_weights(method, position_dynamics)
        # With position dynamics the policy's plan is cloned.
        trained_updates = 0 if position_dynamics else updates
        observations, goals = torch.randint(0, 256, (2, BATCH, 84, 84, 3), dtype=torch.uint8)
        demonstrated = torch.rand(BATCH, HORIZON, ACTIONS) * 2 - 1
        batch = Batch(observations, goals, demonstrated, torch.tensor([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0]]))

        pairs = [(encode(weights, o), encode(weights, g)) for o, g in zip(observations, goals, strict=True)]
        plans = [plan(weights, x, goal, updates) for x, goal in pairs]
        gradients = grad(outer_loss)(weights, batch, trained_updates)
        tensors = {f"weight.{k}": v for k, v in weights.items()} | {f"gradient.{k}": v for k, v in gradients.items()}
        tensors |= batch._asdict()
        tensors |= {
            "x": torch.stack([x for x, _ in pairs]),
            "x_g": torch.stack([goal for _, goal in pairs]),
            "actions": torch.stack([actions for actions, _ in plans]),
            "inner_losses": torch.stack([losses for _, losses in plans], dim=1),
            "outer_loss": outer_loss(weights, batch, trained_updates),
        }
        model = {
            "method": method,
            "encoder": {
                "kind": "image",
                "convolutions": [{"channels": c, "kernel": k, "stride": s} for c, k, s in CONVOLUTIONS],
                "latent": LATENT,
                "layer_norm": True,
            },
            "hidden": HIDDEN,
            "gate_hidden": GATE,
            "actions": ACTIONS,
            "horizon": HORIZON,
            "updates": updates,
        }
        if position_dynamics:
            model["position_dynamics"] = True
        tensors = {key: tensor.detach().clone().contiguous() for key, tensor in tensors.items()}
        path = Path(__file__).parent / f"{name}.safetensors"
        save_file(tensors, path, metadata={"cpn": json.dumps(model)})


if __name__ == "__main__":
    main()
