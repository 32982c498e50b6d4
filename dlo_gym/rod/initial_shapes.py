"""Shapes to start a rod from: straight, arc, catenary, hanging between clamps; random clamps."""

from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from dlo_gym.geometry import curves
from dlo_gym.geometry.se3 import Array, exp_so3, frame_along, log_so3, matrix_to_quaternion, pose
from dlo_gym.rod.boundary import BoundaryPoses


def straight(clamp: ArrayLike, length: float, n_nodes: int) -> Array:
    """Nodes (n_nodes, 3) [m] of a straight rod along d3 of the left ``clamp`` (4, 4).

    Raises:
        ValueError: naming a length that is not positive or fewer than two nodes.
    """
    _check_curve(length, n_nodes)
    clamp = np.asarray(clamp, dtype=np.float64)
    return clamp[:3, 3] + np.linspace(0.0, length, n_nodes)[:, None] * clamp[:3, 2]


def arc(clamp: ArrayLike, length: float, angle: float, n_nodes: int) -> Array:
    """Nodes (n_nodes, 3) [m] of a circular arc that turns by ``angle`` [rad] about d1.

    Raises:
        ValueError: naming a length that is not positive, an angle of zero, fewer than two nodes.
    """
    _check_curve(length, n_nodes)
    if not (isfinite(angle) and angle != 0.0):
        raise ValueError(
            f"angle: expected other than zero [rad], as ``straight`` has it; got {angle}"
        )
    clamp = np.asarray(clamp, dtype=np.float64)
    turned = np.linspace(0.0, angle, n_nodes)
    radius = length / angle
    along, across = radius * np.sin(turned), radius * (np.cos(turned) - 1.0)
    return clamp[:3, 3] + along[:, None] * clamp[:3, 2] + across[:, None] * clamp[:3, 1]


def catenary(start: ArrayLike, end: ArrayLike, length: float, n_nodes: int) -> Array:
    """Nodes (n_nodes, 3) [m], equally spaced, of an inextensible chain hung from two points.

    With horizontal span d and height difference v, the parameter a solves
    ``sqrt(L^2 - v^2) = 2 a sinh(d / 2a)``.

    Raises:
        ValueError: if the points are further apart than ``length`` or one above the other.
    """
    _check_curve(length, n_nodes)
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    chord = end - start
    d, v = float(np.hypot(chord[0], chord[1])), float(chord[2])
    if not np.linalg.norm(chord) < length:
        raise ValueError(
            f"start, end: expected points closer than the length {length:.4g} m,"
            f" got {np.linalg.norm(chord):.4g} m"
        )
    if d < 1e-6 * length:
        raise ValueError("start, end: expected a horizontal span, got points above each other")
    ratio = float(np.sqrt(length**2 - v**2)) / d
    half = _root(lambda z: np.sinh(z) / z - ratio, 1e-9, 10.0 + 2.0 * np.log(ratio))
    a = d / (2.0 * half)
    middle = a * np.arcsinh(v / (2.0 * a * np.sinh(half)))  # of the span, left of the lowest point
    lowest = d / 2.0 - middle
    s = np.linspace(0.0, length, n_nodes) - a * np.sinh(lowest / a)
    along = lowest + a * np.arcsinh(s / a)
    height = np.hypot(a, s) - a * np.cosh(lowest / a)
    return np.column_stack([start[:2] + np.outer(along / d, chord[:2]), start[2] + height])


def hanging(boundary: BoundaryPoses, length: float, n_nodes: int) -> Array:
    """Nodes (n_nodes, 3) [m] of a smooth curve of the given length that leaves both clamps along
    their d3 and sags between them: a start for the rod's own equilibrium."""
    _check_curve(length, n_nodes)
    if boundary.right is None:
        return straight(boundary.left, length, n_nodes)
    p0, p3 = boundary.left[:3, 3], boundary.right[:3, 3]
    d0, d3 = boundary.left[:3, 2], boundary.right[:3, 2]
    chord = p3 - p0
    span = float(np.linalg.norm(chord))
    along = chord / max(span, 1e-9)
    down = np.array([0.0, 0.0, -1.0]) - along * -along[2]
    if np.linalg.norm(down) < 1e-3:
        down = np.cross(along, [0.0, 1.0, 0.0])
    down /= np.linalg.norm(down)
    t = np.linspace(0.0, 1.0, 2 * n_nodes)[:, None]

    def curve(handle: float, sag: float) -> Array:
        p1, p2 = p0 + handle * d0, p3 - handle * d3
        bezier = (1 - t) ** 3 * p0 + 3 * (1 - t) ** 2 * t * p1
        bezier = bezier + 3 * (1 - t) * t**2 * p2 + t**3 * p3
        return bezier + sag * 16.0 * (t * (1 - t)) ** 2 * down

    def excess(handle: float, sag: float) -> float:
        return curves.arc_length(curve(handle, sag))[-1] - length

    handle = 0.3 * max(span, 0.3 * length)
    while excess(handle, 0.0) > 0.0 and handle > 1e-3 * length:
        handle *= 0.7
    sag = _root(lambda s: excess(handle, s), 0.0, length) if excess(handle, 0.0) < 0.0 else 0.0
    return curves.resample(curve(handle, sag), n_nodes)


def random_boundary(rng: np.random.Generator, length: float) -> BoundaryPoses:
    """Clamp poses as two arms may hold a cable of ``length`` [m]: 0.3 to 0.95 lengths apart, in
    any heading, up to 30 degrees out of level, each clamp tilted up to 60 degrees off the chord and
    twisted up to 30 degrees, around 0.35 m above the origin."""
    _check_curve(length, 2)
    heading = rng.uniform(-np.pi, np.pi)
    slope = rng.uniform(-np.pi / 6, np.pi / 6)
    span = rng.uniform(0.3, 0.95) * length
    along = np.array(
        [np.cos(slope) * np.cos(heading), np.cos(slope) * np.sin(heading), np.sin(slope)]
    )
    level = frame_along(along, np.cross([0.0, 0.0, 1.0], along))
    centre = np.array([0.0, 0.0, 0.35]) + rng.uniform(-0.1, 0.1, 3)
    clamps = []
    for side in (-0.5, 0.5):
        azimuth, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, np.pi / 3)
        twist = rng.uniform(-np.pi / 6, np.pi / 6)
        bend = exp_so3([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0])
        clamps.append(pose(level @ bend @ exp_so3([0.0, 0.0, twist]), centre + side * span * along))
    return BoundaryPoses(*clamps)


def _check_curve(length: float, n_nodes: int) -> None:
    if not (isfinite(length) and length > 0.0):
        raise ValueError(f"length: expected a positive length [m], got {length}")
    if n_nodes < 2:
        raise ValueError(f"n_nodes: expected at least 2, got {n_nodes}")


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    root: Any = brentq(function, low, high, xtol=1e-15)
    return float(root)


def frames_along(positions: Array, boundary: BoundaryPoses) -> Array:
    """Quaternions (n, 4) along a centerline, with the twist between the clamps spread evenly."""
    tangents = np.diff(positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    if boundary.right is None:
        frames = curves.parallel_transport(tangents, boundary.left[:3, :3])
    else:
        carried = curves.parallel_transport(
            np.concatenate([tangents, boundary.right[None, :3, 2]]), boundary.left[:3, :3]
        )
        frames, last = carried[:-1], carried[-1]
        twist = log_so3(last.T @ boundary.right[:3, :3])[2]
        angles = twist * (np.arange(len(frames)) + 0.5) / len(frames)
        frames = frames @ exp_so3(angles[:, None] * np.array([0.0, 0.0, 1.0]))
    return matrix_to_quaternion(frames)
