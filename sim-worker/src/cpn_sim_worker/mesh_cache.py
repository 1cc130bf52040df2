"""Cache of decimated meshes on disk.

The cache is optional: its folder may be missing, full, read-only or another user's, and its files may be truncated by a
power failure. Meshes are then decimated anew, damaged files are replaced, and one warning names the path.
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
    """Mesh in its own frame, in MuJoCo's layout."""

    vertices: NDArray[np.float32]
    """[V, 3]."""
    faces: NDArray[np.int32]
    """[F, 3], into the vertices."""
    corners: NDArray[np.int32]
    """[F, 3], corners of the original mesh, 0 to 3 F', from which each corner takes its normal and texture."""


@dataclass(frozen=True)
class Bounds:
    """Upper bounds of a mesh's sizes."""

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
    """Cached mesh, under the digest of all its inputs; decimated and stored first if there is none."""
    try:
        folder = user_cache_path("cpn") / "meshes"
    except RuntimeError as error:
        # No home folder, as in a container whose user is not in its list of users.
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
        # Opening a pipe, for example, would block for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("expected a file")
        with np.load(path, allow_pickle=False) as archive:
            mesh = Mesh(archive["vertices"], archive["faces"], archive["corners"])
        bounds.check(mesh)
    except FileNotFoundError:
        return None
    # A damaged file raises errors of several layers: zipfile, zlib, NumPy's header parser.
    except Exception as error:
        _warn("read", path, _reason(error))
        return None
    return mesh


def _write(path: Path, mesh: Mesh) -> None:
    # Workers that decimate the same mesh at once write files of their own, and the last rename wins.
    partial = path.with_name(f".{path.stem}-{uuid4().hex[:12]}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # Default permissions, unlike tempfile's, so that other users of a shared cache can read the file.
            with partial.open("xb") as file:
                np.savez(file, vertices=mesh.vertices, faces=mesh.faces, corners=mesh.corners)
                file.flush()
                # Before the rename, since a power failure could leave an empty file under the name.
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        _warn("written", path, _reason(error))


def _reason(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__}: {error}"


def _warn(action: str, path: Path, reason: str) -> None:
    """Warns once per action and folder, with the first file."""
    if (action, path.parent) not in _warned:
        _warned.add((action, path.parent))
        log.warning("mesh cache: %s cannot be %s: %s; meshes are decimated anew", path, action, reason)


_warned: set[tuple[str, Path]] = set()
"""Warnings given, by action and folder."""
