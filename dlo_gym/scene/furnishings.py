"""What an episode puts into the cell: obstacles, and clutter on the table.

The model has a place for each from the start. A place that is filled is written into the model; an
empty one is transparent, which neither drawing nor rays see.
"""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array, exp_so3, frame_along, matrix_to_quaternion
from dlo_gym.rod.obstacles import Box, Capsule, Obstacle, Plane, Sphere
from dlo_gym.scene.cell_model import CABLE_COLORS, CABLE_POINTS, lying_cable

_UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that takes its material's
_X, _Y = (-0.55, 0.55), ((-0.42, -0.3), (0.3, 0.6))  # where blocks lie: out of the arms' way [m]
_BLOCK_SIZE = (0.01, 0.04)  # half edges [m]


class Clutter(NamedTuple):
    """Things that lie on the table, up to n cables and n blocks; NaN where there are fewer.

    Attributes:
        cables: (n, 41, 3) centerlines, world [m].
        cable_radii: (n,) [m].
        cable_colors: (n, 3) RGB in [0, 1].
        blocks: (n, 7) centre x y z and half edges x y z [m], angle about the vertical [rad].
        block_colors: (n, 3) RGB in [0, 1].
    """

    cables: Array
    cable_radii: Array
    cable_colors: Array
    blocks: Array
    block_colors: Array


def sample_clutter(rng: np.random.Generator, n_cables: int, n_blocks: int, n: int) -> Clutter:
    """Random cables and coloured blocks on the table, in places for ``n`` of each."""
    clutter = Clutter(
        np.full((n, CABLE_POINTS, 3), np.nan),
        np.full(n, np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 7), np.nan),
        np.full((n, 3), np.nan),
    )
    for i in range(n_cables):
        clutter.cables[i], clutter.cable_radii[i] = lying_cable(rng, i)
        clutter.cable_colors[i] = CABLE_COLORS[rng.integers(len(CABLE_COLORS))]
    for i in range(n_blocks):
        half_size = rng.uniform(*_BLOCK_SIZE, size=3)
        y = rng.uniform(*_Y[rng.integers(2)])
        clutter.blocks[i, :3] = rng.uniform(*_X), y, half_size[2]
        clutter.blocks[i, 3:6] = half_size
        clutter.blocks[i, 6] = rng.uniform(0.0, np.pi)
        clutter.block_colors[i] = rng.uniform(0.0, 1.0, 3)
    return clutter


def add_places(spec: mujoco.MjSpec, n_obstacles: int, n_clutter: int) -> None:
    """Empty places for obstacles, and for as many cables as blocks of clutter."""
    for name in _place_names(n_obstacles, n_clutter):
        spec.add_material(name=name, rgba=_UNPAINTED, specular=0.3, shininess=0.4)
    for name, n_geoms in _place_names(n_obstacles, n_clutter).items():
        for k in range(n_geoms):
            spec.worldbody.add_geom(
                name=f"{name}_{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[0.01, 0.01, 0.01],
                material=name,
                rgba=[0.5, 0.5, 0.5, 0.0],
            )


def _place_names(n_obstacles: int, n_clutter: int) -> dict[str, int]:
    """Of how many geoms each place consists."""
    names = {f"obstacle_{i}": 1 for i in range(n_obstacles)}
    names |= {f"clutter_cable_{i}": CABLE_POINTS - 1 for i in range(n_clutter)}
    return names | {f"clutter_block_{i}": 1 for i in range(n_clutter)}


class Furnishings:
    """Fills and empties the places of a compiled model.

    Args:
        model: of a spec that ``add_places`` has been at.
        n_obstacles, n_clutter: as given there.
    """

    def __init__(self, model: mujoco.MjModel, n_obstacles: int, n_clutter: int) -> None:
        self._model = model
        self.n_obstacles, self.n_clutter = n_obstacles, n_clutter
        self._geoms = {
            name: [model.geom(f"{name}_{k}").id for k in range(n_geoms)]
            for name, n_geoms in _place_names(n_obstacles, n_clutter).items()
        }
        for geoms in self._geoms.values():
            model.geom_sameframe[geoms] = 0  # else MuJoCo takes them to stay in the origin

    def place_obstacles(self, obstacles: Sequence[Obstacle], colors: ArrayLike) -> None:
        """Fill the first places with ``obstacles``, RGB ``colors`` (m, 3) in [0, 1].

        Raises:
            ValueError: on more obstacles than places, or a plane.
        """
        if len(obstacles) > self.n_obstacles:
            raise ValueError(
                f"obstacles: expected at most {self.n_obstacles}, got {len(obstacles)}"
            )
        self._empty("obstacle_")
        for i, (obstacle, color) in enumerate(zip(obstacles, np.asarray(colors), strict=False)):
            match obstacle:
                case Box():
                    kind, size = mujoco.mjtGeom.mjGEOM_BOX, obstacle.half_size
                case Capsule():
                    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
                    size = (obstacle.radius, obstacle.half_length, 0.0)
                case Sphere():
                    # The rasteriser and the rays know capsules.
                    kind, size = mujoco.mjtGeom.mjGEOM_CAPSULE, (obstacle.radius, 1e-9, 0.0)
                case Plane():
                    raise ValueError(f"obstacles[{i}]: a Plane cannot be drawn, got {obstacle!r}")
            self._put(f"obstacle_{i}", 0, kind, size, obstacle.pose, color)

    def strew(self, clutter: Clutter | None) -> None:
        """Put ``clutter`` on the table, or clear it."""
        self._empty("clutter_")
        if clutter is None:
            return
        for i in np.flatnonzero(np.isfinite(clutter.cable_radii)):
            points, radius = clutter.cables[i], clutter.cable_radii[i]
            axes = np.diff(points, axis=0)
            for k, axis in enumerate(axes):
                T_world_piece = np.eye(4)
                T_world_piece[:3, :3] = frame_along(axis, np.array([0.0, 0.0, 1.0]))
                T_world_piece[:3, 3] = 0.5 * (points[k] + points[k + 1])
                size = (radius, 0.5 * float(np.linalg.norm(axis)), 0.0)
                kind = mujoco.mjtGeom.mjGEOM_CAPSULE
                name = f"clutter_cable_{i}"
                self._put(name, k, kind, size, T_world_piece, clutter.cable_colors[i])
        for i in np.flatnonzero(np.isfinite(clutter.blocks[:, 6])):
            block = clutter.blocks[i]
            T_world_block = np.eye(4)
            T_world_block[:3, :3] = exp_so3(np.array([0.0, 0.0, block[6]]))
            T_world_block[:3, 3] = block[:3]
            kind, color = mujoco.mjtGeom.mjGEOM_BOX, clutter.block_colors[i]
            self._put(f"clutter_block_{i}", 0, kind, block[3:6], T_world_block, color)

    def _empty(self, prefix: str) -> None:
        for name, geoms in self._geoms.items():
            if name.startswith(prefix):
                self._model.geom_rgba[geoms, 3] = 0.0

    def _put(
        self, name: str, k: int, kind: int, size: ArrayLike, T_world_geom: Array, color: ArrayLike
    ) -> None:
        model, geom = self._model, self._geoms[name][k]
        model.geom_type[geom] = kind
        model.geom_size[geom] = size
        model.geom_pos[geom] = T_world_geom[:3, 3]
        model.geom_quat[geom] = matrix_to_quaternion(T_world_geom[:3, :3])
        model.geom_rbound[geom] = float(np.sum(size))
        model.geom_rgba[geom] = _UNPAINTED
        model.mat_rgba[model.material(name).id, :3] = color
