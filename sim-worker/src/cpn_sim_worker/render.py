"""Camera images of a MuJoCo scene."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

from typing import ClassVar

import mujoco
import numpy as np
from mujoco.gl_context import GLContext
from numpy.typing import NDArray

from cpn_sim_worker.spaces import IMAGE_SIZE

CAMERA = "corner4"
"""The close pose, in which 84 pixels still resolve a handle."""

MAX_GEOMS = 1000


class Renderer:
    """Draws one model at a time; call it from one thread only.

    Each `mujoco.Renderer` brings a GL context, and a second one in a process returns stale or garbage frames without
    an error. So here one GL context lives as long as the process, and a new model replaces the resources of the one
    before in that same context.
    """

    _exists: ClassVar[bool] = False

    def __init__(self) -> None:
        if Renderer._exists:
            raise RuntimeError("a process can hold one Renderer only: a second one would return garbage frames")
        self._gl = GLContext(IMAGE_SIZE, IMAGE_SIZE)
        Renderer._exists = True
        self._gl.make_current()
        self._viewport = mujoco.MjrRect(0, 0, IMAGE_SIZE, IMAGE_SIZE)
        self._option = mujoco.MjvOption()
        # Sites are markers of no substance, and among them are the coloured goals that would give the task away.
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._model: mujoco.MjModel | None = None
        self._context: mujoco.MjrContext | None = None

    def _load(self, model: mujoco.MjModel) -> mujoco.MjrContext:
        if self._context is not None:
            self._context.free()
        # Shadows, reflections and multisampling are nine tenths of the time in a software renderer.
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = IMAGE_SIZE
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera.fixedcamid = model.camera(CAMERA).id
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._model = model
        return self._context

    def render(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        """The scene as the camera sees it: [84, 84, 3], RGB, rows from the top."""
        context = self._context if self._context is not None and model is self._model else self._load(model)
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, context)
        pixels = np.empty((IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, context)
        # GL's rows run from the bottom, and Meta-World hangs this camera upside down: the two cancel out for the
        # rows, while the columns still run from right to left.
        return np.ascontiguousarray(pixels[:, ::-1])
