"""One clamp's pose: displaced, and as a quaternion. Scalar code, for the cost of a call."""

from math import sin, sqrt

import numpy as np
from numba import njit


@njit(cache=True)
def displace_clamp(clamp, twist, out):
    """Update the pose ``out`` (4, 4) to ``clamp`` moved by ``twist`` (6,), both in world axes."""
    x, y, z = twist[3], twist[4], twist[5]
    angle = sqrt(x * x + y * y + z * z)
    # Rodrigues: R = I + s [r] + c [r]^2
    if angle > 1e-6:
        s, c = sin(angle) / angle, 2.0 * (sin(0.5 * angle) / angle) ** 2
    else:
        s, c = 1.0 - angle**2 / 6.0, 0.5
    turn = np.empty((3, 3))
    turn[0, 0], turn[1, 1] = 1.0 - c * (y * y + z * z), 1.0 - c * (x * x + z * z)
    turn[2, 2] = 1.0 - c * (x * x + y * y)
    turn[0, 1], turn[1, 0] = c * x * y - s * z, c * x * y + s * z
    turn[0, 2], turn[2, 0] = c * x * z + s * y, c * x * z - s * y
    turn[1, 2], turn[2, 1] = c * y * z - s * x, c * y * z + s * x
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = turn[i, 0] * clamp[0, j] + turn[i, 1] * clamp[1, j] + turn[i, 2] * clamp[2, j]
    # One Newton step towards the nearest rotation keeps long sequences of moves orthonormal.
    for i in range(3):
        for j in range(3):
            square = 0.0
            for k in range(3):
                square += (R[i, 0] * R[k, 0] + R[i, 1] * R[k, 1] + R[i, 2] * R[k, 2]) * R[k, j]
            out[i, j] = 1.5 * R[i, j] - 0.5 * square
        out[i, 3] = clamp[i, 3] + twist[i]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@njit(cache=True)
def displace_clamps(clamps, twists, out):
    """Update the poses ``out`` (m, 4, 4) to ``clamps`` moved by ``twists`` (m, 6)."""
    for i in range(clamps.shape[0]):
        displace_clamp(clamps[i], twists[i], out[i])


@njit(cache=True)
def displace_along(clamps, twists, out):
    """Update ``out`` (s, m, 4, 4) to ``clamps`` (m, 4, 4) moved once, twice, ... by ``twists``
    (m, 6)."""
    for s in range(out.shape[0]):
        displace_clamps(clamps if s == 0 else out[s - 1], twists, out[s])


@njit(cache=True)
def clamp_frame(clamp, rotation, quaternion):
    """Update ``rotation`` (3, 3) and ``quaternion`` wxyz (4,), w >= 0, to those of a pose (4, 4).

    Shepperd's method: divides by the largest component.
    """
    for i in range(3):
        for j in range(3):
            rotation[i, j] = clamp[i, j]
    trace = clamp[0, 0] + clamp[1, 1] + clamp[2, 2]
    largest, size = 0, trace
    for i in range(3):
        if clamp[i, i] > size:
            largest, size = i + 1, clamp[i, i]
    if largest == 0:
        quaternion[0] = 1.0 + trace
        quaternion[1] = clamp[2, 1] - clamp[1, 2]
        quaternion[2] = clamp[0, 2] - clamp[2, 0]
        quaternion[3] = clamp[1, 0] - clamp[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quaternion[0] = clamp[k, j] - clamp[j, k]
        quaternion[1 + i] = 1.0 + 2.0 * clamp[i, i] - trace
        quaternion[1 + j] = clamp[i, j] + clamp[j, i]
        quaternion[1 + k] = clamp[i, k] + clamp[k, i]
    norm = 0.0
    for i in range(4):
        norm += quaternion[i] ** 2
    scale = (1.0 if quaternion[0] >= 0.0 else -1.0) / sqrt(norm)
    for i in range(4):
        quaternion[i] *= scale
