"""Rendering of a scene's camera images."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

import atexit
import copy
from dataclasses import asdict
from functools import cache
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from cpn_sim_worker.meshes import LIBRARIES, Decimation, decimated
from cpn_sim_worker.opengl import OpenGLError, open_context
from cpn_sim_worker.render_spec import RenderSpec, installed_version
from cpn_sim_worker.scene import Scene
from cpn_sim_worker.spaces import IMAGE_SIZE

MAX_GEOMS = 1000

DECIMATION = Decimation()

TESSELLATION = (2, 16, 8)
"""Quads, slices and stacks of primitive shapes if meshes are decimated: about half of MuJoCo's defaults."""


class Renderer:
    """Offscreen renderer of one scene at a time, for use from a single thread.

    Each `mujoco.Renderer` creates a GL context, and a second one in a process returns stale or garbage frames without
    an error. Here a single GL context lives as long as the process, and a new model replaces the resources of the
    previous one in it.

    It draws a copy of the scene's model, with decimated meshes unless `decimation` is None; the physics keeps the
    original.
    """

    _exists: ClassVar[bool] = False

    def __init__(self, decimation: Decimation | None = DECIMATION) -> None:
        if Renderer._exists:
            raise RuntimeError("a process can hold one Renderer only: a second one would return garbage frames")
        self._decimation = decimation
        self._gl = open_context(IMAGE_SIZE, IMAGE_SIZE)
        Renderer._exists = True
        self._viewport = mujoco.MjrRect(0, 0, IMAGE_SIZE, IMAGE_SIZE)
        self._option = mujoco.MjvOption()
        # Sites are markers without physics; some are coloured goals, which would leak the task's solution.
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._scene: Scene | None = None
        self._context: mujoco.MjrContext | None = None

    def close(self) -> None:
        """Frees the GL context; the renderer draws no more."""
        if self._context is not None:
            self._context.free()
        self._gl.free()

    def spec(self, scene: Scene) -> RenderSpec:
        """Render spec of a scene's images."""
        packages = ("mujoco", *scene.libraries, *(LIBRARIES if self._decimation else ()))
        return RenderSpec(
            camera=scene.camera.name,
            flip=scene.camera.flip,
            height=IMAGE_SIZE,
            width=IMAGE_SIZE,
            hidden_sites=True,
            shadows=False,
            reflections=False,
            multisamples=0,
            decimation=asdict(self._decimation) if self._decimation else None,
            tessellation=self._tessellation(scene),
            revision=scene.revision,
            versions={package: installed_version(package) for package in packages},
        )

    def _tessellation(self, scene: Scene) -> tuple[int, int, int]:
        quality = scene.model.vis.quality
        return TESSELLATION if self._decimation else (quality.numquads, quality.numslices, quality.numstacks)

    def _load(self, scene: Scene) -> mujoco.MjrContext:
        if self._context is not None:
            self._context.free()
        model = decimated(scene.model, self._decimation) if self._decimation else copy.copy(scene.model)
        # Without shadows, reflections and multisampling, which would take most of a software renderer's time.
        quality = model.vis.quality
        quality.offsamples = quality.shadowsize = 0
        quality.numquads, quality.numslices, quality.numstacks = self._tessellation(scene)
        model.vis.global_.offwidth = model.vis.global_.offheight = IMAGE_SIZE
        self._drawing = mujoco.MjvScene(model, MAX_GEOMS)
        self._drawing.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._drawing.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera.fixedcamid = model.camera(scene.camera.name).id
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
        except mujoco.FatalError as error:
            raise OpenGLError(error) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._model = model
        self._scene = scene
        return self._context

    def render(self, scene: Scene) -> NDArray[np.uint8]:
        """Camera image of the scene, [84, 84, 3], RGB, rows from the top, not mirrored."""
        context = self._context if self._context is not None and scene is self._scene else self._load(scene)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, scene.data, self._option, None, self._camera, everything, self._drawing)
        mujoco.mjr_render(self._viewport, self._drawing, context)
        pixels = np.empty((IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, context)
        # GL's rows start at the bottom. For a camera mounted upside down that gives rows from the top, but columns from
        # the right.
        flipped = pixels[::-1] if scene.camera.flip == "rows" else pixels[:, ::-1]
        return np.ascontiguousarray(flipped)


@cache
def process_renderer() -> Renderer:
    """Renderer of the process, made by the first call, for several simulators that take turns.

    Raises:
        OpenGLError: If OpenGL is missing or does not draw.
        RuntimeError: If the process has made another.
    """
    renderer = Renderer()
    # Its destructor would be too late: while the interpreter shuts down PyOpenGL fails to import, and logs that.
    atexit.register(renderer.close)
    return renderer
