"""Contact of a rod with obstacles: potential, friction, anchors, and steps that do not tunnel.

Contact points p = (1 - s) x_e + s x_e+1 lie along every element; their gap is g = d(p) - r with d
the obstacle's signed distance. A point that overlaps by u = -g is pushed out with the force

    N(u) = k u^2 / (2 h) for u < h, k (u - h / 2) beyond        (C1 in u, its potential C2)

and held by Coulomb friction, regularised over the slip length c: with a the point's anchor on the
obstacle and v = (1 - n n^T)(p - a),

    T = mu N f(|v| / c) v / |v|,   f(y) = y (2 - y) for y < 1, 1 beyond.

The anchor stays while |v| < c and is dragged along at distance c beyond, after each converged step;
so friction holds a rod that rests, without creep. T depends on N, so the exact tangent is
unsymmetric. With ``lag``, N and n in T are those of a former shape: then T has a potential.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH
from dlo_gym.rod._kernels_distance import (
    local_derivatives,
    local_distance,
    to_local,
    to_world,
)


class Touch(NamedTuple):
    """How the rod touches: p contact points, n elements.

    Attributes:
        elements: (p,) element that carries the point.
        weights: (p,) s, its place on the element, from 0 to 1.
        radius: (p,) of the rod [m].
        stiffness: (p,) k [N/m].
        onset: (p,) h [m].
        slip: (p,) c [m].
        friction: mu [-].
        neighbours: elements this close along the rod do not touch each other; 0 if none do.
        pair_radius: (n,) [m].
        pair_stiffness: (n,) [N/m].
    """

    elements: np.ndarray
    weights: np.ndarray
    radius: np.ndarray
    stiffness: np.ndarray
    onset: np.ndarray
    slip: np.ndarray
    friction: float
    neighbours: int
    pair_radius: np.ndarray
    pair_stiffness: np.ndarray


class Hold(NamedTuple):
    """How friction holds the rod's p points on m obstacles; no obstacles without friction.

    Attributes:
        anchors: (m, p, 3) in the obstacles' frames [m], NaN where a point has none.
        lag: (m, p, 4) N [N] and n of a former shape.
        lagging: whether friction is to be that of ``lag``, which has a potential.
    """

    anchors: np.ndarray
    lag: np.ndarray
    lagging: bool


@njit(cache=True)
def penalty(overlap, onset):
    """Potential, its first and second derivative by the overlap [m], for unit stiffness."""
    if overlap <= 0.0:
        return 0.0, 0.0, 0.0
    if overlap < onset:
        return overlap**3 / (6.0 * onset), overlap**2 / (2.0 * onset), overlap / onset
    potential = 0.5 * overlap * (overlap - onset) + onset * onset / 6.0
    return potential, overlap - 0.5 * onset, 1.0


@njit(cache=True)
def _point(touch, x, i, out):
    e, s = touch.elements[i], touch.weights[i]
    for k in range(3):
        out[k] = (1.0 - s) * x[e, k] + s * x[e + 1, k]


@njit(cache=True)
def _reach(obstacles, o, low, high):
    """Whether obstacle ``o`` may touch the box from ``low`` to ``high`` (3,)."""
    R, size = obstacles.rotations[o], obstacles.sizes[o]
    centre, extent = np.empty(3), 0.0
    for k in range(3):
        centre[k] = 0.5 * (low[k] + high[k])
        extent += 0.25 * (high[k] - low[k]) ** 2
    local = np.empty(3)
    to_local(R, obstacles.origins[o], centre, local)
    return local_distance(obstacles.kinds[o], size, local) <= sqrt(extent)


@njit(cache=True)
def bounds(touch, x, low, high):
    """Update ``low`` and ``high`` (3,) with the corners of the box around the rod."""
    thickest = touch.radius.max()
    for k in range(3):
        low[k], high[k] = np.inf, -np.inf
        for i in range(x.shape[0]):
            low[k] = min(low[k], x[i, k])
            high[k] = max(high[k], x[i, k])
        low[k] -= thickest
        high[k] += thickest


@njit(cache=True)
def _friction(touch, i, normal_force, normal, curvature, v, tangent, traction, derivative):
    """Update ``traction`` (3,), T of one point, and ``derivative`` dT/dp less its part by N.

    Args:
        v: (3,) p - a in world.
        curvature: (3, 3) derivative of ``normal``; zero for a lagged normal.
        tangent: (3,) scratch.

    Returns the potential that T has while N and the normal stand still.
    """
    nv = normal[0] * v[0] + normal[1] * v[1] + normal[2] * v[2]
    length = 0.0
    for k in range(3):
        tangent[k] = v[k] - nv * normal[k]
        length += tangent[k] ** 2
    length = sqrt(length)
    c = touch.slip[i]
    y = length / c
    limit = touch.friction * normal_force
    if y < 1.0:
        over_length, slope = (2.0 - y) / c, (2.0 - 2.0 * y) / c
        potential = limit * c * (y * y - y**3 / 3.0)
    else:
        over_length, slope = 1.0 / length, 0.0
        potential = limit * c * (y - 1.0 / 3.0)
    Cv = np.empty(3)
    for k in range(3):
        traction[k] = limit * over_length * tangent[k]
        Cv[k] = curvature[k, 0] * v[0] + curvature[k, 1] * v[1] + curvature[k, 2] * v[2]
        tangent[k] /= max(length, 1e-300)
    along = np.empty(3)  # the direction's row of dv/dp = 1 - n n^T - (n.v) C - n (C v)^T
    for j in range(3):
        along[j] = tangent[j]
        for k in range(3):
            along[j] -= nv * tangent[k] * curvature[k, j]
    for k in range(3):
        for j in range(3):
            turned = (1.0 if k == j else 0.0) - normal[k] * normal[j]
            turned -= nv * curvature[k, j] + normal[k] * Cv[j]
            derivative[k, j] = limit * (
                over_length * (turned - tangent[k] * along[j]) + slope * tangent[k] * along[j]
            )
    return potential


@njit(cache=True)
def _add_block(matrix, row, column, factor, block):
    for k in range(3):
        for j in range(3):
            matrix[row + k, HALF_BANDWIDTH + column - row + j - k] += factor * block[k, j]


@njit(cache=True)
def add_obstacles(touch, obstacles, hold, x, gradient, matrix):
    """Energy [J] of contact with obstacles; add to ``gradient`` and ``matrix``.

    Args:
        touch, obstacles, hold: Touch, ObstacleArrays, Hold.
        x: (n + 1, 3) nodes [m].
        gradient: (6 n + 3,).
        matrix: (6 n + 3, 17).
    """
    energy = 0.0
    anchors, lag, lagging = hold.anchors, hold.lag, hold.lagging
    with_friction = anchors.shape[0] > 0
    p, local, normal, v, tangent = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    traction, held, lagged_normal = np.empty(3), np.empty(3), np.empty(3)
    curvature, scratch, block = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    flat = np.zeros((3, 3))
    low, high = np.empty(3), np.empty(3)
    bounds(touch, x, low, high)
    for o in range(obstacles.kinds.shape[0]):
        if not _reach(obstacles, o, low, high):
            continue
        kind, size = obstacles.kinds[o], obstacles.sizes[o]
        R, origin = obstacles.rotations[o], obstacles.origins[o]
        for i in range(touch.elements.shape[0]):
            _point(touch, x, i, p)
            to_local(R, origin, p, local)
            overlap = touch.radius[i] - local_distance(kind, size, local)
            anchored = with_friction and not np.isnan(anchors[o, i, 0])
            if overlap <= 0.0 and not (anchored and lagging and lag[o, i, 0] > 0.0):
                continue
            k = touch.stiffness[i]
            potential, first, second = penalty(overlap, touch.onset[i])
            energy += k * potential
            local_derivatives(kind, size, local, normal, curvature)
            to_world(R, normal, curvature, scratch)
            for a in range(3):
                traction[a] = -k * first * normal[a]
                for b in range(3):
                    block[a, b] = k * (second * normal[a] * normal[b] - first * curvature[a, b])
            if anchored:
                for a in range(3):
                    v[a] = p[a] - origin[a]
                    for b in range(3):
                        v[a] -= R[a, b] * anchors[o, i, b]
                if not lagging:
                    energy += _friction(
                        touch, i, k * first, normal, curvature, v, tangent, held, scratch
                    )
                    for a in range(3):
                        for b in range(3):
                            # dN/dp = -k second n^T, and T is in proportion to N
                            share = held[a] * second / first if first > 0.0 else 0.0
                            block[a, b] += scratch[a, b] - share * normal[b]
                else:
                    for a in range(3):
                        lagged_normal[a] = lag[o, i, 1 + a]
                    energy += _friction(
                        touch, i, lag[o, i, 0], lagged_normal, flat, v, tangent, held, scratch
                    )
                    for a in range(3):
                        for b in range(3):
                            block[a, b] += scratch[a, b]
                for a in range(3):
                    traction[a] += held[a]
            e, s = touch.elements[i], touch.weights[i]
            base = 6 * e
            for a in range(3):
                gradient[base + a] += (1.0 - s) * traction[a]
                gradient[base + 6 + a] += s * traction[a]
            _add_block(matrix, base, base, (1.0 - s) * (1.0 - s), block)
            _add_block(matrix, base, base + 6, (1.0 - s) * s, block)
            _add_block(matrix, base + 6, base, (1.0 - s) * s, block)
            _add_block(matrix, base + 6, base + 6, s * s, block)
    return energy


@njit(cache=True)
def update_lag(touch, obstacles, x, lag):
    """Update ``lag`` (m, p, 4) with every point's N [N] and normal at shape ``x``."""
    p, local, normal = np.empty(3), np.empty(3), np.empty(3)
    curvature, scratch = np.empty((3, 3)), np.empty((3, 3))
    for o in range(lag.shape[0]):
        R = obstacles.rotations[o]
        for i in range(lag.shape[1]):
            _point(touch, x, i, p)
            to_local(R, obstacles.origins[o], p, local)
            overlap = touch.radius[i] - local_distance(
                obstacles.kinds[o], obstacles.sizes[o], local
            )
            lag[o, i] = 0.0
            if overlap > 0.0:
                local_derivatives(obstacles.kinds[o], obstacles.sizes[o], local, normal, curvature)
                to_world(R, normal, curvature, scratch)
                lag[o, i, 0] = touch.stiffness[i] * penalty(overlap, touch.onset[i])[1]
                lag[o, i, 1:] = normal


@njit(cache=True)
def update_anchors(touch, obstacles, x, anchors):
    """Update ``anchors`` (m, p, 3) after a converged step: set where a point has come to rest,
    dragged where it slid, NaN where it left."""
    p, local, normal, slid = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    curvature = np.empty((3, 3))
    for o in range(anchors.shape[0]):
        for i in range(anchors.shape[1]):
            _point(touch, x, i, p)
            to_local(obstacles.rotations[o], obstacles.origins[o], p, local)
            kind, size = obstacles.kinds[o], obstacles.sizes[o]
            if local_distance(kind, size, local) >= touch.radius[i]:
                anchors[o, i] = np.nan
                continue
            if np.isnan(anchors[o, i, 0]):
                anchors[o, i] = local
                continue
            local_derivatives(kind, size, local, normal, curvature)
            nv = 0.0
            for k in range(3):
                slid[k] = local[k] - anchors[o, i, k]
                nv += normal[k] * slid[k]
            length = 0.0
            for k in range(3):
                slid[k] -= nv * normal[k]
                length += slid[k] ** 2
            length = sqrt(length)
            if length > touch.slip[i]:
                for k in range(3):
                    anchors[o, i, k] = local[k] - slid[k] * touch.slip[i] / length


@njit(cache=True)
def point_forces(touch, obstacles, x, anchors, points, forces):
    """Update ``points`` (p, 3) and ``forces`` (m, p, 3) [N] of the obstacles on the rod."""
    local, normal, v, tangent = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    held, curvature, scratch = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(points.shape[0]):
        _point(touch, x, i, points[i])
    forces[:] = 0.0
    for o in range(forces.shape[0]):
        R, origin = obstacles.rotations[o], obstacles.origins[o]
        for i in range(points.shape[0]):
            to_local(R, origin, points[i], local)
            overlap = touch.radius[i] - local_distance(
                obstacles.kinds[o], obstacles.sizes[o], local
            )
            if overlap <= 0.0:
                continue
            N = touch.stiffness[i] * penalty(overlap, touch.onset[i])[1]
            local_derivatives(obstacles.kinds[o], obstacles.sizes[o], local, normal, curvature)
            to_world(R, normal, curvature, scratch)
            forces[o, i] = N * normal
            if anchors.shape[0] > 0 and not np.isnan(anchors[o, i, 0]):
                for a in range(3):
                    v[a] = points[i, a] - origin[a]
                    for b in range(3):
                        v[a] -= R[a, b] * anchors[o, i, b]
                _friction(touch, i, N, normal, curvature, v, tangent, held, scratch)
                forces[o, i] -= held


@njit(cache=True)
def gaps(touch, obstacles, x, out):
    """Update ``out`` (m, p) with the gaps [m]."""
    p, local = np.empty(3), np.empty(3)
    for i in range(out.shape[1]):
        _point(touch, x, i, p)
        for o in range(out.shape[0]):
            to_local(obstacles.rotations[o], obstacles.origins[o], p, local)
            out[o, i] = (
                local_distance(obstacles.kinds[o], obstacles.sizes[o], local) - touch.radius[i]
            )


@njit(cache=True)
def free_fraction(touch, before, after, x, x_after, depth):
    """The part of the way from ``x`` to ``x_after`` that takes no point deeper than ``depth``
    radii into an obstacle or, by more than a tenth of that, deeper than it was.

    Obstacles go from poses ``before`` to ``after`` on the way, and a point's way is straight in
    the obstacle's frame. Conservative advancement: a point moves by what its distance allows.
    """
    fraction = 1.0
    p, start, end, at = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    low, high = np.empty(3), np.empty(3)
    low_after, high_after = np.empty(3), np.empty(3)
    bounds(touch, x, low, high)
    bounds(touch, x_after, low_after, high_after)
    low, high = np.minimum(low, low_after), np.maximum(high, high_after)
    for o in range(before.kinds.shape[0]):
        if not (_reach(before, o, low, high) or _reach(after, o, low, high)):
            moved = 0.0
            for k in range(3):
                moved = max(moved, abs(before.origins[o, k] - after.origins[o, k]))
            if moved == 0.0:
                continue
        kind, size = before.kinds[o], before.sizes[o]
        for i in range(touch.elements.shape[0]):
            _point(touch, x, i, p)
            to_local(before.rotations[o], before.origins[o], p, start)
            _point(touch, x_after, i, p)
            to_local(after.rotations[o], after.origins[o], p, end)
            way = 0.0
            for k in range(3):
                way += (end[k] - start[k]) ** 2
            way = sqrt(way)
            radius = touch.radius[i]
            gap = local_distance(kind, size, start) - radius
            floor = min(gap, -depth * radius) - 0.1 * depth * radius
            if gap - way >= floor:
                continue
            t = 0.0
            while t < fraction:
                t += max(gap - floor, 0.01 * depth * radius) / way
                if t >= fraction:
                    break
                for k in range(3):
                    at[k] = start[k] + t * (end[k] - start[k])
                gap = local_distance(kind, size, at) - radius
                if gap < floor + 0.02 * depth * radius:
                    fraction = t
    return fraction
