"""What the grippers impose on the rod's ends."""

from dataclasses import dataclass
from functools import cached_property
from math import dist

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array, check_single_pose, log_so3
from dlo_gym.rod._kernels_clamps import displace_along, displace_clamp, displace_clamps


@dataclass(frozen=True, eq=False)
class BoundaryPoses:
    """World poses of the material frames at the rod's ends.

    Each is (4, 4): columns d1 d2 d3, with d3 the tangent towards increasing arc length at BOTH
    ends; the origin is the end node [m]. The left clamp holds node 0. ``right=None`` leaves the
    last node free.

    Raises:
        ValueError: if a pose is not (4, 4) or not rigid.
    """

    left: Array
    right: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "left", check_single_pose(self.left, "clamp left"))
        if self.right is not None:
            object.__setattr__(self, "right", check_single_pose(self.right, "clamp right"))

    @cached_property
    def clamps(self) -> Array:
        """(2, 4, 4) left then right, or (1, 4, 4) if the right end is free; not to be written."""
        clamps = np.array([self.left] if self.right is None else [self.left, self.right])
        clamps.flags.writeable = False
        return clamps

    @property
    def distance(self) -> float:
        """Between the two clamps' origins [m]; 0 if one end is free."""
        if self.right is None:
            return 0.0
        return dist(self.left[:3, 3], self.right[:3, 3])

    def displaced(self, displacement: "BoundaryDisplacement") -> "BoundaryPoses":
        """The poses after ``displacement``."""
        if (self.right is None) != (displacement.right is None):
            raise ValueError(
                "displacement: must move the right clamp exactly if it exists, got "
                f"right={displacement.right} for right clamp {self.right}"
            )
        left = _displaced(self.left, displacement.left)
        right = None if self.right is None else _displaced(self.right, displacement.right)
        return BoundaryPoses.of_rigid(left, right)

    @classmethod
    def of_rigid(cls, left: Array, right: Array | None = None) -> "BoundaryPoses":
        """From float64 poses that are rigid already; not checked again."""
        poses = object.__new__(cls)
        object.__setattr__(poses, "left", left)
        object.__setattr__(poses, "right", right)
        return poses

    def displacement_to(self, target: "BoundaryPoses") -> "BoundaryDisplacement":
        """The displacement that takes these poses to ``target``."""
        right = None
        if self.right is not None and target.right is not None:
            right = _difference(self.right, target.right)
        return BoundaryDisplacement(_difference(self.left, target.left), right)


@dataclass(frozen=True, eq=False)
class BoundaryDisplacement:
    """A motion of the clamps: per end a translation [m] and a rotation vector [rad].

    Each is (6,) in world axes: dx dy dz rx ry rz; the rotation is about the clamp's own origin.
    ``right=None`` where the right end is free.

    Raises:
        ValueError: on a wrong shape or a value that is not finite.
    """

    left: Array
    right: Array | None = None

    def __post_init__(self) -> None:
        for side in ("left", "right"):
            value = getattr(self, side)
            if value is None and side == "right":
                continue
            value = np.ascontiguousarray(value, dtype=np.float64)
            if value.shape != (6,) or not np.isfinite(value).all():
                raise ValueError(
                    f"displacement {side}: expected 6 finite numbers"
                    f" (translation [m], rotation vector [rad]), got {value}"
                )
            object.__setattr__(self, side, value)

    @classmethod
    def zero(cls, n_clamps: int = 2) -> "BoundaryDisplacement":
        return cls(*np.zeros((n_clamps, 6)))

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> "BoundaryDisplacement":
        """From (12,) left then right, or (6,) for a rod held by the left clamp only."""
        vector = np.asarray(vector, dtype=np.float64)
        if vector.shape not in ((6,), (12,)):
            raise ValueError(f"displacement: expected 6 or 12 numbers, got shape {vector.shape}")
        return cls(vector[:6], vector[6:] if vector.size == 12 else None)

    @property
    def vector(self) -> Array:
        """(12,) left then right, or (6,) if the right end is free."""
        return self.left.copy() if self.right is None else np.concatenate([self.left, self.right])

    def scaled(self, factor: float) -> "BoundaryDisplacement":
        return BoundaryDisplacement.from_vector(factor * self.vector)


def displace(clamps: Array, twists: Array) -> Array:
    """Clamp poses (..., 4, 4) moved by twists (..., 6) [m], [rad], each as a
    ``BoundaryDisplacement`` has it."""
    moved = np.empty(clamps.shape)
    displace_clamps(
        np.ascontiguousarray(clamps).reshape(-1, 4, 4),
        np.ascontiguousarray(twists).reshape(-1, 6),
        moved.reshape(-1, 4, 4),
    )
    return moved


def way(clamps: Array, twists: Array, n_steps: int) -> Array:
    """Clamp poses (n_steps, k, 4, 4) on the way of ``clamps`` (k, 4, 4) that move by the same
    ``twists`` (k, 6) [m], [rad] in every step."""
    poses = np.empty((n_steps, *clamps.shape))
    displace_along(np.ascontiguousarray(clamps), np.ascontiguousarray(twists), poses)
    return poses


def _displaced(clamp: Array, twist: Array | None) -> Array:
    assert twist is not None
    moved = np.empty((4, 4))
    displace_clamp(clamp, twist, moved)
    return moved


def _difference(start: Array, end: Array) -> Array:
    return np.concatenate([end[:3, 3] - start[:3, 3], log_so3(end[:3, :3] @ start[:3, :3].T)])
