"""OpenGL backend of MuJoCo, which loads the one that MUJOCO_GL names when it is imported.

Without heavy imports, so that it can be used first: if a library is missing, the first import of MuJoCo fails with an
error that does not say what to install.
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
"""Backends, each with the remedy if it does not work; packages by their Debian names."""


class OpenGLError(Exception):
    """OpenGL is missing or does not draw; the message has the remedy."""

    def __init__(self, reason: object) -> None:
        super().__init__(f"MUJOCO_GL: expected {_backend()} to draw, got {reason}: {BACKENDS[_backend()]}")


def load_mujoco() -> None:
    """Imports MuJoCo.

    Raises:
        OpenGLError: If the backend's library is missing.
        ConfigError: If the backend is unknown, or another variable contradicts it.
    """
    if _backend() not in BACKENDS:
        raise ConfigError(f"MUJOCO_GL: expected one of {', '.join(BACKENDS)}, got {os.environ['MUJOCO_GL']!r}")
    platform = os.environ.get("PYOPENGL_PLATFORM")
    if platform and _backend() != "glfw" and platform.lower() != _backend():
        raise ConfigError(f"PYOPENGL_PLATFORM: expected {_backend()}, as MUJOCO_GL, or none, got {platform!r}")
    # PyOpenGL reports at every start that it has no accelerator module, which is not needed.
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, OSError) as error:
        raise OpenGLError(f"no library ({error})") from error


def open_context(width: int, height: int) -> Any:  # noqa: ANN401
    """OpenGL context of the backend, made current in this thread.

    Raises:
        OpenGLError: If there is no device or display, or no context can be created.
    """
    from mujoco.gl_context import GLContext

    # The destructor runs even if the constructor failed, and would miss this attribute.
    GLContext._context = None
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        try:
            context = GLContext(width, height)
        # Each backend raises errors of a different library.
        except Exception as error:
            raise OpenGLError(error) from error

    # GLFW does not raise; the first use would abort the process.
    if not context._context:
        raise OpenGLError(complaints[0].message if complaints else "no context")
    try:
        context.make_current()
    except Exception as error:
        raise OpenGLError(error) from error
    return context


def _backend() -> str:
    return os.environ.get("MUJOCO_GL", "").strip().lower()
