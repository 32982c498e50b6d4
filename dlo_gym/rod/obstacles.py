"""Rigid bodies that a rod can touch: half-spaces, boxes, spheres and capsules."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import (
    Array,
    check_single_pose,
    exp_so3,
    frame_along,
    inverse,
    log_so3,
    pose,
    transform_points,
)
from dlo_gym.rod._kernels_distance import BOX, CAPSULE, PLANE, SPHERE, ObstacleArrays


@dataclass(frozen=True, eq=False)
class Plane:
    """The half-space below the xy plane of ``pose``: a table top, a wall.

    Attributes:
        pose: (4, 4) T_world_plane; z points out of the material.
    """

    pose: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", check_single_pose(self.pose, "plane pose"))

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> "Plane":
        """The half-space behind ``point`` (3,) [m], whose outward ``normal`` (3,) need not be unit.

        Raises:
            ValueError: if the normal is zero or a value is not finite.
        """
        return cls(pose(_upright(normal, "normal"), point))

    def signed_distance(self, points: ArrayLike) -> Array:
        """(...,) distance [m] of world points (..., 3) from the surface, negative inside."""
        return _local(self, points)[..., 2]


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box, centred at the origin of its pose.

    Attributes:
        pose: (4, 4) T_world_box.
        half_size: (3,) half the edge lengths along the pose's axes [m].
    """

    pose: Array
    half_size: Array | tuple[float, float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", check_single_pose(self.pose, "box pose"))
        half_size = np.ascontiguousarray(self.half_size, dtype=np.float64)
        if half_size.shape != (3,) or not (np.isfinite(half_size) & (half_size > 0)).all():
            raise ValueError(f"box half_size: expected three positive lengths [m], got {half_size}")
        object.__setattr__(self, "half_size", half_size)

    def signed_distance(self, points: ArrayLike) -> Array:
        """(...,) distance [m] of world points (..., 3) from the surface, negative inside."""
        beyond = np.abs(_local(self, points)) - self.half_size
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return outside + np.minimum(beyond.max(axis=-1), 0.0)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A solid sphere around the origin of its pose.

    Attributes:
        pose: (4, 4) T_world_sphere.
        radius: [m].
    """

    pose: Array
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", check_single_pose(self.pose, "sphere pose"))
        _check_length(self.radius, "sphere radius")

    @classmethod
    def at(cls, center: ArrayLike, radius: float) -> "Sphere":
        """The sphere around ``center`` (3,) [m]."""
        return cls(pose(np.eye(3), center), radius)

    def signed_distance(self, points: ArrayLike) -> Array:
        """(...,) distance [m] of world points (..., 3) from the surface, negative inside."""
        return np.linalg.norm(_local(self, points), axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class Capsule:
    """A cylinder with round caps along the z axis of its pose: a bar, a robot's link.

    Attributes:
        pose: (4, 4) T_world_capsule, at the middle of the axis.
        half_length: half the distance between the centres of the caps [m].
        radius: [m].
    """

    pose: Array
    half_length: float
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", check_single_pose(self.pose, "capsule pose"))
        _check_length(self.half_length, "capsule half_length")
        _check_length(self.radius, "capsule radius")

    @classmethod
    def between(cls, start: ArrayLike, end: ArrayLike, radius: float) -> "Capsule":
        """The capsule whose caps are centred at ``start`` and ``end`` (3,) [m].

        Raises:
            ValueError: if the two coincide.
        """
        start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        axis = end - start
        rotation = _upright(axis, "end - start")
        return cls(pose(rotation, 0.5 * (start + end)), 0.5 * float(np.linalg.norm(axis)), radius)

    def signed_distance(self, points: ArrayLike) -> Array:
        """(...,) distance [m] of world points (..., 3) from the surface, negative inside."""
        local = _local(self, points)
        local[..., 2] -= np.clip(local[..., 2], -self.half_length, self.half_length)
        return np.linalg.norm(local, axis=-1) - self.radius


Obstacle = Plane | Box | Sphere | Capsule
_KINDS = {Plane: PLANE, Box: BOX, Sphere: SPHERE, Capsule: CAPSULE}
AnyObstacle = TypeVar("AnyObstacle", bound=Obstacle)


def placed(obstacle: AnyObstacle, T_world_obstacle: ArrayLike) -> AnyObstacle:
    """The same body at another pose (4, 4)."""
    return replace(obstacle, pose=np.asarray(T_world_obstacle, dtype=np.float64))


def between(start: AnyObstacle, end: Obstacle, fraction: float) -> AnyObstacle:
    """``start`` on its way to the pose of ``end``: 0 at the start, 1 at the end."""
    turn = exp_so3(fraction * log_so3(end.pose[:3, :3] @ start.pose[:3, :3].T))
    origin = (1.0 - fraction) * start.pose[:3, 3] + fraction * end.pose[:3, 3]
    return placed(start, pose(turn @ start.pose[:3, :3], origin))


def on_the_way(
    start: Sequence[Obstacle], end: Sequence[Obstacle], fraction: float
) -> tuple[Obstacle, ...]:
    """Bodies at a ``fraction`` of their way from ``start`` to ``end``."""
    if fraction == 1.0:
        return tuple(end)
    return tuple(between(a, b, fraction) for a, b in zip(start, end, strict=True))


def check_obstacles(obstacles: Sequence[Obstacle]) -> tuple[Obstacle, ...]:
    """``obstacles`` as a tuple.

    Raises:
        ValueError: naming the first entry that is none of the four kinds.
    """
    for index, obstacle in enumerate(obstacles):
        if not isinstance(obstacle, Plane | Box | Sphere | Capsule):
            raise ValueError(
                f"obstacles[{index}]: expected a Plane, Box, Sphere or Capsule, got {obstacle!r}"
            )
    return tuple(obstacles)


def same_bodies(some: Sequence[Obstacle], others: Sequence[Obstacle]) -> bool:
    """Whether both are the same bodies in the same order, at whatever poses."""
    return len(some) == len(others) and all(
        type(a) is type(b) and np.array_equal(_shape(a), _shape(b))
        for a, b in zip(some, others, strict=True)
    )


def pack(obstacles: Sequence[Obstacle]) -> ObstacleArrays:
    """The obstacles as the kernels take them."""
    m = len(obstacles)
    poses = np.array([obstacle.pose for obstacle in obstacles]).reshape(m, 4, 4)
    return ObstacleArrays(
        np.array([_KINDS[type(obstacle)] for obstacle in obstacles], dtype=np.int64),
        np.array([_shape(obstacle) for obstacle in obstacles]).reshape(m, 3),
        np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]),
    )


def _shape(obstacle: Obstacle) -> Array:
    """(3,) lengths that make the body, as the kernels take them [m]."""
    match obstacle:
        case Plane():
            return np.zeros(3)
        case Box():
            return np.asarray(obstacle.half_size)
        case Sphere():
            return np.array([obstacle.radius, 0.0, 0.0])
        case Capsule():
            return np.array([obstacle.radius, obstacle.half_length, 0.0])


def _local(obstacle: Obstacle, points: ArrayLike) -> Array:
    return transform_points(inverse(obstacle.pose), points)


def _upright(axis: ArrayLike, name: str) -> Array:
    """A rotation whose z is along ``axis``."""
    axis = np.asarray(axis, dtype=np.float64)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not np.linalg.norm(axis) > 1e-12:
        raise ValueError(f"{name}: expected a finite vector of three that is not zero, got {axis}")
    return frame_along(axis, np.eye(3)[np.argmin(np.abs(axis))])


def _check_length(value: float, name: str) -> None:
    if not (isfinite(value) and value > 0):
        raise ValueError(f"{name}: expected a positive length [m], got {value}")
