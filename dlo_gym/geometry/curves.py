"""Curves given as points: arc length, resampling, parallel transport."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from dlo_gym.geometry import _kernels_rotations as kernels
from dlo_gym.geometry.se3 import Array


def arc_length(points: ArrayLike) -> Array:
    """Arc length (n,) [m] from the first of points (n, 3) to each, along the polyline."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=np.float64), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: ArrayLike, n_points: int) -> Array:
    """``n_points`` points (n_points, 3) equally spaced by arc length on a cubic spline.

    Repeated points are dropped first, so a noisy or doubled input gives no NaN.

    Raises:
        ValueError: if fewer than two distinct points are given.
    """
    points = np.asarray(points, dtype=np.float64)
    distinct = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9])
    points = points[distinct]
    if len(points) < 2:
        raise ValueError("points: expected at least two distinct points to resample a curve")
    spline = CubicSpline(arc_length(points), points)
    fine = spline(np.linspace(0.0, spline.x[-1], 20 * max(n_points, len(points))))
    s = arc_length(fine)
    targets = np.linspace(0.0, s[-1], n_points)
    return np.column_stack([np.interp(targets, s, fine[:, axis]) for axis in range(3)])


def parallel_transport(tangents: ArrayLike, first_frame: ArrayLike) -> Array:
    """Twist-free frames (n, 3, 3) along unit tangents (n, 3), starting at ``first_frame``.

    Each frame is the previous one turned by the smallest rotation that takes tangent to tangent;
    d3 of frame i is tangent i.
    """
    tangents = np.array(tangents, dtype=np.float64)
    frames = np.empty((len(tangents), 3, 3))
    kernels.parallel_transport(tangents, np.array(first_frame, dtype=np.float64), frames)
    return frames


def swept_angle(points: ArrayLike, origin: ArrayLike, axis: ArrayLike) -> float:
    """Angle [rad] that points (n, 3) sweep about the line through ``origin`` along ``axis``, right-
    handed; more than a turn where they wind round it. No step may sweep half a turn or more."""
    along = np.asarray(axis, dtype=np.float64)
    along = along / np.linalg.norm(along)
    away = np.asarray(points, dtype=np.float64) - np.asarray(origin, dtype=np.float64)
    away = away - np.outer(away @ along, along)
    before, after = away[:-1], away[1:]
    sines = np.cross(before, after) @ along
    return float(np.arctan2(sines, (before * after).sum(axis=1)).sum())
