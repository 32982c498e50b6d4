"""What an action means: numbers in [-1, 1] against motions of the clamps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses


@dataclass(frozen=True)
class ClampAction:
    """Per clamp, left then right: translation along world x y z, rotation about its own d1 and d2,
    and about d3 if ``axial_rotation``, each in fractions of the step limit.

    Attributes:
        max_translation_step: [m].
        max_rotation_step: [rad].
        axial_rotation: whether the clamps also turn about the rod's own axis.
    """

    max_translation_step: float
    max_rotation_step: float
    axial_rotation: bool = False

    @property
    def n_rotations(self) -> int:
        return 3 if self.axial_rotation else 2

    @property
    def size(self) -> int:
        return 2 * (3 + self.n_rotations)

    @property
    def scale(self) -> Array:
        """(size,) what 1 stands for in each component [m], [rad]."""
        one = [self.max_translation_step] * 3 + [self.max_rotation_step] * self.n_rotations
        return np.array(one + one)

    def to_displacement(self, action: ArrayLike, boundary: BoundaryPoses) -> BoundaryDisplacement:
        """The motion from ``boundary`` that ``action`` (size,) stands for; clipped to [-1, 1].

        Raises:
            ValueError: on a wrong shape or NaN.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.size,) or np.isnan(action).any():
            raise ValueError(
                f"action: expected {self.size} numbers in [-1, 1] without NaN, got {action}"
            )
        twists = self.to_twists(action, np.stack(_clamps(boundary)))
        return BoundaryDisplacement(*twists)

    def to_twists(self, actions: Array, clamps: Array) -> Array:
        """Twists (..., 2, 6) [m], [rad], world axes, that ``actions`` (..., size) stand for at
        clamp poses (..., 2, 4, 4); unchecked, clipped to [-1, 1]."""
        parts = np.clip(actions, -1.0, 1.0) * self.scale
        parts = parts.reshape(*actions.shape[:-1], 2, -1)
        axes = clamps[..., :3, : self.n_rotations]
        turns = (axes @ parts[..., 3:, None])[..., 0]
        return np.concatenate([parts[..., :3], turns], axis=-1)

    def to_action(self, displacement: BoundaryDisplacement, boundary: BoundaryPoses) -> Array:
        """The action (size,) closest to ``displacement``: cut to the limits component by component,
        without what the action does not move."""
        parts = [
            np.concatenate([twist[:3], clamp[:3, : self.n_rotations].T @ twist[3:]])
            for twist, clamp in zip(
                displacement.vector.reshape(2, 6), _clamps(boundary), strict=True
            )
        ]
        return np.clip(np.concatenate(parts) / self.scale, -1.0, 1.0)


def clamp_numbers(clamp: Array | None) -> Array:
    """(9,) position [m], d1 and d3 of a clamp pose, as observations carry it."""
    assert clamp is not None
    return np.concatenate([clamp[:3, 3], clamp[:3, 0], clamp[:3, 2]])


def _clamps(boundary: BoundaryPoses) -> tuple[Array, Array]:
    if boundary.right is None:
        raise ValueError("boundary: expected two clamps, got a free right end")
    return boundary.left, boundary.right
