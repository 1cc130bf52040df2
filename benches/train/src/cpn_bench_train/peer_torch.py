"""The methods in PyTorch, eager or compiled, written as its documentation would have them.

Tried for CPN at the paper's sizes, batch 128, one thread (per second of CPU time, medians of 6 to 8 interleaved turns
on a busy machine). With glibc told to keep freed memory, the gated product as `baddbmm` gives 628 samples/s; as a
weighted sum 1.21 times that; with channels last too 1.25 times, which is what stands here. With glibc as it comes
`matmul`, `einsum`, `baddbmm` and the sum lie within 11 %; to `matmul` the memory setting gave 9 %, huge pages 2 %, and
the `foreach` Adam instead of the fused one 5 %, which was about the noise.

`torch.compile` cannot differentiate its graphs twice, but it traces through `torch.func.grad`: one graph (`fullgraph`)
holds the forward pass and the inner gradient, and the outer gradient is derived from it. That gives 1.28 times;
`torch.func.grad_and_value` of the whole outer loss, compiled, 1.27; a compiled encoder alone 0.98.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - as everybody calls it
import tyro
from numpy.typing import NDArray
from torch import Tensor, nn

from cpn_bench_train.batches import Batches, ModelConfig
from cpn_bench_train.contender import LEARNING_RATE, MAX_GRADIENT_NORM, serve

Weights = Mapping[str, Tensor]


class Gate(nn.Module):
    """An attenuation network with one hidden layer."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """`[B, inputs]` to `[B, outputs]` in (0, 1)."""
        return torch.sigmoid(self.output(F.relu(self.hidden(x))))


class Neuromodulated(nn.Linear):
    """A linear layer whose weights and biases are attenuated by its input."""

    def __init__(self, inputs: int, outputs: int, gate_hidden: int) -> None:
        super().__init__(inputs, outputs)
        self.u = Gate(inputs, gate_hidden, outputs * inputs)
        self.v = Gate(inputs, gate_hidden, outputs)

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - nn.Linear's name
        """`[B, inputs]` to `[B, outputs]`."""
        weight = self.u(input).unflatten(1, self.weight.shape) * self.weight
        return (weight * input.unsqueeze(1)).sum(-1) + self.v(input) * self.bias


class Encoder(nn.Module):
    """Convolutions, a linear layer and a layer norm."""

    def __init__(self, model: ModelConfig, weights: Weights) -> None:
        super().__init__()
        self.conv = nn.ModuleList()
        for number, stride in enumerate(model.strides):
            outputs, inputs, kernel, _ = weights[f"encoder.conv.{number}.weight"].shape
            # Like the images, whose bytes lie with their channels last.
            convolution = nn.Conv2d(inputs, outputs, kernel, stride).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
            self.conv.append(convolution)
        outputs, inputs = weights["encoder.linear.weight"].shape
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.LayerNorm(outputs) if model.layer_norm else nn.Identity()

    def forward(self, images: Tensor) -> Tensor:
        """`[B, 84, 84, 3]` bytes to `[B, Z]`."""
        y = images.permute(0, 3, 1, 2).to(self.linear.weight.dtype) / 255 - 0.5
        for convolution in self.conv:
            y = F.relu(convolution(y))
        return self.norm(self.linear(y.flatten(1)))


class PolicyDynamics(nn.Module):
    """The trunk with its policy and dynamics branches, g_θ."""

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
        """What the trunk makes of a state."""
        return F.relu(self.trunk(torch.cat([x, goal], 1) if self.goal_conditioned else x))

    def policy(self, features: Tensor) -> Tensor:
        """The action for a state's features."""
        return torch.tanh(self.policy_1(F.relu(self.policy_0(features))))

    def next(self, x: Tensor, features: Tensor, action: Tensor) -> Tensor:
        """The state after an action."""
        return x + self.dynamics_1(F.relu(self.dynamics_0(torch.cat([features, action], 1))))


class Agent(nn.Module):
    """A method whose forward pass is the outer loss."""

    def __init__(self, model: ModelConfig, weights: Weights) -> None:
        super().__init__()
        self.model = model
        self.encoder = Encoder(model, weights)
        self.network = PolicyDynamics(model, weights)
        self.step_size = nn.Parameter(torch.ones(()))
        self.to(weights["step_size"].dtype).load_state_dict(weights)

    def forward(self, observations: Tensor, goals: Tensor, demonstrated: Tensor, mask: Tensor) -> Tensor:
        """The outer loss of a batch."""
        if self.model.sees_goal:
            x, goal = self.encoder(torch.cat([observations, goals])).chunk(2)
        else:
            x = goal = self.encoder(observations)
        planned = self.plan(x, goal) if self.model.plans else self.react(x, goal)
        squared = (planned - demonstrated).square() * mask.unsqueeze(-1)
        return squared.sum() / (mask.sum() * demonstrated.shape[-1])

    def react(self, x: Tensor, goal: Tensor) -> Tensor:
        """The policy's action, as a plan of one step."""
        return self.network.policy(self.network.features(x, goal)).unsqueeze(1)

    def plan(self, x: Tensor, goal: Tensor) -> Tensor:
        """The policy's rollout, improved by gradient descent on the predicted distance to the goal."""
        state, planned = x, []
        for _ in range(self.model.horizon):
            features = self.network.features(state, goal)
            planned.append(self.network.policy(features))
            state = self.network.next(state, features, planned[-1])
        actions = torch.stack(planned, 1)
        for _ in range(self.model.updates):
            actions = actions - self.step_size * self.inner_gradient(actions, x, goal)
        return actions

    def inner_gradient(self, actions: Tensor, x: Tensor, goal: Tensor) -> Tensor:
        """The gradient of the inner loss in the actions, differentiable itself."""
        if torch.compiler.is_compiling():
            return torch.func.grad(self.inner_loss)(actions, x, goal)
        return torch.autograd.grad(self.inner_loss(actions, x, goal), actions, create_graph=True)[0]

    def inner_loss(self, actions: Tensor, x: Tensor, goal: Tensor) -> Tensor:
        """Huber between the state predicted after the actions and the goal."""
        for action in actions.unbind(1):
            x = self.network.next(x, self.network.features(x, goal), action)
        return F.huber_loss(x, goal, reduction="sum")


def tensors(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """Arrays as tensors of the same memory."""
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


class Trainer:
    """An agent with its optimiser and its batches."""

    def __init__(self, batches: Batches, compiled: bool = False) -> None:
        self.data = tensors(batches.arrays)
        self.count = len(batches)
        self.agent = Agent(batches.model, tensors(batches.weights))
        self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=LEARNING_RATE, fused=True)
        self.outer_loss = torch.compile(self.agent, fullgraph=True) if compiled else self.agent

    def step(self, number: int) -> Callable[[], float]:
        """Takes a training step."""
        self.optimizer.zero_grad()
        loss = self.outer_loss(*self.batch(number))
        loss.backward()
        nn.utils.clip_grad_norm_(self.agent.parameters(), MAX_GRADIENT_NORM)
        self.optimizer.step()
        return loss.detach().item

    def batch(self, number: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Observations, goals, demonstrated actions and their mask."""
        data, row = self.data, number % self.count
        observations = data["frames"][data["observation_index"][row]]
        goals = data["frames"][data["goal_index"][row]]
        return observations, goals, data["actions"][row], data["mask"][row]


def main(batches: Path, method: str, threads: int, compile: bool = False) -> None:  # noqa: A002 - the option's name
    """Trains as asked on stdin."""
    torch.set_num_threads(threads)
    serve(Trainer(Batches.read(batches, method), compiled=compile))


if __name__ == "__main__":
    tyro.cli(main)
