"""What every contender starts from: the same model, weights and batches, in one file that ours writes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpn_bench.model import ModelConfig, read


@dataclass(frozen=True)
class Batches:
    """N batches of B samples whose pictures are indices into the distinct frames."""

    model: ModelConfig
    weights: dict[str, NDArray[Any]]
    """By their names in a checkpoint; float32, or float64 in checks of gradients."""
    frames: NDArray[np.uint8]
    """`[F, 84, 84, 3]`."""
    observation_index: NDArray[np.int64]
    """`[N, B]`."""
    goal_index: NDArray[np.int64]
    """`[N, B]`."""
    actions: NDArray[Any]
    """The demonstrated ones, `[N, B, H, A]`."""
    mask: NDArray[Any]
    """1 where the demonstration has an action, `[N, B, H]`."""

    @classmethod
    def read(cls, path: Path, method: str) -> "Batches":
        """Reads a file of batches for a model of this method."""
        model, weights, tensors = read(path)
        if model.method != method:
            raise ValueError(f"method of {path}: expected {method}, got {model.method}")
        return cls(model=model, weights=weights, **tensors)

    def __len__(self) -> int:
        return len(self.observation_index)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything but the weights, by field."""
        fields = ("frames", "observation_index", "goal_index", "actions", "mask")
        return {field: getattr(self, field) for field in fields}
