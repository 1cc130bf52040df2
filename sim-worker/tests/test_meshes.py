# pyright: reportAttributeAccessIssue=false
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cpn_sim_worker import meshes
from cpn_sim_worker.meshes import Decimation, decimated


def sphere(points: int) -> str:
    """Points on the unit sphere; MuJoCo makes their hull a mesh."""
    height = np.linspace(-1, 1, points)
    angle = np.arange(points) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return " ".join(map(str, np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1).ravel()))


SPHERES = f"""
<mujoco>
  <asset><mesh name="large" vertex="{sphere(3000)}"/><mesh name="small" vertex="{sphere(30)}"/></asset>
  <worldbody>
    <geom name="large" type="mesh" mesh="large"/>
    <geom name="small" type="mesh" mesh="small" pos="3 0 0"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(meshes, "user_cache_path", lambda _: tmp_path)
    return tmp_path / "meshes"


def test_large_meshes_get_fewer_faces_on_the_same_surface() -> None:
    model = mujoco.MjModel.from_xml_string(SPHERES)
    light = decimated(model, Decimation(500))
    large, small = model.mesh_facenum
    assert large > 5000
    assert 400 <= light.mesh_facenum[0] <= 500
    assert light.mesh_facenum[1] == small
    faces = light.mesh_face[: light.mesh_facenum[0]]
    corners = light.mesh_vert[faces]
    assert np.allclose(np.linalg.norm(corners, axis=-1), 1, atol=0.02)
    normals = light.mesh_normal[light.mesh_facenormal[: len(faces)]]
    assert np.einsum("fcx,fcx->fc", normals, corners).min() > 0.97, "a sphere's normals point where its corners are"


def test_the_original_stays_as_it_was() -> None:
    model, untouched = (mujoco.MjModel.from_xml_string(SPHERES) for _ in range(2))
    decimated(model, Decimation(100))
    for name in ("mesh_vert", "mesh_face", "mesh_facenum", "mesh_facenormal", "geom_pos", "body_inertia"):
        assert np.array_equal(getattr(model, name), getattr(untouched, name)), name


@pytest.mark.parametrize(
    "change",
    [
        Decimation(400),
        Decimation(500, min_aggressiveness=4),
        Decimation(500, max_aggressiveness=11),
        Decimation(500, neighbours=23),
        Decimation(500, distance_weight=0.25),
    ],
)
def test_a_mesh_is_decimated_once(cache: Path, monkeypatch: pytest.MonkeyPatch, change: Decimation) -> None:
    model = mujoco.MjModel.from_xml_string(SPHERES)
    first = decimated(model, Decimation(500))
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr(meshes.fast_simplification, "simplify", None)
    again = decimated(model, Decimation(500))
    for name in ("mesh_vert", "mesh_face", "mesh_facenum", "mesh_facenormal"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    with pytest.raises(TypeError):
        decimated(model, change)
