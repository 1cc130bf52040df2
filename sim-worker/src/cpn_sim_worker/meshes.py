"""Decimation of meshes for rendering.

The time of a software renderer is spent on vertices, and Sawyer's arm has more faces than the image has pixels.
"""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

import copy
import hashlib
import json
from dataclasses import asdict, dataclass

import fast_simplification
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from cpn_sim_worker.mesh_cache import Bounds, Mesh, decimate_once
from cpn_sim_worker.render_spec import installed_version

LIBRARIES = ("fast-simplification", "numpy", "scipy")
"""Names of the packages that determine a decimated mesh."""


@dataclass(frozen=True)
class Decimation:
    """Settings of mesh decimation."""

    max_faces: int = 1000
    """Maximum number of faces of a mesh, unless the decimation ends above it. `make bench-sim` requires a mean SSIM of
    0.97 to the undecimated images, for each of the 24 tasks."""
    min_aggressiveness: int = 3
    """First aggressiveness of the quadric decimation: lower values distribute faces better, higher ones reach fewer."""
    max_aggressiveness: int = 10
    """Last aggressiveness tried."""
    neighbours: int = 24
    """Number of nearest original corners among which a new corner chooses its normal."""
    distance_weight: float = 0.5
    """Penalty of an original corner at a distance of one edge, where 1 is that of a normal orthogonal to the new
    face's."""


def decimated(model: mujoco.MjModel, decimation: Decimation) -> mujoco.MjModel:
    """Copy of a model for rendering, in which meshes have at most `decimation.max_faces` faces, as far as they can.

    Positions, sizes and counts of all bodies and geoms are unchanged, so that the original model's data can be rendered
    with the copy. The physics keeps the original.
    """
    light = copy.copy(model)
    for mesh in range(model.nmesh):
        count, first = int(model.mesh_facenum[mesh]), int(model.mesh_faceadr[mesh])
        if count <= decimation.max_faces:
            continue
        faces = slice(first, first + count)
        vertices = _range(model.mesh_vertadr[mesh], model.mesh_vertnum[mesh])
        normals = _range(model.mesh_normaladr[mesh], model.mesh_normalnum[mesh])
        simple = _decimate(
            model.mesh_vert[vertices],
            model.mesh_face[faces],
            model.mesh_normal[normals][model.mesh_facenormal[faces]],
            decimation,
        )
        kept = slice(first, first + len(simple.faces))
        light.mesh_vert[vertices][: len(simple.vertices)] = simple.vertices
        light.mesh_face[kept] = simple.faces
        for indices in ("mesh_facenormal", "mesh_facetexcoord"):
            getattr(light, indices)[kept] = getattr(model, indices)[faces].ravel()[simple.corners]
        light.mesh_facenum[mesh] = len(simple.faces)
    return light


def _range(first: int, count: int) -> slice:
    return slice(int(first), int(first) + int(count))


def _decimate(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], normals: NDArray[np.float32], decimation: Decimation
) -> Mesh:
    """Decimates a mesh of vertices [V, 3], faces [F, 3] and corner normals [F, 3, 3], by way of the cache."""
    versions = {package: installed_version(package) for package in LIBRARIES}
    digest = hashlib.sha256(json.dumps([asdict(decimation), versions]).encode())
    for array in (vertices, faces, normals):
        digest.update(array.tobytes())

    def decimate() -> Mesh:
        new_vertices, new_faces = _simplify(*_merge_equal_vertices(vertices, faces), decimation)
        corners = _nearest_corners(new_vertices, new_faces, vertices, faces, normals, decimation)
        return Mesh(new_vertices, new_faces, corners)

    return decimate_once(digest.hexdigest(), Bounds(len(vertices), len(faces), normals.size // 3), decimate)


def _merge_equal_vertices(
    vertices: NDArray[np.float32], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Merges equal vertices, since decimation would tear apart faces that do not share theirs."""
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index[faces].astype(np.int32)
    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return merged.astype(np.float64), faces[~degenerate]


def _simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], decimation: Decimation
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """First result of few enough faces, or else that of the fewest, as of the ball of soccer."""
    max_faces = decimation.max_faces
    results: list[tuple[NDArray[np.float32], NDArray[np.int32]]] = []
    for aggressiveness in range(decimation.min_aggressiveness, decimation.max_aggressiveness + 1):
        simple, left, *_ = fast_simplification.simplify(vertices, faces, target_count=max_faces, agg=aggressiveness)
        simple, left = simple.astype(np.float32), left.astype(np.int32)
        results.append((simple, left[_areas_and_normals(simple, left)[0] > 0]))
        if len(results[-1][1]) <= max_faces:
            break
    return min(results, key=lambda result: len(result[1]))


def _areas_and_normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Twice the area of each face, [F], and its normal, [F, 3]."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    twice_area = np.linalg.norm(cross, axis=1)
    return twice_area, cross / np.maximum(twice_area, np.finfo(np.float32).tiny)[:, None]


def _nearest_corners(
    new_vertices: NDArray[np.float32],
    new_faces: NDArray[np.int32],
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    normals: NDArray[np.float32],
    decimation: Decimation,
) -> NDArray[np.int32]:
    """Nearby original corner with the normal that fits best, for each corner of the new faces, [F, 3].

    Round parts then stay smooth and edges sharp; flat facets would be more visible than the missing detail.
    """
    tree = KDTree(vertices[faces].reshape(-1, 3))
    distances, candidates = map(np.asarray, tree.query(new_vertices, k=decimation.neighbours))
    twice_areas, face_normals = _areas_and_normals(new_vertices, new_faces)
    edge = np.sqrt(np.median(twice_areas))
    distances, candidates = distances[new_faces], candidates[new_faces]  # [F, 3, K]
    alignment = np.einsum("fckx,fx->fck", normals.reshape(-1, 3)[candidates], face_normals)
    best = np.argmax(alignment - decimation.distance_weight * distances / edge, axis=-1, keepdims=True)
    return np.take_along_axis(candidates, best, axis=-1)[..., 0].astype(np.int32)
