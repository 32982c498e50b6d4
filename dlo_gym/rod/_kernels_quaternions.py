"""Rotations as unit quaternions wxyz: to a matrix, between two, by a vector, and back to one."""

from math import acos, cos, sin, sqrt

from numba import njit


@njit(cache=True)
def quaternion_to_columns(q, R):
    """Update ``R`` (3, 3) with the rotation matrix of unit quaternion ``q`` wxyz (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - w * z)
    R[0, 2] = 2.0 * (x * z + w * y)
    R[1, 0] = 2.0 * (x * y + w * z)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - w * x)
    R[2, 0] = 2.0 * (x * z - w * y)
    R[2, 1] = 2.0 * (y * z + w * x)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def relative_quaternion(a, b, out):
    """Update ``out`` (4,) with conj(a) b, of the two the one with w >= 0."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    sign = 1.0 if w >= 0.0 else -1.0
    out[0] = sign * w
    out[1] = sign * x
    out[2] = sign * y
    out[3] = sign * z


@njit(cache=True)
def rotate(q, vx, vy, vz):
    """Update unit quaternion ``q`` to q exp(v / 2): a turn by v [rad] in the body's own frame."""
    angle = 0.5 * sqrt(vx * vx + vy * vy + vz * vz)
    if angle > 1e-8:
        scale = 0.5 * sin(angle) / angle
        c = cos(angle)
    else:
        scale = 0.5
        c = 1.0
    x, y, z = scale * vx, scale * vy, scale * vz
    a, b, d, e = q[0], q[1], q[2], q[3]
    q[0] = a * c - b * x - d * y - e * z
    q[1] = a * x + b * c + d * z - e * y
    q[2] = a * y - b * z + d * c + e * x
    q[3] = a * z + b * y - d * x + e * c
    norm = 1.0 / sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] *= norm


@njit(cache=True)
def log_factor(w):
    """g, g' and g'' for the rotation vector g(w) v of a unit quaternion (w, v), w >= 0."""
    z = 0.5 * (1.0 - w)
    if z < 0.02:
        # Series of 2 arcsin(sqrt z) / sqrt(z (1 - z)); ratio of coefficients 2k / (2k + 1).
        coefficient = 1.0
        power = 1.0
        value = 1.0
        first = 0.0
        second = 0.0
        power_1 = 1.0
        power_2 = 1.0
        for k in range(1, 11):
            coefficient *= 2.0 * k / (2.0 * k + 1.0)
            if k > 1:
                second += coefficient * k * (k - 1) * power_2
                power_2 *= z
            first += coefficient * k * power_1
            power_1 *= z
            power *= z
            value += coefficient * power
        return 2.0 * value, -first, 0.5 * second
    s2 = 1.0 - w * w
    g = 2.0 * acos(w) / sqrt(s2)
    dg = (w * g - 2.0) / s2
    return g, dg, (g + 3.0 * w * dg) / s2
