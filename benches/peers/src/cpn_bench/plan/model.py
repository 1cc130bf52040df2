"""What every contender plans with: the same model, observations and goals, in one file that ours writes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpn_bench.model import ModelConfig, read

MULTIPLY_AND_ADD = 2
"""Operations of a product in a sum."""


@dataclass(frozen=True)
class PlanModel:
    """A planning method's model, and F observations, each with a goal of its own."""

    model: ModelConfig
    weights: dict[str, NDArray[Any]]
    """By their names in a checkpoint; float32, or float64 in tests."""
    frames: NDArray[np.uint8]
    """The observations, `[F, 84, 84, 3]`."""
    goals: NDArray[np.uint8]
    """`[F, 84, 84, 3]`."""

    @classmethod
    def read(cls, path: Path) -> "PlanModel":
        """Reads a file of ours."""
        model, weights, tensors = read(path)
        return cls(model, weights, tensors["frames"], tensors["goals"])

    @property
    def operations(self) -> int:
        """Floating-point operations of the matrix products of one plan, its goal's embedding not among them."""

        def products(*layers: str) -> int:
            """Products of a state with the weights of these layers and their gates: each weight takes part in one."""
            names = tuple(f"network.{layer}" for layer in layers)
            return sum(w.size for name, w in self.weights.items() if name.startswith(names) and name.endswith("weight"))

        encoder, size = self.weights["encoder.linear.weight"].size, self.frames.shape[1]
        for number, stride in enumerate(self.model.strides):
            weight = self.weights[f"encoder.conv.{number}.weight"]
            size = (size - weight.shape[-1]) // stride + 1
            encoder += weight.size * size**2
        policy, step = products("policy"), products("trunk", "dynamics")
        horizon, updates = self.model.horizon, self.model.updates
        # The rollout predicts no state after its last action.
        rollout = horizon * (policy + step) - products("dynamics")
        # The loss before an update is part of it. Backwards as many products as forwards, but that the first features
        # do not depend on an action.
        update = 2 * horizon * step - products("trunk")
        evaluation = horizon * step
        return MULTIPLY_AND_ADD * (encoder + rollout + updates * update + evaluation)
