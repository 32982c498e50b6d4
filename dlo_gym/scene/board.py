"""A flat printed plate that a gripper carries, such as a calibration board."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Literal

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array, check_single_pose, matrix_to_quaternion

_THICKNESS = 0.003


@dataclass(frozen=True, eq=False)
class BoardPlate:
    """A picture on a stiff plate in a gripper.

    Attributes:
        side: the arm that carries it.
        picture: (h, w) grey or (h, w, 3) RGB, uint8, without margin.
        size: width and height of the picture [m].
        T_tcp_board: (4, 4) of the picture's top left corner: x to the right, y down, z into the
            plate.
        margin: of white plate around the picture [m].

    Raises:
        ValueError: naming the field.
    """

    side: Literal["left", "right"]
    picture: NDArray[np.uint8]
    size: tuple[float, float]
    T_tcp_board: Array
    margin: float = 0.012

    def __post_init__(self) -> None:
        if self.side not in ("left", "right"):
            raise ValueError(f"side: expected left or right, got {self.side!r}")
        picture = np.asarray(self.picture)
        colours = picture.shape[2:] in ((), (3,))
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or not colours:
            raise ValueError(
                "picture: expected uint8 of shape (h, w) or (h, w, 3), got"
                f" {picture.dtype} {picture.shape}"
            )
        if not (min(self.size) > 0 and np.isfinite(self.size).all() and len(self.size) == 2):
            raise ValueError(f"size: expected two positive lengths [m], got {self.size}")
        if not 0.0 <= self.margin < 1.0:
            raise ValueError(f"margin: expected 0 <= margin < 1 m, got {self.margin}")
        pose = check_single_pose(self.T_tcp_board, "T_tcp_board")
        object.__setattr__(self, "T_tcp_board", pose)


def add_board(spec: mujoco.MjSpec, plate: BoardPlate, T_flange_tcp: Array) -> None:
    """Adds the plate to its arm's flange as a textured mesh, geom ``<side>_board``."""
    name = f"{plate.side}_board"
    picture = np.asarray(plate.picture)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    rows, columns = picture.shape[:2]
    # The margin is part of the texture: the pattern's outline must not be a mesh's edge.
    pad = np.ceil(plate.margin / np.asarray(plate.size) * [columns, rows]).astype(int)
    picture = np.pad(picture, ((pad[1],) * 2, (pad[0],) * 2, (0, 0)), constant_values=255)
    margin = pad / [columns, rows] * plate.size
    # As a file in memory: the specification takes raw texels only one Python number at a time.
    encoded = cv2.imencode(".png", picture[..., ::-1])[1]
    spec.assets = {**spec.assets, f"{name}.png": encoded.tobytes()}
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, emission=0.25)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    _add_mesh(spec, name, margin, np.asarray(plate.size) + margin)
    T_flange_board = T_flange_tcp @ plate.T_tcp_board
    flange = spec.body(f"{plate.side}_link_6")
    flange.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        pos=T_flange_board[:3, 3],
        quat=matrix_to_quaternion(T_flange_board[:3, :3]),
        material=name,
    )
    centre = T_flange_board @ [*(np.asarray(plate.size) / 2), _THICKNESS + 0.0015, 1.0]
    flange.add_geom(
        name=f"{name}_back",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[*((np.asarray(plate.size) + 2 * margin) / 2), 0.001],
        pos=centre[:3],
        quat=matrix_to_quaternion(T_flange_board[:3, :3]),
        rgba=[0.55, 0.56, 0.58, 1.0],
    )


def _add_mesh(spec: mujoco.MjSpec, name: str, margin: Array, far: Array) -> None:
    """A flat box whose front, at z = 0 from ``-margin`` to ``far``, shows the whole texture."""
    (x0, y0), (x1, y1) = -margin, far
    flat = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    vertices = np.array([(x, y, z) for z in (0.0, _THICKNESS) for x, y in flat])
    sides = [(i, (i + 1) % 4) for i in range(4)]
    faces = [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)]
    faces += [f for i, j in sides for f in ((i, j, j + 4), (i, j + 4, i + 4))]
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] * 2)
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel(),
        userface=np.array(faces, dtype=np.int32).ravel(),
        usertexcoord=corners.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
