"""Images, masks and visibility of the posed cell."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.obstacles import Obstacle
from dlo_gym.scene._kernels_rays import first_hits
from dlo_gym.scene.builder import SceneConfig, build_spec
from dlo_gym.scene.furnishings import Clutter, Furnishings
from dlo_gym.scene.lens import Lens
from dlo_gym.scene.opengl_canvas import SCENERY_GROUP, OpenGlCanvas
from dlo_gym.scene.primitives import ModelPrimitives
from dlo_gym.scene.rasteriser import RasterCanvas


class Canvas(Protocol):
    """Draws one posed model as its cameras' pinholes see it."""

    def color(self, data: mujoco.MjData, name: str, pinhole: CameraModel) -> NDArray[np.uint8]:
        """RGB (height, width, 3) of the model's camera ``name``."""
        ...

    def mask(
        self, data: mujoco.MjData, name: str, pinhole: CameraModel, geom_ids: NDArray[np.intp]
    ) -> NDArray[np.uint8]:
        """1 where a pixel (height, width) of camera ``name`` shows one of the geoms, else 0."""
        ...

    def forget_scenery(self) -> None:
        """Draw the scenery anew at the next look, for what stands in it has changed."""
        ...

    @property
    def close(self) -> Callable[[], Any]: ...


class SceneRenderer:
    """Poses the cell and draws it as its cameras see it.

    Poses, visibility, collisions and the rasteriser's images need no OpenGL; the headless context
    is made with the first image. Use as a context manager, or call ``close``.

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
        self.model.geom_group[fixed] = SCENERY_GROUP
        self.rod_radius = self.config.rod_radius
        self._positions: Array | None = None
        self._furnishings = Furnishings(
            self.model, len(self.config.obstacle_colors), self.config.n_clutter
        )
        self._primitives = ModelPrimitives(self.model)
        self._canvas: Canvas | None = None

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
            positions: (n_nodes, 3) centerline in world [m]; (0, 3) where there is no rod.
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

    def furnish(self, obstacles: Sequence[Obstacle] = (), clutter: Clutter | None = None) -> None:
        """Put obstacles and clutter into the cell, in place of those that are there.

        ``update`` poses them.

        Raises:
            ValueError: on more obstacles than the config has colours for, or a plane.
        """
        self._furnishings.place_obstacles(obstacles, self.config.obstacle_colors)
        self._furnishings.strew(clutter)
        if self._canvas is not None:
            self._canvas.forget_scenery()

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
            RenderingUnavailable: if it takes OpenGL and no headless context can be made.
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
            RenderingUnavailable: if it takes OpenGL and no headless context can be made.
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
        if len(positions) == 0:
            return np.zeros(0, dtype=bool)
        facing = _facing_points(positions, camera.centre, self.rod_radius)
        rays = facing - camera.centre
        distances = np.linalg.norm(rays, axis=1)
        rays /= distances[:, None]
        visible = np.array(camera.sees(camera.project(positions)))
        hits = first_hits(camera.centre, rays, self._primitives.posed(self.data))
        return visible & (hits >= distances - self.rod_radius)

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

    def _open_canvas(self) -> Canvas:
        self._require_positions()
        if self._canvas is None:
            if self.config.renderer == "raster":
                scenery = np.flatnonzero(self.model.geom_group == SCENERY_GROUP)
                self._canvas = RasterCanvas(self.model, scenery)
            else:
                self._canvas = OpenGlCanvas(self.model, shadows=self.config.quality == "high")
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
