"""What was seen of a cable that clamps held and moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from dlo_gym.geometry.curves import resample
from dlo_gym.geometry.se3 import Array
from dlo_gym.recording import Recording
from dlo_gym.rod.boundary import BoundaryPoses

PARABOLA = 0.12  # [s]


@dataclass(frozen=True, eq=False)
class CableMotion:
    """Points seen on a cable between clamps, over T samples.

    Attributes:
        stamps: (T,) [s], increasing.
        left: (T, 4, 4) clamp poses at the cable's first end.
        right: (T, 4, 4) at its last end; None where that end is free.
        points: (T, n_points, 3) seen on the cable [m]; NaN where one was not seen.
        places: (n_points,) of the points along the cable, from 0 at its first end to 1.
        length: of the cable [m], as far as it is known.
        radius: [m].
        mass_per_length: [kg/m]; shapes and motion only tell ratios to it.
        n_elements: of the rod that is to move like it.
        clamp: "element" or "node", as ``CosseratRod`` has it.
        across: whether points tell where the cable runs but not how far along it they are, as
            those of a tracker: only their distance across the cable counts.
        grip_known: whether the clamp poses are the cable's own; if not, each holds it turned by a
            rotation that stays the same.

    Raises:
        ValueError: if shapes do not fit each other.
    """

    stamps: Array
    left: Array
    right: Array | None
    points: Array
    places: Array
    length: float
    radius: float
    mass_per_length: float
    n_elements: int = 50
    clamp: Literal["element", "node"] = "element"
    across: bool = False
    grip_known: bool = True

    def __post_init__(self) -> None:
        n = len(self.stamps)
        for name in ("left", "right"):
            poses = getattr(self, name)
            if poses is not None and poses.shape != (n, 4, 4):
                raise ValueError(f"{name}: expected {n} poses, one per stamp, got {poses.shape}")
        if self.points.shape != (n, len(self.places), 3):
            raise ValueError(
                f"points: expected shape ({n}, {len(self.places)}, 3), a row per stamp and a point"
                f" per place, got {self.points.shape}"
            )
        if n < 2 or not (np.diff(self.stamps) > 0.0).all():
            raise ValueError("stamps: expected two increasing times or more [s]")
        if np.count_nonzero(self.seen[0]) < 2:
            raise ValueError("points: expected two points or more in the first sample")

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    def of_recording(
        cls, recording: Recording, centerline: Array, *, across: bool = False
    ) -> "CableMotion":
        """A recording's clamps with a ``centerline`` (T, n_nodes, 3): its truth or an estimate."""
        n_nodes = centerline.shape[1]
        density = recording.density or 1e3
        return cls(
            recording.stamps,
            recording.clamp_left,
            recording.clamp_right,
            centerline,
            np.linspace(0.0, 1.0, n_nodes),
            recording.rod_length,
            recording.rod_radius,
            density * np.pi * recording.rod_radius**2,
            n_nodes - 1,
            across=across,
        )

    def boundary(self, sample: int) -> BoundaryPoses:
        return BoundaryPoses(self.left[sample], None if self.right is None else self.right[sample])

    def held(self, rotations: Sequence[Array]) -> "CableMotion":
        """With clamps that hold the cable turned by rotations (3, 3) R_clamp_held, left and
        right."""
        turned = {}
        for side, rotation in zip(("left", "right"), rotations, strict=False):
            poses = getattr(self, side).copy()
            poses[:, :3, :3] = poses[:, :3, :3] @ rotation
            turned[side] = poses
        return replace(self, **turned) if turned else self

    def windows(self, seconds: float) -> list["CableMotion"]:
        """Its parts of about ``seconds`` [s] one after the other, as motions of their own; each
        begins with a ``clear`` sample."""
        duration = self.stamps[-1] - self.stamps[0]
        n_parts = max(1, min(round(duration / seconds), len(self) // 2))
        edges = [0]
        for cut in np.round(np.linspace(0, len(self), n_parts + 1)[1:-1]):
            edge = next((sample for sample in self.clear if sample >= cut), len(self))
            if edges[-1] + 2 <= edge <= len(self) - 2:
                edges.append(edge)
        return [
            replace(
                self, stamps=self.stamps[a:b], left=self.left[a:b],
                right=None if self.right is None else self.right[a:b], points=self.points[a:b],
            )
            for a, b in pairwise([*edges, len(self)])
        ]  # fmt: skip

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(T, n_points)."""
        return ~np.isnan(self.points[..., 0])

    @cached_property
    def clear(self) -> list[int]:
        """Samples of which two points or more were seen."""
        return np.flatnonzero(np.count_nonzero(self.seen, axis=1) > 1).tolist()

    @cached_property
    def _inner(self) -> NDArray[np.bool_]:
        """(n_points,) whether a point is in no clamp."""
        return (self.places > 0.0) & ((self.places < 1.0) | (self.right is None))

    @cached_property
    def weights(self) -> Array:
        """(n_points, n_nodes) that interpolate the rod's nodes at the places."""
        node = self.places * self.n_elements
        below = np.minimum(node.astype(int), self.n_elements - 1)
        rows = np.arange(len(node))
        weights = np.zeros((len(node), self.n_elements + 1))
        weights[rows, below] = 1.0 - (node - below)
        weights[rows, below + 1] = node - below
        return weights

    @cached_property
    def projectors(self) -> Array:
        """(T, n_points, 3, 3) that take a distance to what counts of it; zero where not seen."""
        projectors = np.zeros((*self.points.shape, 3))
        for sample, seen in enumerate(self.seen):
            projectors[sample, seen] = np.eye(3)
            if self.across and seen.sum() > 1:
                along = np.gradient(self.points[sample, seen], self.places[seen], axis=0)
                along /= np.linalg.norm(along, axis=1, keepdims=True)
                projectors[sample, seen] -= along[:, :, None] * along[:, None, :]
        return projectors

    @cached_property
    def accelerations(self) -> Array:
        """(T, n_nodes, 3) of the rod's nodes [m/s^2], from parabolas over ``PARABOLA`` of time."""
        inner = self._inner
        tracks = [self.left[:, None, :3, 3], _filled(self.points[:, inner], self.seen[:, inner])]
        places = [[0.0], self.places[inner]]
        if self.right is not None:
            tracks.append(self.right[:, None, :3, 3])
            places.append([1.0])
        period = float(np.median(np.diff(self.stamps)))
        window = max(3, 2 * round(0.5 * PARABOLA / period) + 1)
        if window > len(self):
            return np.zeros((len(self), self.n_elements + 1, 3))
        seen = savgol_filter(
            np.concatenate(tracks, axis=1), window, 2, deriv=2, delta=period, axis=0
        )
        nodes = np.linspace(0.0, 1.0, self.n_elements + 1)
        return CubicSpline(np.concatenate(places), seen, axis=1)(nodes)

    def curve(self, sample: int) -> Array:
        """(n_nodes, 3) of a smooth curve through both clamps and a sample's points [m]."""
        ends = [self.left[sample, :3, 3]], [] if self.right is None else [self.right[sample, :3, 3]]
        inner = self.points[sample, self.seen[sample] & self._inner]
        through = np.concatenate([part for part in (ends[0], inner, ends[1]) if len(part)])
        return resample(through, self.n_elements + 1)

    def difference(self, predicted: Array) -> Array:
        """What counts of the distance of ``predicted`` points (T, n_points, 3) [m] from those
        seen; zero where one was not seen."""
        offset = np.where(self.seen[..., None], predicted - self.points, 0.0)
        return np.einsum("tnij,tnj->tni", self.projectors, offset)

    def mean_distance(self, predicted: Array) -> float:
        """Over the points seen [m]; NaN where one of them was not predicted."""
        return float(np.linalg.norm(self.difference(predicted), axis=2).sum() / self.seen.sum())


def _filled(points: Array, seen: NDArray[np.bool_]) -> Array:
    """Points (T, n, 3), those not seen from the same one before and after; zero if it never was."""
    filled, samples = points.copy(), np.arange(len(points))
    for point in range(points.shape[1]):
        there = np.flatnonzero(seen[:, point])
        for axis in range(3):
            filled[:, point, axis] = (
                np.interp(samples, there, points[there, point, axis]) if len(there) else 0.0
            )
    return filled
