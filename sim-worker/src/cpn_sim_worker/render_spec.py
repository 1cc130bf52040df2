"""Render spec: camera and renderer configuration of an image.

A network shown images of another rendering than its training data's fails without an error of shape or type. Every
image therefore carries its render spec; recordings and checkpoints store it, and images are only combined if their
specs agree.
"""

import json
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import version


@dataclass(frozen=True)
class RenderSpec:
    """All settings that determine the pixels of a state, except the GL driver: drivers differ by rounding."""

    camera: str
    flip: str
    height: int
    width: int
    hidden_sites: bool
    shadows: bool
    reflections: bool
    multisamples: int
    decimation: dict[str, float] | None
    """Settings of `meshes.Decimation`; None for undecimated meshes."""
    tessellation: tuple[int, int, int]
    """Quads along the side of a box or plane; slices and stacks of a sphere or cylinder."""
    revision: str
    """Revision of the scene; empty if a package's version determines it."""
    versions: dict[str, str]
    """Versions of all packages that the pixels depend on."""

    def __str__(self) -> str:
        """Canonical JSON of the spec."""
        return self._json

    @cached_property
    def _json(self) -> str:
        """JSON, cached since every frame carries it."""
        return json.dumps(asdict(self), sort_keys=True, separators=(",", ":"))


@cache
def installed_version(package: str) -> str:
    """Version of a package, cached since the lookup takes as long as a frame."""
    return version(package)
