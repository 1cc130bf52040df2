"""Networks and planning in PyTorch, in the style of its documentation."""

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - as everybody calls it
from numpy.typing import NDArray
from torch import Tensor, nn

from cpn_bench.model import ModelConfig

Weights = Mapping[str, Tensor]


class Gate(nn.Module):
    """Attenuation network with one hidden layer."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Factors `[B, outputs]` in (0, 1) of inputs `[B, inputs]`."""
        return torch.sigmoid(self.output(F.relu(self.hidden(x))))


class Neuromodulated(nn.Linear):
    """Linear layer with weights and biases attenuated by factors computed from its input."""

    def __init__(self, inputs: int, outputs: int, gate_hidden: int) -> None:
        super().__init__(inputs, outputs)
        self.u = Gate(inputs, gate_hidden, outputs * inputs)
        self.v = Gate(inputs, gate_hidden, outputs)

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - nn.Linear's name
        """Outputs `[B, outputs]` of inputs `[B, inputs]`."""
        weight = self.u(input).unflatten(1, self.weight.shape) * self.weight
        return (weight * input.unsqueeze(1)).sum(-1) + self.v(input) * self.bias


class Encoder(nn.Module):
    """Encoder: convolutions, a linear layer and layer normalisation."""

    def __init__(self, model: ModelConfig, weights: Weights) -> None:
        super().__init__()
        self.conv = nn.ModuleList()
        for number, stride in enumerate(model.strides):
            outputs, inputs, kernel, _ = weights[f"encoder.conv.{number}.weight"].shape
            # Channels last, as in the images.
            convolution = nn.Conv2d(inputs, outputs, kernel, stride).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
            self.conv.append(convolution)
        outputs, inputs = weights["encoder.linear.weight"].shape
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.LayerNorm(outputs) if model.layer_norm else nn.Identity()

    def forward(self, images: Tensor) -> Tensor:
        """Embeddings `[B, Z]` of images `[B, 84, 84, 3]`, bytes."""
        y = images.permute(0, 3, 1, 2).to(self.linear.weight.dtype) / 255 - 0.5
        for convolution in self.conv:
            y = F.relu(convolution(y))
        return self.norm(self.linear(y.flatten(1)))


class PolicyDynamics(nn.Module):
    """Policy dynamics network g_θ: a trunk with policy and dynamics branches."""

    def __init__(self, model: ModelConfig, weights: Weights) -> None:
        super().__init__()

        def dense(name: str) -> nn.Linear:
            outputs, inputs = weights[f"network.{name}.weight"].shape
            if not model.neuromodulated:
                return nn.Linear(inputs, outputs)
            return Neuromodulated(inputs, outputs, weights[f"network.{name}.u.hidden.bias"].numel())

        self.goal_conditioned = model.goal_conditioned
        self.trunk = dense("trunk")
        self.policy_0, self.policy_1 = dense("policy_0"), dense("policy_1")
        if model.plans:
            self.dynamics_0, self.dynamics_1 = dense("dynamics_0"), dense("dynamics_1")

    def features(self, x: Tensor, goal: Tensor) -> Tensor:
        """Trunk: features of a state."""
        return F.relu(self.trunk(torch.cat([x, goal], 1) if self.goal_conditioned else x))

    def policy(self, features: Tensor) -> Tensor:
        """Policy branch: the action from a state's features."""
        return torch.tanh(self.policy_1(F.relu(self.policy_0(features))))

    def next(self, x: Tensor, features: Tensor, action: Tensor) -> Tensor:
        """Dynamics branch: the state after an action."""
        return x + self.dynamics_1(F.relu(self.dynamics_0(torch.cat([features, action], 1))))


class Agent(nn.Module):
    """Encoder, g_θ and step size, with the parts of planning."""

    def __init__(self, model: ModelConfig, weights: Weights) -> None:
        super().__init__()
        self.model = model
        self.encoder = Encoder(model, weights)
        self.network = PolicyDynamics(model, weights)
        self.step_size = nn.Parameter(torch.ones(()))
        self.to(weights["step_size"].dtype).load_state_dict(weights)

    def rollout(self, x: Tensor, goal: Tensor) -> Tensor:
        """Policy's actions along the predicted states, `[B, H, A]`, from x to the goal, both `[B, Z]`."""
        features = self.network.features(x, goal)
        actions = [self.network.policy(features)]
        for _ in range(self.model.horizon - 1):
            x = self.network.next(x, features, actions[-1])
            features = self.network.features(x, goal)
            actions.append(self.network.policy(features))
        return torch.stack(actions, 1)

    def inner_losses(self, actions: Tensor, x: Tensor, goal: Tensor) -> Tensor:
        """Huber losses between the predicted state after the plans' actions and the goal, `[B]`."""
        for action in actions.unbind(1):
            x = self.network.next(x, self.network.features(x, goal), action)
        return F.huber_loss(x, goal, reduction="none").sum(1)

    def inner_loss(self, actions: Tensor, x: Tensor, goal: Tensor) -> Tensor:
        """Sum of the inner losses, whose gradient is that of each plan since plans are independent."""
        return self.inner_losses(actions, x, goal).sum()


def tensors(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """Tensors that share the arrays' memory."""
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
