"""The dual-arm cell as a MuJoCo model."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import mujoco
import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import matrix_to_quaternion
from dlo_gym.scene import arm_model, cell_model
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.board import BoardPlate, add_board
from dlo_gym.scene.furnishings import add_places
from dlo_gym.scene.lens import Lens

MULTISAMPLES = 4  # of quality "high"
_PIXEL_PITCH = 3e-6  # any positive one does; MuJoCo wants intrinsics on a sensor of some size [m]


def default_cameras(scale: float = 1.0) -> tuple[CameraModel, CameraModel]:
    """The cameras ``side`` and ``top``, 1920x1080 times ``scale``, focal length as an OAK-1's."""
    side = CameraModel.looking_at("side", (0.05, -1.05, 0.42), (0.0, 0.0, 0.29))
    top = CameraModel.looking_at("top", (0.02, -0.1, 1.25), (0.0, 0.0, 0.30), up=(0.0, 1.0, 0.0))
    return side.scaled(scale), top.scaled(scale)


@dataclass(frozen=True, eq=False)
class SceneConfig:
    """What stands in the cell and how it is drawn.

    Attributes:
        cameras: fixed cameras, each with a name of its own.
        rod_radius: of the drawn rod [m].
        n_nodes: of the rod's centerline; 0 where there is no rod.
        rod_color: RGB in [0, 1].
        clutter: "none", or "industrial" parts on the table (the paper's scenario S2).
        n_distractor_cables: other cables lying on the table.
        n_occluders: opaque boxes that ``SceneRenderer.update`` moves.
        occluder_size: full extents in x, y, z [m].
        obstacle_colors: RGB in [0, 1] of each obstacle that ``SceneRenderer.furnish`` may place.
        n_clutter: how many cables, and how many blocks, it may strew on the table.
        renderer: "opengl", or "raster" without OpenGL, several times as fast on a CPU, which
            draws neither boards nor "high" quality.
        quality: "fast", or "high" with shadows and antialiasing.
        seed: of the distractor cables' curves.
        arms: where the arms stand.
        boards: printed plates that the grippers carry, at most one each.

    Raises:
        ValueError: naming the field.
    """

    cameras: tuple[CameraModel, ...] = field(default_factory=default_cameras)
    rod_radius: float = 0.003
    n_nodes: int = 51
    rod_color: tuple[float, float, float] = (0.80, 0.13, 0.07)
    clutter: Literal["none", "industrial"] = "none"
    n_distractor_cables: int = 0
    n_occluders: int = 0
    occluder_size: tuple[float, float, float] = (0.12, 0.08, 0.12)
    obstacle_colors: tuple[tuple[float, float, float], ...] = ()
    n_clutter: int = 0
    renderer: Literal["opengl", "raster"] = "opengl"
    quality: Literal["fast", "high"] = "fast"
    seed: int = 0
    arms: DualArm = field(default_factory=DualArm)
    boards: tuple[BoardPlate, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "boards", tuple(self.boards))
        carriers = [plate.side for plate in self.boards]
        if len(set(carriers)) != len(carriers):
            raise ValueError(f"boards: expected at most one per arm, got {', '.join(carriers)}")
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"cameras: expected at least one, with distinct names, got {names}")
        if not 0.0 < self.rod_radius < 0.05:
            raise ValueError(f"rod_radius: expected 0 < radius < 0.05 m, got {self.rod_radius}")
        if self.n_nodes < 2 and self.n_nodes != 0:
            raise ValueError(f"n_nodes: expected at least 2, or 0 for no rod, got {self.n_nodes}")
        for name, colors in (
            ("rod_color", (self.rod_color,)),
            ("obstacle_colors", self.obstacle_colors),
        ):
            for color in map(np.asarray, colors):
                if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
                    raise ValueError(f"{name}: expected RGB in [0, 1], got {color.tolist()}")
        for name, choices in (
            ("clutter", ("none", "industrial")),
            ("renderer", ("opengl", "raster")),
            ("quality", ("fast", "high")),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if self.renderer == "raster" and (self.quality != "fast" or self.boards):
            raise ValueError(
                'renderer: expected "opengl" for boards or quality "high", got "raster" with'
                f" {len(self.boards)} boards and quality {self.quality!r}"
            )
        for name in ("n_distractor_cables", "n_occluders", "n_clutter"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        size = np.asarray(self.occluder_size, dtype=np.float64)
        if size.shape != (3,) or not (np.isfinite(size) & (size > 0)).all():
            raise ValueError(
                f"occluder_size: expected three positive extents [m], got {self.occluder_size}"
            )

    @cached_property
    def lenses(self) -> tuple[Lens, ...]:
        """Each camera's lens, in the cameras' order."""
        return tuple(Lens.of(camera) for camera in self.cameras)


def build_spec(config: SceneConfig) -> mujoco.MjSpec:
    """The scene as an editable specification; ``compile()`` makes the model.

    Geoms ``rod_<element>`` and ``occluder_<k>`` lie in the world body and are posed by
    ``SceneRenderer``; hinges ``<side>_joint_<1..6>`` carry the arms; sites ``<side>_tcp`` are the
    gripper's tool centre points.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "dlo_cell"
    spec.stat.extent = 1.0
    spec.stat.center = [0.0, 0.1, 0.25]
    high = config.quality == "high"
    spec.visual.quality.offsamples = MULTISAMPLES if high else 0
    spec.visual.quality.shadowsize = 2048 if high else 0
    # Directional light needs no finer tessellation: the software rasteriser's time goes there.
    spec.visual.quality.numslices = 28 if high else 16
    spec.visual.quality.numstacks = 6 if high else 4
    spec.visual.quality.numquads = 1
    spec.visual.map.znear = 0.02
    spec.visual.map.zfar = 15.0
    spec.visual.map.shadowclip = 1.6
    pinholes = [lens.pinhole for lens in config.lenses]
    spec.visual.global_.offwidth = max(pinhole.width for pinhole in pinholes)
    spec.visual.global_.offheight = max(pinhole.height for pinhole in pinholes)

    spec.add_material(name="metal", specular=0.6, shininess=0.6)
    arm_model.add_materials(spec)
    cell_model.add_room(spec)
    cell_model.add_table(spec, config.arms.T_world_base[:, :3, 3])
    cell_model.add_lights(spec, shadows=high)
    if config.clutter == "industrial":
        cell_model.add_clutter(spec)
    rng = np.random.default_rng(config.seed)
    cell_model.add_distractor_cables(spec, config.n_distractor_cables, rng)
    for side, T_world_base in zip(SIDES, config.arms.T_world_base, strict=True):
        arm_model.add_arm(spec, side, T_world_base, config.rod_radius)
    for plate in config.boards:
        add_board(spec, plate, config.arms.T_flange_tcp[SIDES.index(plate.side)])
    _add_rod(spec, config)
    _add_occluders(spec, config)
    add_places(spec, len(config.obstacle_colors), config.n_clutter)
    for pinhole in pinholes:
        _add_camera(spec, pinhole)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    return spec


def _add_rod(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    spec.add_material(name="rod", rgba=[*config.rod_color, 1.0], specular=0.25, shininess=0.4)
    for i in range(config.n_nodes - 1):
        spec.worldbody.add_geom(
            name=f"rod_{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[config.rod_radius, 0.005, 0.0],
            material="rod",
        )


def _add_occluders(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    for k in range(config.n_occluders):
        spec.worldbody.add_geom(
            name=f"occluder_{k}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=np.asarray(config.occluder_size) / 2,
            rgba=[0.70, 0.66, 0.57, 1.0],
        )


def _add_camera(spec: mujoco.MjSpec, pinhole: CameraModel) -> None:
    size = np.array([pinhole.width, pinhole.height])
    R_world_camera = pinhole.T_world_camera[:3, :3]
    spec.worldbody.add_camera(
        name=pinhole.name,
        pos=pinhole.T_world_camera[:3, 3],
        # OpenGL's camera looks along -z with y up.
        quat=matrix_to_quaternion(R_world_camera * [1.0, -1.0, -1.0]),
        resolution=size,
        sensor_size=size * _PIXEL_PITCH,
        focal_pixel=[pinhole.K[0, 0], pinhole.K[1, 1]],
        # MuJoCo counts the principal point from the image's centre to the left and upwards.
        principal_pixel=(size - 1) / 2 - pinhole.K[:2, 2],
    )
