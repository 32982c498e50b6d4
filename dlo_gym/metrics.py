"""The measures of a tracked shape (Caporali et al. 2025, Section VI)."""

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array


def ptp_3d(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Point-to-point error PTP3D (..., n) [m] of centerlines (..., n, 3) [m], node by node.

    Raises:
        ValueError: if the two differ in shape or are not points of three coordinates.
    """
    estimate, truth = _same_points(estimate, truth, 3)
    return np.linalg.norm(estimate - truth, axis=-1)


def ptp_2d(estimate: ArrayLike, truth: ArrayLike, image_width: float) -> Array:
    """Point-to-point error PTP2D (..., n) of pixels (..., n, 2) [percent of the image width]."""
    _check_width(image_width)
    estimate, truth = _same_points(estimate, truth, 2)
    return 100.0 * np.linalg.norm(estimate - truth, axis=-1) / image_width


def distance_to_centerline(points: ArrayLike, centerline: ArrayLike, image_width: float) -> Array:
    """Distance DTC (n,) of pixels (n, 2) to the polyline (m, 2) [percent of the image width].

    Unlike PTP2D it does not see an error along the rod.
    """
    _check_width(image_width)
    points = np.asarray(points, dtype=np.float64)
    centerline = np.asarray(centerline, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points: expected shape (n, 2), got {points.shape}")
    if centerline.ndim != 2 or centerline.shape[1] != 2 or len(centerline) < 2:
        raise ValueError(f"centerline: expected shape (m, 2) with m >= 2, got {centerline.shape}")
    start, step = centerline[:-1], np.diff(centerline, axis=0)
    offset = points[:, None, :] - start
    squared_length = np.maximum((step**2).sum(axis=-1), 1e-300)
    fraction = np.clip((offset * step).sum(axis=-1) / squared_length, 0.0, 1.0)
    distance = np.linalg.norm(offset - fraction[..., None] * step, axis=-1)
    return 100.0 * distance.min(axis=1) / image_width


def occlusion_ratio(visible: ArrayLike) -> float:
    """Share of nodes, 0 to 1, that are not visible; ``visible`` is boolean of any shape.

    NaN for an empty array, because nothing was looked at.
    """
    visible = np.asarray(visible, dtype=bool)
    return float(1.0 - visible.mean()) if visible.size else float("nan")


def _same_points(estimate: ArrayLike, truth: ArrayLike, dimension: int) -> tuple[Array, Array]:
    estimate = np.asarray(estimate, dtype=np.float64)
    truth = np.asarray(truth, dtype=np.float64)
    if estimate.shape != truth.shape or estimate.shape[-1:] != (dimension,):
        raise ValueError(
            f"estimate and truth: expected one shape (..., n, {dimension}),"
            f" got {estimate.shape} and {truth.shape}"
        )
    return estimate, truth


def _check_width(image_width: float) -> None:
    if not image_width > 0:
        raise ValueError(f"image_width: expected a positive number of pixels, got {image_width}")
