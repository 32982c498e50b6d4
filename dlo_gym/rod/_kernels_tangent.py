"""How strains, directors and spins change with the rod's shape and motion, for m columns at once.

A column is one quantity by which all is differentiated. The last axis of every array runs over
them; a turn of an element or a clamp is a vector theta in its own frame, R <- R exp(theta).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_energy import log_factor, quaternion_to_columns, relative_quaternion


class Geometry(NamedTuple):
    """A shape and the linear maps from its changes to those of strains.

    Attributes:
        R: (n, 3, 3) R_world_element.
        span: (n, 3) R^T (x_e+1 - x_e) [m].
        bend: (n + 1, 2, 3, 3) d(kappa D)/d(turn) of the frames before and after each node.
        strain: (2 n + 1, 3) gamma of elements [-], then kappa of nodes [1/m].
        clamps: (2, 3, 3) R_world_clamp.
    """

    R: np.ndarray
    span: np.ndarray
    bend: np.ndarray
    strain: np.ndarray
    clamps: np.ndarray


class Tangent(NamedTuple):
    """Derivatives of a moment by m columns.

    Attributes:
        unknowns: (6 n + 3, m) of x_0 theta_0 x_1 ... x_n [m, rad].
        turns: (2, 3, m) of the clamps, in their own frames [rad].
        places: (3 n + 1, 3, m) of nodes and directors.
        speeds: (3 n + 1, 3, m) of their speeds.
        strain: (2 n + 1, 3, m) of the strains.
        w: (n, 3, m) of the angular velocities [rad/s].
    """

    unknowns: np.ndarray
    turns: np.ndarray
    places: np.ndarray
    speeds: np.ndarray
    strain: np.ndarray
    w: np.ndarray


def empty_geometry(n: int) -> Geometry:
    return Geometry(
        np.empty((n, 3, 3)), np.empty((n, 3)), np.zeros((n + 1, 2, 3, 3)),
        np.zeros((2 * n + 1, 3)), np.empty((2, 3, 3)),
    )  # fmt: skip


def empty_tangent(n: int, m: int) -> Tangent:
    return Tangent(
        np.zeros((6 * n + 3, m)), np.zeros((2, 3, m)), np.zeros((3 * n + 1, 3, m)),
        np.zeros((3 * n + 1, 3, m)), np.zeros((2 * n + 1, 3, m)), np.zeros((n, 3, m)),
    )  # fmt: skip


@njit(cache=True)
def copy_tangent(source, out):
    """Update the tangent ``out`` with ``source``."""
    out.unknowns[:] = source.unknowns
    out.turns[:] = source.turns
    out.places[:] = source.places
    out.speeds[:] = source.speeds
    out.strain[:] = source.strain
    out.w[:] = source.w


@njit(cache=True)
def add(a, A, b, B, out):
    """Update ``out`` to a A + b B, contiguous arrays of one shape; ``out`` may be one of them."""
    flat_a, flat_b, flat_out = A.reshape(A.size), B.reshape(B.size), out.reshape(out.size)
    for i in range(flat_a.size):
        flat_out[i] = a * flat_a[i] + b * flat_b[i]


@njit(cache=True)
def measure(rod, x, q, ends, geometry):
    """Update ``geometry`` to the shape of nodes x and frames q."""
    R, span, bend, strain, clamps = geometry
    n = q.shape[0]
    relative = np.empty(4)
    for side in range(2):
        quaternion_to_columns(ends.frames[side], clamps[side])
    for e in range(n):
        quaternion_to_columns(q[e], R[e])
        for i in range(3):
            p = 0.0
            for k in range(3):
                p += R[e, k, i] * (x[e + 1, k] - x[e, k])
            span[e, i] = p
            strain[e, i] = p / rod.rest_length[e]
        strain[e, 2] -= 1.0
    strain[2 * n] = 0.0
    for i in range(n + 1 if ends.right_held else n):
        before = ends.frames[0] if i == 0 else q[i - 1]
        relative_quaternion(before, ends.frames[1] if i == n else q[i], relative)
        r, v = relative[0], relative[1:]
        g, dg, _ = log_factor(r)
        for k in range(3):
            strain[n + i, k] = g * v[k] / rod.voronoi_length[i]
            j, m = (k + 1) % 3, (k + 2) % 3
            for c in range(3):
                # d(r, v) = (q b - a q) / 2 for turns a before and b after the node
                bend[i, 0, k, c] = 0.5 * dg * v[c] * v[k]
                bend[i, 1, k, c] = -0.5 * dg * v[c] * v[k]
            bend[i, 0, k, k] -= 0.5 * g * r
            bend[i, 1, k, k] += 0.5 * g * r
            for side in range(2):
                bend[i, side, k, m] += 0.5 * g * v[j]
                bend[i, side, k, j] -= 0.5 * g * v[m]


@njit(cache=True)
def neighbours(tangent, i, n, before, after):
    """Update ``before`` and ``after`` (3, m) to the turns of the frames beside node i."""
    before[:] = tangent.turns[0] if i == 0 else tangent.unknowns[6 * i - 3 : 6 * i]
    after[:] = tangent.turns[1] if i == n else tangent.unknowns[6 * i + 3 : 6 * i + 6]


@njit(cache=True)
def change_strains(rod, geometry, right_held, tangent):
    """Update the strain of ``tangent``, without what the rest lengths change."""
    R, span, bend = geometry.R, geometry.span, geometry.bend
    unknowns, strain = tangent.unknowns, tangent.strain
    n, m = R.shape[0], unknowns.shape[1]
    before, after = np.empty((3, m)), np.empty((3, m))
    for e in range(n):
        scale, base = 1.0 / rod.rest_length[e], 6 * e
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            r0, r1, r2 = scale * R[e, 0, i], scale * R[e, 1, i], scale * R[e, 2, i]
            pj, pk = scale * span[e, j], scale * span[e, k]
            for c in range(m):
                strain[e, i, c] = (
                    r0 * (unknowns[base + 6, c] - unknowns[base, c])
                    + r1 * (unknowns[base + 7, c] - unknowns[base + 1, c])
                    + r2 * (unknowns[base + 8, c] - unknowns[base + 2, c])
                    + pj * unknowns[base + 3 + k, c]
                    - pk * unknowns[base + 3 + j, c]
                )
    strain[2 * n] = 0.0
    for i in range(n + 1 if right_held else n):
        neighbours(tangent, i, n, before, after)
        scale = 1.0 / rod.voronoi_length[i]
        for k in range(3):
            A, B = bend[i, 0, k], bend[i, 1, k]
            for c in range(m):
                strain[n + i, k, c] = scale * (
                    A[0] * before[0, c] + A[1] * before[1, c] + A[2] * before[2, c]
                    + B[0] * after[0, c] + B[1] * after[1, c] + B[2] * after[2, c]
                )  # fmt: skip


@njit(cache=True)
def change_places(geometry, tangent):
    """Update the places of ``tangent`` given its unknowns."""
    R, unknowns, places = geometry.R, tangent.unknowns, tangent.places
    n, m = R.shape[0], unknowns.shape[1]
    for i in range(n + 1):
        places[i] = unknowns[6 * i : 6 * i + 3]
    for e in range(n):
        row, theta = n + 1 + 2 * e, 6 * e + 3
        for k in range(3):
            d1, d2, d3 = R[e, k, 0], R[e, k, 1], R[e, k, 2]
            for c in range(m):
                turn = unknowns[theta + 2, c]
                places[row, k, c] = d2 * turn - d3 * unknowns[theta + 1, c]
                places[row + 1, k, c] = d3 * unknowns[theta, c] - d1 * turn


@njit(cache=True)
def change_spins(R, unknowns, speeds, d_speeds, d_w):
    """Update ``d_w`` (n, 3, m) given the directors' speeds and their change: see
    ``angular_velocities``."""
    n, m = d_w.shape[0], d_w.shape[2]
    for e in range(n):
        row, theta = n + 1 + 2 * e, 6 * e + 3
        # The speeds a of d1 and b of d2 in the element's frame
        a0, a1, a2, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            a0 += R[e, k, 0] * speeds[row, k]
            a1 += R[e, k, 1] * speeds[row, k]
            a2 += R[e, k, 2] * speeds[row, k]
            b0 += R[e, k, 0] * speeds[row + 1, k]
            b1 += R[e, k, 1] * speeds[row + 1, k]
            b2 += R[e, k, 2] * speeds[row + 1, k]
        for c in range(m):
            t0, t1, t2 = unknowns[theta, c], unknowns[theta + 1, c], unknowns[theta + 2, c]
            d_w[e, 0, c] = b0 * t1 - b1 * t0
            d_w[e, 1, c] = a1 * t0 - a0 * t1
            d_w[e, 2, c] = 0.5 * (a2 * t0 - a0 * t2 + b2 * t1 - b1 * t2)
        for k in range(3):
            h1, h2, d3 = 0.5 * R[e, k, 1], 0.5 * R[e, k, 0], R[e, k, 2]
            for c in range(m):
                d_w[e, 0, c] += d3 * d_speeds[row + 1, k, c]
                d_w[e, 1, c] -= d3 * d_speeds[row, k, c]
                d_w[e, 2, c] += h1 * d_speeds[row, k, c] - h2 * d_speeds[row + 1, k, c]


@njit(cache=True)
def change_director_speeds(R, w, tangent):
    """Update the directors' speeds of ``tangent``: see ``director_velocities``."""
    n, m = w.shape[0], tangent.w.shape[2]
    unknowns, speeds, d_w = tangent.unknowns, tangent.speeds, tangent.w
    for e in range(n):
        row, theta = n + 1 + 2 * e, 6 * e + 3
        w0, w1, w2 = w[e, 0], w[e, 1], w[e, 2]
        for k in range(3):
            d1, d2, d3 = R[e, k, 0], R[e, k, 1], R[e, k, 2]
            for c in range(m):
                t0, t1, t2 = unknowns[theta, c], unknowns[theta + 1, c], unknowns[theta + 2, c]
                # R (dw x e + theta x (w x e)) for e along d1, then d2
                speeds[row, k, c] = (
                    -d1 * (w1 * t1 + w2 * t2) + d2 * (d_w[e, 2, c] + w1 * t0)
                    - d3 * (d_w[e, 1, c] - w2 * t0)
                )  # fmt: skip
                speeds[row + 1, k, c] = (
                    d1 * (w0 * t1 - d_w[e, 2, c]) - d2 * (w0 * t0 + w2 * t2)
                    + d3 * (d_w[e, 0, c] + w2 * t1)
                )  # fmt: skip
