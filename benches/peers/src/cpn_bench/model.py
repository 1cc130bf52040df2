"""What a file of ours says of a model, and its weights."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors import safe_open

WEIGHT = "weight."
"""What a weight's name in a checkpoint is prefixed with in the file."""


@dataclass(frozen=True)
class ModelConfig:
    """What a checkpoint's `cpn` document says of a model, as far as its mathematics depends on it."""

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


def read(path: Path) -> tuple[ModelConfig, dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """The model in a file of ours, its weights by their names in a checkpoint, and the other tensors."""
    with safe_open(path, "numpy") as file:
        model = ModelConfig.from_document(json.loads(file.metadata()["cpn"]))
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    weights = {name.removeprefix(WEIGHT): tensors.pop(name) for name in list(tensors) if name.startswith(WEIGHT)}
    return model, weights, tensors
