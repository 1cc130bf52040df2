"""What every contender starts from: the same model, weights and batches, in one file that ours writes."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

WEIGHT = "weight."
"""What a weight's name in a checkpoint is prefixed with in the file."""


@dataclass(frozen=True)
class ModelConfig:
    """What a checkpoint's `cpn` document says of a model, as far as a training step depends on it."""

    method: str
    """`bc`, `te-bc`, `upn` or `cpn`."""
    strides: tuple[int, ...]
    """Of the encoder's convolutions, in pixels."""
    latent: int
    """Z, the size of an embedding."""
    layer_norm: bool
    """Whether the embedding is layer-normalised."""
    horizon: int
    """H, the number of planned steps."""
    updates: int
    """U, the number of gradient updates of a plan."""

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "ModelConfig":
        """Reads the JSON document of `crates/cpn/src/config.rs`."""
        encoder = document["encoder"]
        return cls(
            method=document["method"],
            strides=tuple(convolution["stride"] for convolution in encoder["convolutions"]),
            latent=encoder["latent"],
            layer_norm=encoder["layer_norm"],
            horizon=document["horizon"],
            updates=document["updates"],
        )

    @property
    def plans(self) -> bool:
        """Whether actions come from the inner loop."""
        return self.method in ("upn", "cpn")

    @property
    def goal_conditioned(self) -> bool:
        """Whether the policy sees the goal's embedding."""
        return self.method in ("te-bc", "cpn")

    @property
    def neuromodulated(self) -> bool:
        """Whether the fully connected layers of the policy and the dynamics are gated."""
        return self.method == "cpn"

    @property
    def sees_goal(self) -> bool:
        """Whether the goal's picture is embedded at all."""
        return self.plans or self.goal_conditioned


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
        with safe_open(path, "numpy") as file:
            names = file.keys()
            model = ModelConfig.from_document(json.loads(file.metadata()["cpn"]))
            if model.method != method:
                raise ValueError(f"method of {path}: expected {method}, got {model.method}")
            return cls(
                model=model,
                weights={name.removeprefix(WEIGHT): file.get_tensor(name) for name in names if name.startswith(WEIGHT)},
                frames=file.get_tensor("frames"),
                observation_index=file.get_tensor("observation_index"),
                goal_index=file.get_tensor("goal_index"),
                actions=file.get_tensor("actions"),
                mask=file.get_tensor("mask"),
            )

    def __len__(self) -> int:
        return len(self.observation_index)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything but the weights, by field."""
        fields = ("frames", "observation_index", "goal_index", "actions", "mask")
        return {field: getattr(self, field) for field in fields}
