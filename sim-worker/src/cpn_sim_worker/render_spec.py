"""How a picture was rendered, written down beside the picture.

A network trained on one rendering and shown another sees a difference that no shape or type gives away. So every image
carries the spec of its rendering, recordings and checkpoints keep it, and whoever would bring two together compares.
"""

import json
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import version


@dataclass(frozen=True)
class RenderSpec:
    """Everything that decides the pixels of a state, but for the GL driver: two drivers differ by rounding."""

    camera: str
    flip: str
    height: int
    width: int
    hidden_sites: bool
    shadows: bool
    reflections: bool
    multisamples: int
    decimation: dict[str, float] | None
    """The settings of `meshes.Decimation`; None if meshes are drawn as they are."""
    tessellation: tuple[int, int, int]
    """Quads along the side of a box or plane; slices and stacks of a sphere or cylinder."""
    revision: str
    """Of the scene, where no package's version tells it."""
    versions: dict[str, str]
    """Of every package that the pixels depend on."""

    def __str__(self) -> str:
        """The spec as JSON, the same text for the same spec."""
        return self._json

    @cached_property
    def _json(self) -> str:
        """Made once, since every frame carries it."""
        return json.dumps(asdict(self), sort_keys=True, separators=(",", ":"))


@cache
def installed_version(package: str) -> str:
    """The version of a package; looking it up takes as long as a frame."""
    return version(package)
