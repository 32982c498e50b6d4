"""Images, masks and visibility of the posed cell."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

import os
import weakref
from types import TracebackType
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.builder import SceneConfig, build_spec
from dlo_gym.scene.lens import Lens

_SEGMENT_FLAGS = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
_RED = 255
_SCENERY = 1  # geom group of what never moves


class SceneRenderer:
    """Poses the cell and draws it as its cameras see it.

    Poses, visibility and collisions need no OpenGL; the headless context is made with the first
    image. Use as a context manager, or call ``close``.

    Args:
        config: what stands in the cell and how it is drawn.
    """

    def __init__(self, config: SceneConfig | None = None) -> None:
        self.config = SceneConfig() if config is None else config
        self.arms = self.config.arms
        self.joint_angles = self.arms.home.copy()
        self.model = build_spec(self.config).compile()
        self.data = mujoco.MjData(self.model)
        self._lenses = {lens.camera.name: lens for lens in self.config.lenses}
        self._rod = _geoms(self.model, "rod", self.config.n_nodes - 1)
        self._occluders = _geoms(self.model, "occluder", self.config.n_occluders)
        moving = np.concatenate([self._rod, self._occluders])
        fixed = np.setdiff1d(np.flatnonzero(self.model.geom_bodyid == 0), moving)
        self.model.geom_group[fixed] = _SCENERY
        self.rod_radius = self.config.rod_radius
        self._positions: Array | None = None
        self._canvas: _Canvas | None = None

    def __enter__(self) -> "SceneRenderer":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Frees the OpenGL context; closing twice does no harm."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None

    def update(
        self,
        positions: ArrayLike,
        boundary: BoundaryPoses,
        occluder_positions: ArrayLike | None = None,
        joint_angles: ArrayLike | None = None,
    ) -> None:
        """Poses rod, arms and occluders.

        Args:
            positions: (n_nodes, 3) centerline in world [m].
            boundary: the clamps that the grippers hold.
            occluder_positions: (n_occluders, 3) centres in world [m]; NaN, like None, hides.
            joint_angles: (2, 6) [rad]; by inverse kinematics from the last ones when omitted.

        Raises:
            UnreachablePose: where an arm cannot hold its clamp; nothing has moved then.
            ValueError: on a wrong shape, or a centerline that is not finite.
        """
        positions = np.ascontiguousarray(positions, dtype=np.float64)
        expected = (self.config.n_nodes, 3)
        if positions.shape != expected or not np.isfinite(positions).all():
            raise ValueError(
                f"positions: expected finite values of shape {expected}, got shape"
                f" {positions.shape}"
            )
        hidden = np.full((self.config.n_occluders, 3), np.nan)
        occluders = hidden if occluder_positions is None else np.asarray(occluder_positions)
        if occluders.shape != hidden.shape:
            raise ValueError(
                f"occluder_positions: expected shape {hidden.shape}, got {occluders.shape}"
            )
        if joint_angles is None:
            self.joint_angles = self.arms.inverse_kinematics(boundary, self.joint_angles)
        else:
            self.arms.forward_kinematics(joint_angles)
            self.joint_angles = np.array(joint_angles, dtype=np.float64)
        self.data.qpos[:] = self.joint_angles.ravel()
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._pose_rod(positions)
        self._pose_occluders(occluders)

    def dress_rod(self, radius: float, color: ArrayLike | None = None) -> None:
        """Draw the rod with another ``radius`` [m] and RGB in [0, 1], the config's where None."""
        self.rod_radius = radius
        self.model.geom_size[self._rod, 0] = radius
        rgb = self.config.rod_color if color is None else color
        self.model.mat_rgba[self.model.material("rod").id, :3] = rgb

    def _pose_rod(self, positions: Array) -> None:
        # Written over mj_kinematics' result: fifty bodies that never interact need no joints.
        axes = np.diff(positions, axis=0)
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        axes /= np.maximum(lengths, 1e-12)
        across = np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        frames = np.stack([across, np.cross(axes, across), axes], axis=-1)
        self.data.geom_xpos[self._rod] = (positions[1:] + positions[:-1]) / 2
        self.data.geom_xmat[self._rod] = frames.reshape(-1, 9)
        self.model.geom_size[self._rod, 1] = lengths[:, 0] / 2
        self.model.geom_rbound[self._rod] = lengths[:, 0] / 2 + self.rod_radius
        self._positions = positions

    def _pose_occluders(self, occluders: Array) -> None:
        shown = np.asarray(np.isfinite(occluders).all(axis=1))
        self.data.geom_xpos[self._occluders] = np.where(shown[:, None], occluders, 0.0)
        self.data.geom_xmat[self._occluders] = np.eye(3).ravel()
        # Neither drawing nor rays see a geom of zero alpha.
        self.model.geom_rgba[self._occluders, 3] = shown

    def render(self, camera_name: str, stamp: float = 0.0) -> View:
        """The cell as one camera sees it.

        Raises:
            RenderingUnavailable: if no headless OpenGL context can be made.
        """
        lens = self._lens(camera_name)
        image = self._open_canvas().color(self.data, camera_name, lens.pinhole)
        return View(lens.apply(image), lens.camera, stamp)

    def views(self, stamp: float = 0.0) -> tuple[View, ...]:
        """One view per camera, in the config's order."""
        return tuple(self.render(name, stamp) for name in self._lenses)

    def rod_mask(self, camera_name: str) -> NDArray[np.bool_]:
        """The pixels (height, width) that show the rod.

        Raises:
            RenderingUnavailable: if no headless OpenGL context can be made.
        """
        lens = self._lens(camera_name)
        mask = self._open_canvas().mask(self.data, camera_name, lens.pinhole, self._rod)
        return lens.apply(mask, nearest=True).astype(bool)

    def visibility(self, camera_name: str) -> NDArray[np.bool_]:
        """Whether the camera sees each node (n_nodes,); false outside its image.

        A node is seen if the ray from the optical centre to the point of the rod's surface that
        faces the camera there meets nothing before it, to within a radius. Rays are exact on the
        very primitives that are drawn, rod included, whatever the image's resolution; a lookup in
        the rendered image would miss a rod that is thinner than a pixel.
        """
        camera = self._lens(camera_name).camera
        positions = self._require_positions()
        facing = _facing_points(positions, camera.centre, self.rod_radius)
        rays = facing - camera.centre
        distances = np.linalg.norm(rays, axis=1)
        rays /= distances[:, None]
        visible = np.array(camera.sees(camera.project(positions)))
        geom = np.zeros(1, dtype=np.int32)
        for i in np.flatnonzero(visible):
            hit = mujoco.mj_ray(self.model, self.data, camera.centre, rays[i], None, True, -1, geom)
            visible[i] = hit < 0 or hit >= distances[i] - self.rod_radius
        return visible

    def arms_in_collision(self) -> bool:
        """Whether arms or grippers touch each other, themselves or the table."""
        return self.arms.clearance(self.joint_angles).minimum < 0.0

    def _lens(self, camera_name: str) -> Lens:
        try:
            return self._lenses[camera_name]
        except KeyError:
            raise ValueError(
                f"camera_name: there is no {camera_name!r}; there are: {', '.join(self._lenses)}"
            ) from None

    def _require_positions(self) -> Array:
        if self._positions is None:
            raise ValueError("the scene has no pose yet: call update first")
        return self._positions

    def _open_canvas(self) -> "_Canvas":
        self._require_positions()
        if self._canvas is None:
            self._canvas = _Canvas(self.model, shadows=self.config.quality == "high")
        return self._canvas


def _geoms(model: mujoco.MjModel, prefix: str, n: int) -> NDArray[np.intp]:
    return np.array([model.geom(f"{prefix}_{i}").id for i in range(n)], dtype=np.intp)


def _facing_points(positions: Array, centre: Array, radius: float) -> Array:
    """Per node the point (n, 3) of the rod's surface, across the rod, nearest to ``centre``."""
    tangents = np.gradient(positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    towards = centre - positions
    across = towards - (towards * tangents).sum(axis=1, keepdims=True) * tangents
    norms = np.linalg.norm(across, axis=1, keepdims=True)
    return positions + radius * across / np.maximum(norms, 1e-12)


class _Layer(NamedTuple):
    """Colours (height, width, 3) and OpenGL depths (height, width) in [0, 1], rows upwards.

    Without depths where shadows are drawn.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None


class _Canvas:
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
            self._option.geomgroup[:] = np.arange(len(self._option.geomgroup)) == _SCENERY
            self._look(data, name)
            self._scenery[name] = self._draw(pinhole)
        scenery = self._scenery[name]
        self._option.geomgroup[:] = self._shown
        self._option.geomgroup[_SCENERY] = 0
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


def _free_context(gl: Any, context: mujoco.MjrContext) -> None:
    gl.make_current()
    context.free()
    gl.free()
