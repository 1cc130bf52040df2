# pyright: reportAttributeAccessIssue=false
import os
import re
import resource
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

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
MESH_ARRAYS = ("mesh_vert", "mesh_face", "mesh_facenum", "mesh_facenormal")


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # Not pytest's own folder, which the other user of `unprivileged` cannot enter.
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # noqa: S103
        monkeypatch.setenv("XDG_CACHE_HOME", folder)
        yield Path(folder) / "cpn" / "meshes"


@pytest.fixture
def unprivileged() -> Iterator[None]:
    """Unprivileged user, for whom permissions are checked even if the tests run as root."""
    if privileged := os.geteuid() == 0:
        os.seteuid(65534)
    yield
    if privileged:
        os.seteuid(0)


def decimate() -> dict[str, NDArray[Any]]:
    light = decimated(mujoco.MjModel.from_xml_string(SPHERES), Decimation(500))
    return {name: getattr(light, name).copy() for name in MESH_ARRAYS}


def test_a_mesh_that_stays_above_the_limit_has_the_fewest_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    faces = {3: 800, 4: 600}
    simplify = meshes.fast_simplification.simplify

    def coarse(*args: Any, target_count: int, agg: int) -> Any:  # noqa: ANN401
        return simplify(*args, target_count=faces.get(agg, 700), agg=agg)

    monkeypatch.setattr(meshes.fast_simplification, "simplify", coarse)
    assert 500 < decimate()["mesh_facenum"].max() <= 600


def assert_decimated_anew(caplog: pytest.LogCaptureFixture, *warnings: str) -> None:
    """Asserts that the meshes are correct, and that the log names each file and fault once."""
    caplog.clear()
    for _ in range(2):
        meshes = decimate()
        assert 400 <= meshes["mesh_facenum"][0] <= 500
    assert len(caplog.messages) == len(warnings)
    for message, warning in zip(caplog.messages, warnings, strict=True):
        assert re.search(warning, message), message


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


def test_the_original_model_is_unchanged() -> None:
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
    for name in MESH_ARRAYS:
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    with pytest.raises(TypeError):
        decimated(model, change)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def rewrite(change: Callable[[dict[str, NDArray[Any]]], object]) -> Callable[[Path], None]:
    """Intact file with invalid contents."""

    def spoil(path: Path) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        change(arrays)
        with path.open("wb") as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]

    return spoil


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda path: path.write_bytes(b""), "EOFError"),
        (cut, "BadZipFile"),
        (flip, "BadZipFile|zlib|error"),
        (lambda path: path.write_bytes(b"\x93NUMPY\x01\x00"), "ValueError|EOFError"),
        (rewrite(lambda arrays: arrays.pop("corners")), "KeyError: .*corners"),
        (rewrite(lambda arrays: arrays.update(faces=arrays["faces"] + 10_000)), "faces: expected numbers from 0 to"),
        (rewrite(lambda arrays: arrays.update(faces=arrays["faces"] - 10_000)), "faces: expected numbers from 0 to"),
        (rewrite(lambda arrays: arrays.update(vertices=arrays["vertices"] * np.inf)), "vertices: expected numbers"),
        (
            rewrite(lambda arrays: arrays.update(vertices=arrays["vertices"][:, :2])),
            r"vertices: expected float32 \[1 to",
        ),
        (rewrite(lambda arrays: arrays.update(corners=arrays["corners"][1:])), "corners: expected .* as many as faces"),
    ],
)
def test_a_damaged_file_is_replaced(
    cache: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], object], fault: str
) -> None:
    expected = decimate()
    (path,) = cache.iterdir()
    whole = path.read_bytes()
    spoil(path)
    assert_decimated_anew(caplog, f"{path} cannot be read: .*({fault}).*; meshes are decimated anew")
    assert path.read_bytes() == whole
    assert list(cache.iterdir()) == [path]
    assert all(np.array_equal(array, expected[name]) for name, array in decimate().items())


@pytest.mark.usefixtures("unprivileged")
def test_a_file_of_another_user_is_replaced(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    decimate()
    (path,) = cache.iterdir()
    path.chmod(0)
    assert_decimated_anew(caplog, f"{path} cannot be read: Permission denied")
    assert path.read_bytes()


@pytest.mark.usefixtures("unprivileged")
def test_a_folder_of_another_user_is_not_needed(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    decimate()
    (path,) = cache.iterdir()
    path.chmod(0)
    cache.chmod(0o555)
    denied = "Permission denied; meshes are decimated anew"
    assert_decimated_anew(caplog, f"{path} cannot be read: {denied}", f"{path} cannot be written: {denied}")
    cache.chmod(0)
    assert_decimated_anew(caplog)
    cache.chmod(0o755)


def test_a_cache_can_be_shared(cache: Path) -> None:
    umask = os.umask(0o022)
    try:
        decimate()
    finally:
        os.umask(umask)
    (path,) = cache.iterdir()
    assert path.stat().st_mode & 0o777 == 0o644


def test_a_full_file_system_is_survived(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    """On a full file system no partial file is left."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        assert_decimated_anew(caplog, f"{cache}/.*npz cannot be written: File too large")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize("place", ["cpn", "cpn/meshes"])
def test_something_else_in_the_place_of_the_folder(cache: Path, caplog: pytest.LogCaptureFixture, place: str) -> None:
    path = cache.parents[1] / place
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    read, write = (f"{cache}/.*npz cannot be {action}: " for action in ("read", "written"))
    assert_decimated_anew(caplog, f"{read}Not a directory", f"{write}(Not a directory|File exists)")
    assert path.read_text() == "mine"


def test_something_else_in_the_place_of_a_file(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    decimate()
    (path,) = cache.iterdir()
    path.unlink()
    os.mkfifo(path)
    # The pipe has no writer, so that reading would never end.
    assert_decimated_anew(caplog, f"{path} cannot be read: ValueError: expected a file")
    assert path.is_file()

    path.unlink()
    path.mkdir()
    decimate()
    assert list(cache.iterdir()) == [path]


def test_a_missing_home_folder_is_survived(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    # As in a container whose user is not in its list of users.
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    unused = "cpn/meshes cannot be used: .* set an absolute HOME or XDG variable; meshes are decimated anew"
    assert_decimated_anew(caplog, unused)
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", "")
    assert_decimated_anew(caplog)
    assert list(tmp_path.iterdir()) == []
