"""Normal equations of reprojection errors, with each sample's corrections kept apart.

The corrections of one sample meet no other sample's, so they are eliminated block by block (the
Schur complement) and the system to solve stays as small as the number of cameras and arms.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array
from sim2real.calibration.board import Detection

INTRINSICS = 9  # fx fy cx cy k1 k2 p1 p2 k3
HUBER = 2.5  # standard deviations, beyond which a corner counts linearly


class Noise(NamedTuple):
    """Standard deviations per axis: of a corner [pixels], of a tool pose [m], [rad]."""

    corner_px: float = 0.3
    position_m: float = 1e-4
    rotation_rad: float = 3e-4


@dataclass(eq=False)
class NormalEquations:
    """Of a least squares with global unknowns g and, for every sample, six corrections c."""

    H: Array  # (g, g)
    b: Array  # (g,)
    H_c: Array  # (k, 6, 6)
    H_gc: Array  # (k, g, 6)
    b_c: Array  # (k, 6)
    cost: float = 0.0
    squares: float = 0.0  # of the corners' weighted residuals
    n_rows: int = 0

    def add(self, index: int, J: Array, J_c: Array, seen: "Projection", noise: Noise) -> None:
        """Adds a view's corners: Jacobians (n, 2, g) and (n, 2, 6) in pixels."""
        size = np.linalg.norm(seen.error, axis=1)
        weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
        root = np.sqrt(weight)[:, None, None]
        J = (root / noise.corner_px * J).reshape(-1, J.shape[-1])
        J_c = (root / noise.corner_px * J_c).reshape(-1, 6)
        r = (root[..., 0] * seen.error).ravel()
        self.H += J.T @ J
        self.b += J.T @ r
        self.H_c[index] += J_c.T @ J_c
        self.H_gc[index] += J.T @ J_c
        self.b_c[index] += J_c.T @ r
        self.cost += float(np.where(size <= HUBER, size**2, 2 * HUBER * size - HUBER**2).sum())
        self.squares += float(r @ r)
        self.n_rows += r.size

    @property
    def gain(self) -> Array:
        """(k, 6, g): what a step of the global unknowns does to the corrections, negated."""
        return np.asarray(np.linalg.solve(self.H_c, np.swapaxes(self.H_gc, 1, 2)), dtype=np.float64)

    @property
    def schur(self) -> Array:
        return self.H - np.einsum("kgc,kch->gh", self.H_gc, self.gain)


class Projection(NamedTuple):
    """Corners of a view: (n, 2) error in standard deviations, derivatives [pixels] by the point in
    the camera (n, 2, 3) and by the lens (n, 2, 9)."""

    error: Array
    by_point: Array
    by_lens: Array


def project(
    camera: CameraModel, in_camera: Array, detection: Detection, noise: Noise
) -> Projection | None:
    """None if a corner is behind the camera."""
    if in_camera[:, 2].min() < 1e-3:
        return None
    projected, derivatives = cv2.projectPoints(
        in_camera, np.zeros(3), np.zeros(3), camera.K, camera.distortion
    )[:2]
    error = (projected.reshape(-1, 2) - detection.corners) / noise.corner_px
    # By turn, shift, fx fy, cx cy, distortion; a shift moves the point itself.
    derivatives = np.asarray(derivatives, dtype=np.float64)
    by_shift, by_lens = derivatives[:, 3:6], derivatives[:, 6:15]
    return Projection(error, by_shift.reshape(-1, 2, 3), by_lens.reshape(-1, 2, INTRINSICS))


def transformed(T: Array, points: Array) -> Array:
    return points @ T[:3, :3].T + T[:3, 3]


def by_frame(by_point: Array, R_camera_frame: Array, points: Array) -> Array:
    """d(pixel) / d(turn, shift of the frame that points (n, 3) are given in): (n, 2, 6)."""
    by_shift = by_point @ R_camera_frame
    # A turn w moves p by w x p; row . (w x p) = (p x row) . w
    x, y, z = points.T[:, :, None]
    a, b, c = np.moveaxis(by_shift, -1, 0)
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=-1)


def covariance_of(matrix: Array) -> Array:
    """The covariance of whitened normal equations.

    Raises:
        ValueError: if an unknown is not determined.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    if values[0] < 1e-11:
        raise ValueError(
            "samples: they leave the cameras' poses undetermined; add poses turned about other axes"
        )
    return scale[:, None] * (vectors / values @ vectors.T) * scale
