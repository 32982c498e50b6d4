"""Obstacles as numbers, for observations."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_gym.rod.obstacles import Box, Capsule, Obstacle, Plane, Sphere

ROW = 15


def obstacle_rows(
    obstacles: Sequence[Obstacle], touch: Sequence[str], n_rows: int
) -> NDArray[np.float32]:
    """(15 n_rows,) a row per obstacle, zeros where there are fewer.

    A row: 1; whether the cable may touch it; position [m], d1 and d3 of its pose; half edges of a
    box [m], and by how much the box is rounded [m]: a capsule is a rounded line, a sphere a rounded
    point.
    """
    rows = np.zeros((n_rows, ROW), dtype=np.float32)
    for row, obstacle, how in zip(rows, obstacles, touch, strict=False):
        row[:2] = 1.0, how == "allowed"
        row[2:11] = obstacle.pose[:3, [3, 0, 2]].T.ravel()
        match obstacle:
            case Box():
                row[11:14] = obstacle.half_size
            case Capsule():
                row[13], row[14] = obstacle.half_length, obstacle.radius
            case Sphere():
                row[14] = obstacle.radius
            case Plane():
                raise ValueError(f"obstacles: a Plane has no row, got {obstacle!r}")
    return rows.ravel()
