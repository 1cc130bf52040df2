import ctypes.util
import os
import re
import subprocess

import pytest
import zenoh

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.session import ask
from tests.support import COMMAND, READY_SECONDS, StartWorker


def run(subcommand: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    # MuJoCo, imported by another test, may have left its choice of a platform.
    plain = {
        key: value for key, value in os.environ.items() if not key.endswith("DISPLAY") and key != "PYOPENGL_PLATFORM"
    }
    return subprocess.run(
        [COMMAND, *subcommand.split()],
        env=plain | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=READY_SECONDS,
    )


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"MUJOCO_GL": "glfw"}, "MUJOCO_GL: expected glfw to draw, got .*DISPLAY.*: .* set MUJOCO_GL=egl or"),
        ({"MUJOCO_GL": "osmesa"}, "MUJOCO_GL: expected osmesa to draw, got no library .*: install libosmesa6, or"),
        ({"MUJOCO_GL": "vulkan"}, "MUJOCO_GL: expected one of egl, osmesa, glfw, got 'vulkan'"),
        ({"MUJOCO_GL": "off"}, "MUJOCO_GL: expected one of egl, osmesa, glfw, got 'off'"),
        ({"MUJOCO_EGL_DEVICE_ID": "99"}, "MUJOCO_GL: expected egl to draw, got .*MUJOCO_EGL_DEVICE_ID .*, got 99"),
        ({"PYOPENGL_PLATFORM": "osmesa"}, "PYOPENGL_PLATFORM: expected egl, as MUJOCO_GL, or none, got 'osmesa'"),
        # As where no driver is installed.
        ({"__EGL_VENDOR_LIBRARY_DIRS": "/missing"}, "MUJOCO_GL: expected egl to draw, got .*: install libegl1 and"),
    ],
)
def test_worker_that_cannot_draw_is_never_ready(environment: dict[str, str], message: str) -> None:
    if environment == {"MUJOCO_GL": "osmesa"} and ctypes.util.find_library("OSMesa"):
        pytest.skip("OSMesa is installed")
    for subcommand in ("serve", "demonstrate --tasks reach"):
        end = run(subcommand, environment)
        assert end.returncode == 1
        assert "is ready" not in end.stderr
        assert "Traceback" not in end.stderr
        assert re.search(message, end.stderr), end.stderr


def test_empty_variables_count_as_unset(
    monkeypatch: pytest.MonkeyPatch, session: zenoh.Session, start_worker: StartWorker
) -> None:
    for variable in ("MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", "PYOPENGL_PLATFORM", "LP_NUM_THREADS"):
        monkeypatch.setenv(variable, "")
    start_worker("plain")
    request = sim_pb2.ResetRequest(variation=types_pb2.Variation(task="reach", seed=1))
    assert ask(session, keys.sim_reset("plain"), request, sim_pb2.ResetResponse, READY_SECONDS).observation.data
