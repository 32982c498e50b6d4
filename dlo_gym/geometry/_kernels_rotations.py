"""Rotations, one after another over a batch."""

from math import fabs, sqrt

import numpy as np
from numba import njit


@njit(cache=True)
def matrix_to_quaternion(matrices, quaternions):
    """Update ``quaternions`` (b, 4) wxyz, w >= 0, from rotation matrices (b, 3, 3).

    False, with nothing said about the quaternions, if a matrix is off from a rotation by more than
    rounding. Digit for digit SciPy's ``Rotation.from_matrix(...).as_quat(canonical=True)``.
    """
    for b in range(len(matrices)):
        m = matrices[b]
        if not _is_rotation(m):
            return False
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        if trace > max(m[0, 0], m[1, 1], m[2, 2]):
            w, x, y, z = 1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        elif m[0, 0] >= max(m[1, 1], m[2, 2]):
            w, x = m[2, 1] - m[1, 2], 1.0 - trace + 2.0 * m[0, 0]
            y, z = m[1, 0] + m[0, 1], m[2, 0] + m[0, 2]
        elif m[1, 1] >= m[2, 2]:
            w, y = m[0, 2] - m[2, 0], 1.0 - trace + 2.0 * m[1, 1]
            x, z = m[0, 1] + m[1, 0], m[2, 1] + m[1, 2]
        else:
            w, z = m[1, 0] - m[0, 1], 1.0 - trace + 2.0 * m[2, 2]
            x, y = m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
        norm = sqrt(x * x + y * y + z * z + w * w)
        first = w if w != 0.0 else (x if x != 0.0 else (y if y != 0.0 else z))
        sign = -1.0 if first < 0.0 else 1.0
        q = quaternions[b]
        q[0], q[1], q[2], q[3] = (
            sign * (w / norm), sign * (x / norm), sign * (y / norm), sign * (z / norm),
        )  # fmt: skip
    return True


@njit(cache=True)
def _is_rotation(m):
    for i in range(3):
        for j in range(i + 1):
            product = m[i, 0] * m[j, 0] + m[i, 1] * m[j, 1] + m[i, 2] * m[j, 2]
            if not fabs(product - (1.0 if i == j else 0.0)) < 1e-13:
                return False
    across = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    return (
        across * m[2, 0]
        + (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * m[2, 1]
        + (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * m[2, 2]
        > 0.0
    )


@njit(cache=True)
def parallel_transport(tangents, first_frame, frames):
    """Update ``frames`` (n, 3, 3) to ``first_frame`` (3, 3) turned from tangent to tangent (n, 3)
    by the smallest rotation each time."""
    last, d1 = first_frame[:, 2].copy(), first_frame[:, 0].copy()
    for i in range(len(tangents)):
        tangent = tangents[i] / sqrt(_dot(tangents[i], tangents[i]))
        cosine = _dot(last, tangent)
        if cosine < -1.0 + 1e-9:  # opposite: half a turn about any perpendicular
            axis = np.zeros(3)
            axis[np.argmin(np.abs(last))] = 1.0
            axis -= _dot(axis, last) * last
            d1 = 2.0 * _dot(axis, d1) / _dot(axis, axis) * axis - d1
        else:
            # R = I + [v] + [v]^2 / (1 + cosine) with v = last x tangent
            axis = _cross(last, tangent)
            turn = _cross(axis, d1)
            d1 = d1 + turn + _cross(axis, turn) / (1.0 + cosine)
        d1 -= _dot(d1, tangent) * tangent  # orthonormal again: errors cannot grow
        d1 /= sqrt(_dot(d1, d1))
        frames[i, :, 0], frames[i, :, 1], frames[i, :, 2] = d1, _cross(tangent, d1), tangent
        last = tangent


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):
    product = np.empty(3)
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]
    return product
