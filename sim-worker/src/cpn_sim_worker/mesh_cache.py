"""Decimated meshes, kept between processes.

The cache is a convenience. Its folder may be missing, full, read-only or another user's, and its files may be cut by a
power failure: meshes are decimated all the same, damaged files are replaced, and one warning says where.
"""

import logging
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Mesh:
    """A mesh in its own frame, as MuJoCo lays it out."""

    vertices: NDArray[np.float32]
    """[V, 3]."""
    faces: NDArray[np.int32]
    """[F, 3], into the vertices."""
    corners: NDArray[np.int32]
    """[F, 3], the corner of the original mesh, 0 to 3 F', whose normal and texture each corner takes."""


@dataclass(frozen=True)
class Bounds:
    """What a mesh has at most."""

    vertices: int
    faces: int
    corners: int
    """Corners of the original mesh, 3 F'."""

    def check(self, mesh: Mesh) -> None:
        """Raises `ValueError` unless a model has room for `mesh`, and its indices point into it."""
        limits = {
            "vertices": (np.float32, self.vertices, np.inf),
            "faces": (np.int32, self.faces, len(mesh.vertices)),
            "corners": (np.int32, len(mesh.faces), self.corners),
        }
        for name, (dtype, most, below) in limits.items():
            array = getattr(mesh, name)
            if array.dtype != dtype or array.shape[1:] != (3,) or not 0 < len(array) <= most:
                expected = f"{np.dtype(dtype)} [1 to {most}, 3]"
                raise ValueError(f"{name}: expected {expected}, got {array.dtype} {list(array.shape)}")
            lowest = -np.inf if name == "vertices" else 0
            if not np.all(np.isfinite(array) & (array >= lowest) & (array < below)):
                raise ValueError(f"{name}: expected numbers from {lowest} to below {below}, got others")
        if len(mesh.corners) != len(mesh.faces):
            raise ValueError(f"corners: expected {len(mesh.faces)}, as many as faces, got {len(mesh.corners)}")


def decimate_once(digest: str, bounds: Bounds, decimate: Callable[[], Mesh]) -> Mesh:
    """The mesh that is kept under the digest of everything it depends on; decimates it first if there is none."""
    try:
        folder = user_cache_path("cpn") / "meshes"
    except RuntimeError as error:
        # There is no home, as in a container whose user its list of users does not have.
        _warn("used", Path("~/.cache/cpn/meshes"), str(error))
        return decimate()

    path = folder / f"{digest}.npz"
    if (mesh := _read(path, bounds)) is not None:
        return mesh
    mesh = decimate()
    _write(path, mesh)
    return mesh


def _read(path: Path, bounds: Bounds) -> Mesh | None:
    try:
        # Whatever else may lie there: opening a pipe would wait for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("expected a file")
        with np.load(path, allow_pickle=False) as archive:
            mesh = Mesh(archive["vertices"], archive["faces"], archive["corners"])
        bounds.check(mesh)
    except FileNotFoundError:
        return None
    # A damaged file surfaces as whatever the layer that meets the damage raises: zipfile, zlib, NumPy's header parser.
    except Exception as error:
        _warn("read", path, _reason(error))
        return None
    return mesh


def _write(path: Path, mesh: Mesh) -> None:
    # Several workers may decimate the same mesh at once: each writes its own file, and the last one stays.
    partial = path.with_name(f".{path.stem}-{uuid4().hex[:12]}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # With the permissions that the umask gives, so that others who share the cache can read it.
            with partial.open("xb") as file:
                np.savez(file, vertices=mesh.vertices, faces=mesh.faces, corners=mesh.corners)
                file.flush()
                # Before the name is there: a power failure would leave an empty file under it.
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        _warn("written", path, _reason(error))


def _reason(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__}: {error}"


def _warn(action: str, path: Path, reason: str) -> None:
    """Names the first file of a folder: where one cannot be used, others hardly can either."""
    if (action, path.parent) not in _warned:
        _warned.add((action, path.parent))
        log.warning("mesh cache: %s cannot be %s: %s; meshes are decimated anew", path, action, reason)


_warned: set[tuple[str, Path]] = set()
"""What was warned of, by action and folder."""
