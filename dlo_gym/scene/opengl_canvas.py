"""A canvas that MuJoCo draws on with OpenGL."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

import ctypes
import importlib.util
import os
import sys
import weakref
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.camera import CameraModel

_SEGMENT_FLAGS = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
_RED = 255
SCENERY_GROUP = 1  # of the geoms that never move


class _Layer(NamedTuple):
    """Colours (height, width, 3) and OpenGL depths (height, width) in [0, 1], rows upwards.

    Without depths where shadows are drawn.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None


class OpenGlCanvas:
    """An offscreen framebuffer of one model, with its OpenGL context."""

    def __init__(self, model: mujoco.MjModel, *, shadows: bool) -> None:
        self._model = model
        self._option = mujoco.MjvOption()
        self._shown = self._option.geomgroup.copy()
        self._shadows = shadows
        self._scenery: dict[str, _Layer] = {}
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 64)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        self._gl, self._context = _open_context(model)
        self.close = weakref.finalize(self, _free_context, self._gl, self._context)
        self.close.atexit = False  # MuJoCo's own exit handler may have ended EGL by then

    def color(self, data: mujoco.MjData, name: str, pinhole: CameraModel) -> NDArray[np.uint8]:
        """RGB (height, width, 3) of the model's camera ``name``.

        Cameras and scenery stand still, so the scenery is drawn once per camera, and what moves is
        laid over it by depth; pixel for pixel the same. Shadows fall on scenery: then all is drawn.
        """
        if self._shadows:
            self._look(data, name)
            return cv2.flip(self._draw(pinhole).rgb, 0)  # type: ignore[return-value]
        if name not in self._scenery:
            self._option.geomgroup[:] = np.arange(len(self._option.geomgroup)) == SCENERY_GROUP
            self._look(data, name)
            self._scenery[name] = self._draw(pinhole)
        scenery = self._scenery[name]
        self._option.geomgroup[:] = self._shown
        self._option.geomgroup[SCENERY_GROUP] = 0
        self._look(data, name)
        self._option.geomgroup[:] = self._shown
        moving = self._draw(pinhole)
        rgb = scenery.rgb.copy()
        nearer = cv2.compare(moving.depth, scenery.depth, cv2.CMP_LT)  # type: ignore[arg-type]
        cv2.copyTo(moving.rgb, nearer, rgb)
        return cv2.flip(rgb, 0)  # type: ignore[return-value]

    def mask(
        self, data: mujoco.MjData, name: str, pinhole: CameraModel, geom_ids: NDArray[np.intp]
    ) -> NDArray[np.uint8]:
        """1 where a pixel (height, width) of camera ``name`` shows one of the geoms, else 0."""
        self._look(data, name)
        wanted = set(geom_ids.tolist())
        for geom in self._scene.geoms[: self._scene.ngeom]:
            # MuJoCo draws segment i in the 24-bit colour i + 1, red first.
            geom.segid = _RED - 1 if geom.objid in wanted else 0
        self._scene.flags[_SEGMENT_FLAGS] = True
        try:
            return np.ascontiguousarray(self._draw(pinhole).rgb[::-1, :, 0] == _RED).view(np.uint8)
        finally:
            self._scene.flags[_SEGMENT_FLAGS] = False

    def forget_scenery(self) -> None:
        """Draw the scenery anew at the next look, for what stands in it has changed."""
        self._scenery.clear()

    def _look(self, data: mujoco.MjData, name: str) -> None:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = self._model.camera(name).id
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )

    def _draw(self, pinhole: CameraModel) -> "_Layer":
        """What the scene holds; OpenGL's rows go upwards."""
        self._gl.make_current()
        rectangle = mujoco.MjrRect(0, 0, pinhole.width, pinhole.height)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        rgb = np.empty((pinhole.height, pinhole.width, 3), dtype=np.uint8)
        depth = None
        if not self._shadows:
            depth = np.empty((pinhole.height, pinhole.width), dtype=np.float32)
        mujoco.mjr_readPixels(rgb, depth, rectangle, self._context)
        return _Layer(rgb, depth)


def _open_context(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """A current OpenGL context of MUJOCO_GL's kind (EGL if unset) with the model's data in it."""
    backend = os.environ.setdefault("MUJOCO_GL", "egl").lower()
    _load_triton()
    try:
        if backend == "egl":
            from mujoco.egl import GLContext
        else:
            from mujoco.gl_context import GLContext
        gl = GLContext(model.vis.global_.offwidth, model.vis.global_.offheight)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    except Exception as error:  # PyOpenGL fails in as many ways as there are broken installations
        raise RenderingUnavailable(
            f"no headless OpenGL context (MUJOCO_GL={backend}): {error}; on Debian and Ubuntu:"
            "  apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
        ) from error
    return gl, context


def _load_triton() -> None:
    """Load the library of triton, which comes with torch's CUDA build, ahead of Mesa's.

    Both hold an LLVM of their own, and loaded after Mesa's, triton's takes the other for its own
    and crashes when an optimiser imports it.
    """
    spec = importlib.util.find_spec("triton")
    if spec is not None and spec.origin is not None and "triton" not in sys.modules:
        for library in Path(spec.origin).parent.glob("_C/libtriton*.so"):
            ctypes.CDLL(str(library))


def _free_context(gl: Any, context: mujoco.MjrContext) -> None:
    gl.make_current()
    context.free()
    gl.free()
