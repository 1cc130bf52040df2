"""Model configuration and weights in a file written by CPN's benches."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors import safe_open

WEIGHT = "weight."
"""Prefix, in the file, of a weight's name in a checkpoint."""


@dataclass(frozen=True)
class ModelConfig:
    """Part of a checkpoint's model configuration that determines its mathematics."""

    method: str
    """`bc`, `te-bc`, `upn` or `cpn`."""
    strides: tuple[int, ...]
    """Strides of the encoder's convolutions, in pixels."""
    latent: int
    """Z, the size of an embedding."""
    layer_norm: bool
    """True if the embedding is layer-normalised."""
    horizon: int
    """H, the planning horizon."""
    updates: int
    """U, the number of gradient updates of a plan."""

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "ModelConfig":
        """Reads the JSON document of `ModelConfig` in `crates/cpn/src/config.rs`.

        Raises:
            ValueError: If it has position dynamics, which the peers do not compute.
        """
        if document.get("position_dynamics"):
            raise ValueError("position_dynamics: expected false, which alone the peers compute, got true")
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
        """True if actions come from the inner loop."""
        return self.method in ("upn", "cpn")

    @property
    def goal_conditioned(self) -> bool:
        """True if the goal's embedding is an input of the policy."""
        return self.method in ("te-bc", "cpn")

    @property
    def neuromodulated(self) -> bool:
        """True if the fully connected layers of policy and dynamics are neuromodulated."""
        return self.method == "cpn"

    @property
    def sees_goal(self) -> bool:
        """True if the goal's image is embedded."""
        return self.plans or self.goal_conditioned


def read(path: Path) -> tuple[ModelConfig, dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Reads a model, its weights by their names in a checkpoint, and the other tensors."""
    with safe_open(path, "numpy") as file:
        model = ModelConfig.from_document(json.loads(file.metadata()["cpn"]))
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    weights = {name.removeprefix(WEIGHT): tensors.pop(name) for name in list(tensors) if name.startswith(WEIGHT)}
    return model, weights, tensors
