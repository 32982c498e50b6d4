"""Distances to obstacles and between rod segments, with first and second derivatives."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

PLANE, BOX, SPHERE, CAPSULE = 0, 1, 2, 3

# Parallel segments have no unique pair of closest points. This much of the squared length draws
# both towards the segments' middles; it widens the distance of touching segments by under 0.1 %.
PARALLEL = 2e-3


class ObstacleArrays(NamedTuple):
    """Obstacles as the kernels take them.

    Attributes:
        kinds: (m,) PLANE, BOX, SPHERE or CAPSULE.
        sizes: (m, 3) [m]: half edges of a box; radius; radius and half length of a capsule.
        rotations, origins: (m, 3, 3), (m, 3) T_world_obstacle.
    """

    kinds: np.ndarray
    sizes: np.ndarray
    rotations: np.ndarray
    origins: np.ndarray


@njit(cache=True)
def to_local(rotation, origin, p, out):
    """Update ``out`` (3,) with world point ``p`` in the frame of (rotation, origin)."""
    a, b, c = p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]
    for i in range(3):
        out[i] = rotation[0, i] * a + rotation[1, i] * b + rotation[2, i] * c


@njit(cache=True)
def local_distance(kind, size, p):
    """Signed distance [m] of the obstacle's surface from ``p`` (3,) in its own frame."""
    if kind == PLANE:
        return p[2]
    if kind == SPHERE:
        return sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2) - size[0]
    if kind == CAPSULE:
        z = p[2] - min(max(p[2], -size[1]), size[1])
        return sqrt(p[0] ** 2 + p[1] ** 2 + z**2) - size[0]
    outside = 0.0
    deepest = -np.inf
    for i in range(3):
        beyond = abs(p[i]) - size[i]
        deepest = max(deepest, beyond)
        if beyond > 0.0:
            outside += beyond * beyond
    return sqrt(outside) if outside > 0.0 else deepest


@njit(cache=True)
def local_derivatives(kind, size, p, normal, curvature):
    """Update the distance's gradient (3,) and Hessian (3, 3) at ``p``, in the obstacle's frame.

    The distance is that from a point, a line or a face: with v the vector from the nearest of its
    points, over the dimensions that count, the gradient is v / |v|, the Hessian
    (1 - n n^T) / |v| over these dimensions.
    """
    normal[:] = 0.0
    curvature[:] = 0.0
    if kind == PLANE:
        normal[2] = 1.0
        return
    for i in range(3):
        if kind == SPHERE or (kind == CAPSULE and i < 2):
            normal[i] = p[i]
        elif kind == CAPSULE:
            if abs(p[2]) > size[1]:
                normal[2] = p[2] - (size[1] if p[2] > 0.0 else -size[1])
        elif abs(p[i]) > size[i]:
            normal[i] = p[i] - (size[i] if p[i] > 0.0 else -size[i])
    length = sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if length < 1e-12:  # inside a box, or on an axis: out by the nearest face, or by x
        nearest = 0
        if kind == BOX:
            for i in range(1, 3):
                if abs(p[i]) - size[i] > abs(p[nearest]) - size[nearest]:
                    nearest = i
        normal[:] = 0.0
        normal[nearest] = 1.0 if p[nearest] >= 0.0 else -1.0
        return
    for i in range(3):
        normal[i] /= length
    for i in range(3):
        if kind == BOX and abs(p[i]) <= size[i]:
            continue
        if kind == CAPSULE and i == 2 and abs(p[2]) <= size[1]:
            continue
        curvature[i, i] = 1.0 / length
        for j in range(3):
            curvature[i, j] -= normal[i] * normal[j] / length


@njit(cache=True)
def to_world(rotation, normal, curvature, scratch):
    """Update gradient and Hessian from the frame ``rotation`` to world axes."""
    for i in range(3):
        for j in range(3):
            scratch[i, j] = 0.0
            for k in range(3):
                scratch[i, j] += rotation[i, k] * curvature[k, j]
    a, b, c = normal[0], normal[1], normal[2]
    for i in range(3):
        normal[i] = rotation[i, 0] * a + rotation[i, 1] * b + rotation[i, 2] * c
        for j in range(3):
            curvature[i, j] = 0.0
            for k in range(3):
                curvature[i, j] += scratch[i, k] * rotation[j, k]


@njit(cache=True)
def segment_distance(a, b, c, d):
    """Distance of segments a b and c d (3,), and where: (distance, s on a b, t on c d).

    The distance D is that of D^2 = min over s, t of |p(s) - q(t)|^2
    + PARALLEL (|ab|^2 (s - 1/2)^2 + |cd|^2 (t - 1/2)^2), which is continuously differentiable.
    """
    uu = uv = vv = uw = vw = ww = 0.0
    for i in range(3):
        u, v, w = b[i] - a[i], d[i] - c[i], 0.5 * (a[i] + b[i] - c[i] - d[i])
        uu += u * u
        uv += u * v
        vv += v * v
        uw += u * w
        vw += v * w
        ww += w * w
    # In s', t' from the middles: uu' s'^2 - 2 uv s' t' + vv' t'^2 + 2 uw s' - 2 vw t' + ww.
    uu *= 1.0 + PARALLEL
    vv *= 1.0 + PARALLEL
    determinant = uu * vv - uv * uv
    s = (uv * vw - vv * uw) / determinant
    t = (uu * vw - uv * uw) / determinant
    if abs(s) > 0.5 or abs(t) > 0.5:
        best = np.inf
        s_best = t_best = 0.0
        for side in range(4):
            if side < 2:
                s = -0.5 if side == 0 else 0.5
                t = min(max((vw + uv * s) / vv, -0.5), 0.5)
            else:
                t = -0.5 if side == 2 else 0.5
                s = min(max((uv * t - uw) / uu, -0.5), 0.5)
            value = uu * s * s - 2.0 * uv * s * t + vv * t * t + 2.0 * (uw * s - vw * t)
            if value < best:
                best = value
                s_best, t_best = s, t
        s, t = s_best, t_best
    square = uu * s * s - 2.0 * uv * s * t + vv * t * t + 2.0 * (uw * s - vw * t) + ww
    return sqrt(max(square, 0.0)), s + 0.5, t + 0.5


@njit(cache=True)
def segment_derivatives(a, b, c, d, distance, s, t, gradient, hessian):
    """Update the distance's gradient (12,) and Hessian (12, 12) by (a, b, c, d).

    With F = D^2 minimised over s and t, grad F = F_x and hess F = F_xx - F_xp F_pp^-1 F_px over
    those of s, t that are not at an end.
    """
    weights = (1.0 - s, s, t - 1.0, -t)
    mixed = np.zeros((12, 2))
    pull = PARALLEL
    F_ss = F_st = F_tt = 0.0
    for i in range(3):
        u, v = b[i] - a[i], d[i] - c[i]
        w = weights[0] * a[i] + weights[1] * b[i] + weights[2] * c[i] + weights[3] * d[i]
        F_ss += 2.0 * (1.0 + pull) * u * u
        F_tt += 2.0 * (1.0 + pull) * v * v
        F_st -= 2.0 * u * v
        for k in range(4):
            gradient[3 * k + i] = 2.0 * weights[k] * w
            mixed[3 * k + i, 0] = 2.0 * weights[k] * u
            mixed[3 * k + i, 1] = -2.0 * weights[k] * v
        u_pull, v_pull = 2.0 * pull * (s - 0.5) * u, 2.0 * pull * (t - 0.5) * v
        gradient[i] -= u_pull * (s - 0.5)
        gradient[3 + i] += u_pull * (s - 0.5)
        gradient[6 + i] -= v_pull * (t - 0.5)
        gradient[9 + i] += v_pull * (t - 0.5)
        mixed[i, 0] -= 2.0 * (w + u_pull)
        mixed[3 + i, 0] += 2.0 * (w + u_pull)
        mixed[6 + i, 1] += 2.0 * (w - v_pull)
        mixed[9 + i, 1] -= 2.0 * (w - v_pull)
    hessian[:] = 0.0
    for k in range(4):
        for m in range(4):
            coupling = 2.0 * weights[k] * weights[m]
            if k < 2 and m < 2:
                coupling += 2.0 * pull * (s - 0.5) ** 2 * (1.0 if k == m else -1.0)
            elif k >= 2 and m >= 2:
                coupling += 2.0 * pull * (t - 0.5) ** 2 * (1.0 if k == m else -1.0)
            for i in range(3):
                hessian[3 * k + i, 3 * m + i] = coupling
    s_free, t_free = 0.0 < s < 1.0, 0.0 < t < 1.0
    if s_free and t_free:
        det = F_ss * F_tt - F_st * F_st
        i_ss, i_tt, i_st = F_tt / det, F_ss / det, -F_st / det
    else:
        i_ss = 1.0 / F_ss if s_free else 0.0
        i_tt = 1.0 / F_tt if t_free else 0.0
        i_st = 0.0
    # From F = D^2: grad D = grad F / 2D, hess D = (hess F / 2 - grad D grad D^T) / D.
    for k in range(12):
        gradient[k] /= 2.0 * distance
    for k in range(12):
        p = i_ss * mixed[k, 0] + i_st * mixed[k, 1]
        q = i_st * mixed[k, 0] + i_tt * mixed[k, 1]
        for m in range(12):
            schur = hessian[k, m] - p * mixed[m, 0] - q * mixed[m, 1]
            hessian[k, m] = (0.5 * schur - gradient[k] * gradient[m]) / distance
