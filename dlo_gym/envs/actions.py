"""What an action means: numbers in [-1, 1] against motions of the clamps."""

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses


@dataclass(frozen=True)
class ClampAction:
    """Per clamp, left then right: translation along world x y z, rotation about its own d1 and d2,
    and about d3 if ``axial_rotation``, each in fractions of the step limit. In the vertical plane
    (``planar``): translation along x z, rotation about d1.

    Attributes:
        max_translation_step: [m].
        max_rotation_step: [rad].
        axial_rotation: whether the clamps also turn about the rod's own axis.
        planar: whether the clamps stay in the plane of world x and z.
        n_clamps: 2, or 1 where the right end is free.

    Raises:
        ValueError: naming the field.
    """

    max_translation_step: float
    max_rotation_step: float
    axial_rotation: bool = False
    planar: bool = False
    n_clamps: int = 2

    def __post_init__(self) -> None:
        for name in ("max_translation_step", "max_rotation_step"):
            if not 0.0 < getattr(self, name) < inf:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if self.n_clamps not in (1, 2):
            raise ValueError(f"n_clamps: expected 1 or 2, got {self.n_clamps}")
        if self.planar and self.axial_rotation:
            raise ValueError("axial_rotation: expected False with planar, got True")

    @property
    def translation_axes(self) -> list[int]:
        return [0, 2] if self.planar else [0, 1, 2]

    @property
    def n_rotations(self) -> int:
        return 1 if self.planar else (3 if self.axial_rotation else 2)

    @property
    def size(self) -> int:
        return self.n_clamps * (len(self.translation_axes) + self.n_rotations)

    @property
    def scale(self) -> Array:
        """(size,) what 1 stands for in each component [m], [rad]."""
        one = [self.max_translation_step] * len(self.translation_axes)
        one += [self.max_rotation_step] * self.n_rotations
        return np.array(one * self.n_clamps)

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
        return BoundaryDisplacement(*self.to_twists(action, self._clamps(boundary)))

    def to_twists(self, actions: Array, clamps: Array) -> Array:
        """Twists (..., k, 6) [m], [rad], world axes, that ``actions`` (..., size) stand for at
        clamp poses (..., k, 4, 4); unchecked, clipped to [-1, 1]."""
        axes = self.translation_axes
        parts = np.clip(actions, -1.0, 1.0) * self.scale
        parts = parts.reshape(*actions.shape[:-1], self.n_clamps, -1)
        twists = np.zeros((*parts.shape[:-1], 6))
        twists[..., axes] = parts[..., : len(axes)]
        turning = clamps[..., :3, : self.n_rotations]
        twists[..., 3:] = (turning @ parts[..., len(axes) :, None])[..., 0]
        return twists

    def to_action(self, displacement: BoundaryDisplacement, boundary: BoundaryPoses) -> Array:
        """The action (size,) closest to ``displacement``: cut to the limits component by component,
        without what the action does not move."""
        twists = displacement.vector.reshape(-1, 6)
        turning = self._clamps(boundary)[:, :3, : self.n_rotations].swapaxes(-1, -2)
        turns = (turning @ twists[:, 3:, None])[..., 0]
        parts = np.concatenate([twists[:, self.translation_axes], turns], axis=-1)
        return np.clip(parts.ravel() / self.scale, -1.0, 1.0)

    def _clamps(self, boundary: BoundaryPoses) -> Array:
        if len(boundary.clamps) != self.n_clamps:
            held = "two clamps" if self.n_clamps == 2 else "one clamp"
            raise ValueError(f"boundary: expected {held}, got {len(boundary.clamps)}")
        return boundary.clamps


def clamp_numbers(clamp: Array) -> Array:
    """(9,) position [m], d1 and d3 of a clamp pose, as observations carry it."""
    return np.concatenate([clamp[:3, 3], clamp[:3, 0], clamp[:3, 2]])
