"""Fewer faces for the meshes of a model that is only looked at.

A software renderer spends its time on vertices, and Sawyer's arm has more faces than the whole picture has pixels.
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
"""Names of the packages that decide what a mesh is decimated to."""


@dataclass(frozen=True)
class Decimation:
    """How meshes are decimated."""

    max_faces: int = 1000
    """Faces that a mesh may have. `make bench-sim` holds the mean SSIM of every task's pictures to the undecimated ones
    to 0.97."""
    min_aggressiveness: int = 3
    """Of the quadric decimation, tried first: less spends the faces better, more comes down to fewer."""
    max_aggressiveness: int = 10
    """Tried last."""
    neighbours: int = 24
    """Original corners that a new corner takes its normal from: the nearest ones."""
    distance_weight: float = 0.5
    """What an original corner loses by being an edge away, where one whose normal is at right angles to the new face's
    loses 1."""


def decimated(model: mujoco.MjModel, decimation: Decimation) -> mujoco.MjModel:
    """A copy of a model to be rendered, in which no mesh has more than `decimation.max_faces` faces.

    Positions, sizes and counts of all bodies and geoms stay as they are, so that the data of the original model shows
    the copy as well. The copy is for rendering only: the physics keeps the original.
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
    """Decimates a mesh of vertices [V, 3], faces [F, 3] and corner normals [F, 3, 3], or finds it in the cache."""
    versions = {package: installed_version(package) for package in LIBRARIES}
    digest = hashlib.sha256(json.dumps([asdict(decimation), versions]).encode())
    for array in (vertices, faces, normals):
        digest.update(array.tobytes())

    def decimate() -> Mesh:
        new_vertices, new_faces = _simplify(*_merge_equal_vertices(vertices, faces), decimation)
        corners = _nearest_corners(new_vertices, new_faces, vertices, faces, normals, decimation)
        return Mesh(new_vertices, new_faces, corners)

    return decimate_once(digest.hexdigest(), Bounds(len(vertices), decimation.max_faces, normals.size // 3), decimate)


def _merge_equal_vertices(
    vertices: NDArray[np.float32], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Joins the faces of a mesh whose vertices are not shared, which a decimation would tear apart."""
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index[faces].astype(np.int32)
    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return merged.astype(np.float64), faces[~degenerate]


def _simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], decimation: Decimation
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    max_faces = decimation.max_faces
    for aggressiveness in range(decimation.min_aggressiveness, decimation.max_aggressiveness + 1):
        simple, left, *_ = fast_simplification.simplify(vertices, faces, target_count=max_faces, agg=aggressiveness)
        simple, left = simple.astype(np.float32), left.astype(np.int32)
        left = left[_areas_and_normals(simple, left)[0] > 0]
        if len(left) <= max_faces:
            return simple, left
    raise ValueError(f"mesh: expected one that can be decimated to {max_faces} faces, got one of {len(faces)}")


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
    """For each new corner, [F, 3], the original corner nearby whose normal fits the new face best.

    So round parts stay smooth and edges stay sharp: flat facets, not missing detail, are what would catch the eye.
    """
    tree = KDTree(vertices[faces].reshape(-1, 3))
    distances, candidates = map(np.asarray, tree.query(new_vertices, k=decimation.neighbours))
    twice_areas, face_normals = _areas_and_normals(new_vertices, new_faces)
    edge = np.sqrt(np.median(twice_areas))
    distances, candidates = distances[new_faces], candidates[new_faces]  # [F, 3, K]
    alignment = np.einsum("fckx,fx->fck", normals.reshape(-1, 3)[candidates], face_normals)
    best = np.argmax(alignment - decimation.distance_weight * distances / edge, axis=-1, keepdims=True)
    return np.take_along_axis(candidates, best, axis=-1)[..., 0].astype(np.int32)
