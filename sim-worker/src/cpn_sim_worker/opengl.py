"""OpenGL, which MuJoCo loads when it is imported, by the backend that MUJOCO_GL names.

A module of its own that imports nothing heavy: what is missing comes up at the first import of MuJoCo, as an error that
does not say what to install.
"""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

import logging
import os
import warnings
from typing import Any

from cpn_sim_worker.session import ConfigError

BACKENDS = {
    "egl": "install libegl1 and libgl1-mesa-dri, or a GPU's driver; or install libosmesa6 and set MUJOCO_GL=osmesa",
    "osmesa": "install libosmesa6, or set MUJOCO_GL=egl",
    "glfw": "set DISPLAY to that of a running X server; without one set MUJOCO_GL=egl or MUJOCO_GL=osmesa",
}
"""Each with what to do if it does not work; packages by their names in Debian."""


class OpenGLError(Exception):
    """OpenGL that is missing or does not draw; tells what to set or install."""

    def __init__(self, reason: object) -> None:
        super().__init__(f"MUJOCO_GL: expected {_backend()} to draw, got {reason}: {BACKENDS[_backend()]}")


def load_mujoco() -> None:
    """Imports MuJoCo.

    Raises:
        OpenGLError: If the backend's library is not there.
        ConfigError: If there is no such backend, or another variable contradicts it.
    """
    if _backend() not in BACKENDS:
        raise ConfigError(f"MUJOCO_GL: expected one of {', '.join(BACKENDS)}, got {os.environ['MUJOCO_GL']!r}")
    platform = os.environ.get("PYOPENGL_PLATFORM")
    if platform and _backend() != "glfw" and platform.lower() != _backend():
        raise ConfigError(f"PYOPENGL_PLATFORM: expected {_backend()}, as MUJOCO_GL, or none, got {platform!r}")
    # It tells at every start that it goes without an accelerator, which nobody needs.
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, OSError) as error:
        raise OpenGLError(f"no library ({error})") from error


def open_context(width: int, height: int) -> Any:  # noqa: ANN401
    """MuJoCo's context of the backend, current in this thread.

    Raises:
        OpenGLError: If there is no device or display, or it cannot draw.
    """
    from mujoco.gl_context import GLContext

    # One whose constructor fails is freed all the same, and would complain of what it has not yet.
    GLContext._context = None
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        try:
            context = GLContext(width, height)
        # Each backend raises another library's errors.
        except Exception as error:
            raise OpenGLError(error) from error
    # GLFW does not raise: the first use would abort the process.
    if not context._context:
        raise OpenGLError(complaints[0].message if complaints else "no context")
    try:
        context.make_current()
    except Exception as error:
        raise OpenGLError(error) from error
    return context


def _backend() -> str:
    return os.environ.get("MUJOCO_GL", "").strip().lower()
