"""Model, observations and goals shared by all planning contenders, in a file written by CPN's bench."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpn_bench.model import ModelConfig, read

MULTIPLY_AND_ADD = 2
"""Operations per product of a matrix product."""


@dataclass(frozen=True)
class PlanModel:
    """Model of a planning method, with F pairs of observation and goal."""

    model: ModelConfig
    weights: dict[str, NDArray[Any]]
    """Weights by their names in a checkpoint; float32, or float64 in tests."""
    frames: NDArray[np.uint8]
    """Observations, `[F, 84, 84, 3]`."""
    goals: NDArray[np.uint8]
    """Goals, `[F, 84, 84, 3]`."""

    @classmethod
    def read(cls, path: Path) -> "PlanModel":
        """Reads the file."""
        model, weights, tensors = read(path)
        return cls(model, weights, tensors["frames"], tensors["goals"])

    @property
    def operations(self) -> int:
        """Floating-point operations of a plan's matrix products, without the embedding of its goal."""

        def products(*layers: str) -> int:
            """Number of products of a state with the weights of layers and their gates, one for each weight."""
            names = tuple(f"network.{layer}" for layer in layers)
            return sum(w.size for name, w in self.weights.items() if name.startswith(names) and name.endswith("weight"))

        encoder, size = self.weights["encoder.linear.weight"].size, self.frames.shape[1]
        for number, stride in enumerate(self.model.strides):
            weight = self.weights[f"encoder.conv.{number}.weight"]
            size = (size - weight.shape[-1]) // stride + 1
            encoder += weight.size * size**2
        policy, step = products("policy"), products("trunk", "dynamics")
        horizon, updates = self.model.horizon, self.model.updates
        # The rollout does not predict the state after its last action.
        rollout = horizon * (policy + step) - products("dynamics")
        # An update includes the loss before it. The backward pass has as many products as the forward pass, except the
        # first trunk's, whose features do not depend on an action.
        update = 2 * horizon * step - products("trunk")
        evaluation = horizon * step
        return MULTIPLY_AND_ADD * (encoder + rollout + updates * update + evaluation)
