"""Rotations, one after another over a batch."""

from math import fabs, sqrt

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
