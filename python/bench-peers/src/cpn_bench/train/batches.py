"""Model, weights and batches shared by all training contenders, in a file written by CPN's bench."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpn_bench.model import ModelConfig, read


@dataclass(frozen=True)
class Batches:
    """N batches of B samples, with images as indices of distinct frames."""

    model: ModelConfig
    weights: dict[str, NDArray[Any]]
    """Weights by their names in a checkpoint; float32, or float64 in gradient checks."""
    frames: NDArray[np.uint8]
    """Distinct frames, `[F, 84, 84, 3]`."""
    observation_index: NDArray[np.int64]
    """Indices of the observations, `[N, B]`."""
    goal_index: NDArray[np.int64]
    """Indices of the goals, `[N, B]`."""
    actions: NDArray[Any]
    """Demonstrated actions, `[N, B, H, A]`."""
    mask: NDArray[Any]
    """1 for an action within the demonstration, else 0, `[N, B, H]`."""

    @classmethod
    def read(cls, path: Path, method: str) -> "Batches":
        """Reads the file, which must be of `method`."""
        model, weights, tensors = read(path)
        if model.method != method:
            raise ValueError(f"method of {path}: expected {method}, got {model.method}")
        return cls(model=model, weights=weights, **tensors)

    def __len__(self) -> int:
        return len(self.observation_index)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Fields without model and weights, by name."""
        fields = ("frames", "observation_index", "goal_index", "actions", "mask")
        return {field: getattr(self, field) for field in fields}
