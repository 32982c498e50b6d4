"""The rod's contact with itself.

Elements that are far enough apart along the rod push each other off where their axes come closer
than their radii. Such pairs couple distant nodes: their Hessian goes outside the band, to a small
dense matrix over the touching nodes, and is solved for with Woodbury's formula.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod import _kernels_unsymmetric as banded
from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH
from dlo_gym.rod._kernels_contact import penalty
from dlo_gym.rod._kernels_distance import segment_derivatives, segment_distance

ONSET = 0.005  # of the radii


class Remote(NamedTuple):
    """A matrix S K S^T beside the banded one, of k touching nodes.

    Attributes:
        dofs: (3 k,) the nodes' degrees of freedom.
        stiffness: (3 k, 3 k) K.
        answers: (n_dofs, 3 k) A^-1 S with A the banded matrix, once factorised.
        small: (3 k, 3 k) (1 + K S^T A^-1 S)^-1 K, once factorised.
    """

    dofs: np.ndarray
    stiffness: np.ndarray
    answers: np.ndarray
    small: np.ndarray


@njit(cache=True)
def no_remote():
    """A Remote of no nodes."""
    return Remote(np.empty(0, dtype=np.int64), np.empty((0, 0)), np.empty((0, 0)), np.empty((0, 0)))


@njit(cache=True)
def close_pairs(touch, x, reach):
    """Pairs (k, 2) of elements whose axes may come closer than their radii and ``reach`` [m]."""
    n = touch.pair_radius.shape[0]
    count = 0
    pairs = np.empty((64, 2), dtype=np.int64)
    if touch.neighbours == 0:
        return pairs[:0]
    middle, half = np.empty((n, 3)), np.empty(n)
    for e in range(n):
        square = 0.0
        for k in range(3):
            middle[e, k] = 0.5 * (x[e, k] + x[e + 1, k])
            square += (x[e + 1, k] - x[e, k]) ** 2
        half[e] = 0.5 * sqrt(square)
    for e in range(n):
        for f in range(e + touch.neighbours + 1, n):
            limit = half[e] + half[f] + touch.pair_radius[e] + touch.pair_radius[f] + reach
            square = 0.0
            for k in range(3):
                square += (middle[e, k] - middle[f, k]) ** 2
            if square < limit * limit:
                if count == pairs.shape[0]:
                    grown = np.empty((2 * count, 2), dtype=np.int64)
                    grown[:count] = pairs
                    pairs = grown
                pairs[count, 0] = e
                pairs[count, 1] = f
                count += 1
    return pairs[:count]


@njit(cache=True)
def free_fraction_of_pairs(touch, x, x_after, depth):
    """As ``free_fraction``, for the rod against itself: axes stay apart by their radii less
    ``depth`` of them."""
    fraction = 1.0
    largest = 0.0
    for i in range(x.shape[0]):
        square = 0.0
        for k in range(3):
            square += (x_after[i, k] - x[i, k]) ** 2
        largest = max(largest, square)
    pairs = close_pairs(touch, x, 2.0 * sqrt(largest))
    at = np.empty((4, 3))
    way = np.empty((4, 3))
    mean = np.empty(3)
    for row in range(pairs.shape[0]):
        e, f = pairs[row]
        nodes = (e, e + 1, f, f + 1)
        mean[:] = 0.0
        for j in range(4):
            for k in range(3):
                at[j, k] = x[nodes[j], k]
                way[j, k] = x_after[nodes[j], k] - at[j, k]
                mean[k] += 0.25 * way[j, k]
        speed = np.zeros(4)
        for j in range(4):
            for k in range(3):
                speed[j] += (way[j, k] - mean[k]) ** 2
        bound = sqrt(max(speed[0], speed[1])) + sqrt(max(speed[2], speed[3]))
        apart = touch.pair_radius[e] + touch.pair_radius[f]
        gap = segment_distance(at[0], at[1], at[2], at[3])[0] - apart
        floor = min(gap, -depth * apart) - 0.1 * depth * apart
        t = 0.0
        while t * bound < fraction * bound:
            t += max(gap - floor, 0.01 * depth * apart) / bound
            if t >= fraction:
                break
            for j in range(4):
                for k in range(3):
                    at[j, k] = x[nodes[j], k] + t * way[j, k]
            gap = segment_distance(at[0], at[1], at[2], at[3])[0] - apart
            if gap < floor + 0.02 * depth * apart:
                fraction = t
    return fraction


@njit(cache=True)
def add_pairs(touch, x, gradient, matrix):
    """Energy [J] of the rod's contact with itself, and the part of the Hessian beyond the band;
    add to ``gradient`` and ``matrix`` (n_dofs, 17)."""
    energy = 0.0
    candidates = close_pairs(touch, x, 0.0)
    if candidates.shape[0] == 0:
        return energy, no_remote()
    count = 0
    place = np.empty((candidates.shape[0], 3))
    slots = np.full(x.shape[0], -1, dtype=np.int64)
    for row in range(candidates.shape[0]):
        e, f = candidates[row]
        distance, s, t = segment_distance(x[e], x[e + 1], x[f], x[f + 1])
        if distance < touch.pair_radius[e] + touch.pair_radius[f]:
            candidates[count] = candidates[row]
            place[count] = (distance, s, t)
            count += 1
            for node in (e, e + 1, f, f + 1):
                slots[node] = 0
    touching = np.flatnonzero(slots == 0)
    dofs = np.empty(3 * touching.shape[0], dtype=np.int64)
    for j in range(touching.shape[0]):
        slots[touching[j]] = j
        for k in range(3):
            dofs[3 * j + k] = 6 * touching[j] + k
    K = np.zeros((dofs.shape[0], dofs.shape[0]))
    grad, hess = np.empty(12), np.empty((12, 12))
    for row in range(count):
        e, f = candidates[row]
        distance, s, t = place[row]
        apart = touch.pair_radius[e] + touch.pair_radius[f]
        stiffness = 0.5 * (touch.pair_stiffness[e] + touch.pair_stiffness[f])
        potential, first, second = penalty(apart - distance, ONSET * apart)
        energy += stiffness * potential
        segment_derivatives(x[e], x[e + 1], x[f], x[f + 1], distance, s, t, grad, hess)
        nodes = (e, e + 1, f, f + 1)
        for a in range(4):
            for k in range(3):
                gradient[6 * nodes[a] + k] -= stiffness * first * grad[3 * a + k]
        for a in range(12):
            for b in range(12):
                h = stiffness * (second * grad[a] * grad[b] - first * hess[a, b])
                i, j = a // 3, b // 3
                if (i < 2) == (j < 2):
                    r, c = 6 * nodes[i] + a % 3, 6 * nodes[j] + b % 3
                    matrix[r, HALF_BANDWIDTH + c - r] += h
                else:
                    K[3 * slots[nodes[i]] + a % 3, 3 * slots[nodes[j]] + b % 3] += h
    return energy, Remote(dofs, K, np.empty((0, 0)), np.empty((0, 0)))


@njit(cache=True)
def _eliminate(system, columns):
    """Update ``columns`` to system^-1 columns, with partial pivoting; ``system`` is used up."""
    size = system.shape[0]
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(system[i, k]) > abs(system[best, k]):
                best = i
        for j in range(size):
            system[k, j], system[best, j] = system[best, j], system[k, j]
            columns[k, j], columns[best, j] = columns[best, j], columns[k, j]
        for i in range(k + 1, size):
            factor = system[i, k] / system[k, k]
            if factor != 0.0:
                for j in range(k, size):
                    system[i, j] -= factor * system[k, j]
                for j in range(size):
                    columns[i, j] -= factor * columns[k, j]
    for k in range(size - 1, -1, -1):
        for i in range(k + 1, size):
            factor = system[k, i]
            if factor != 0.0:
                for j in range(size):
                    columns[k, j] -= factor * columns[i, j]
        for j in range(size):
            columns[k, j] /= system[k, k]


@njit(cache=True)
def factorise(matrix, remote, first, last):
    """Factorise the banded matrix in place, and what ``remote`` adds; returns the number of
    negative pivots of the former and the factorised Remote."""
    negative = banded.factorise(matrix, first, last)
    size = remote.dofs.shape[0]
    if size == 0:
        return negative, remote
    answers = np.zeros((matrix.shape[0], size))
    for j in range(size):
        if first <= remote.dofs[j] < last:
            answers[remote.dofs[j], j] = 1.0
    banded.solve(matrix, first, last, answers)
    system = np.eye(size)
    compliance = np.empty((size, size))
    for i in range(size):
        inside = first <= remote.dofs[i] < last
        for j in range(size):
            compliance[i, j] = answers[remote.dofs[i], j] if inside else 0.0
    system += remote.stiffness @ compliance
    small = remote.stiffness.copy()
    _eliminate(system, small)
    return negative, Remote(remote.dofs, remote.stiffness, answers, small)


@njit(cache=True)
def solve(matrix, remote, first, last, columns):
    """Update ``columns`` (n_dofs, m) to (A + S K S^T)^-1 columns, given the factors.

    Prescribed rows of ``columns`` are to be zero."""
    banded.solve(matrix, first, last, columns)
    size, width = remote.dofs.shape[0], columns.shape[1]
    if size == 0:
        return
    picked = np.empty((size, width))
    for i in range(size):
        picked[i] = columns[remote.dofs[i]]
    columns -= remote.answers @ (remote.small @ picked)


@njit(cache=True)
def multiply_coupling(matrix, remote, first, last, prescribed, out):
    """Update ``out`` (n_dofs, m): subtract (A + S K S^T)_free,prescribed times ``prescribed``."""
    banded.multiply_coupling(matrix, first, last, prescribed, out)
    size = remote.dofs.shape[0]
    for i in range(size):
        row = remote.dofs[i]
        if not first <= row < last:
            continue
        for j in range(size):
            column = remote.dofs[j]
            if not first <= column < last:
                for c in range(out.shape[1]):
                    out[row, c] -= remote.stiffness[i, j] * prescribed[column, c]


def negative_beyond(remote, first, last):
    """How many more negative eigenvalues A + S K S^T has than A, both symmetric.

    With K = V L V^T, Sylvester's law on [[A, S V], [V^T S^T, -L^-1]] counts the positive ones of
    L^-1 + V^T S^T A^-1 S V less those of L.
    """
    free = (first <= remote.dofs) & (remote.dofs < last)
    if not free.any():
        return 0
    compliance = remote.answers[remote.dofs[free]][:, free]
    values, vectors = np.linalg.eigh(remote.stiffness[np.ix_(free, free)])
    kept = np.abs(values) > 1e-10 * np.abs(values).max()
    V = vectors[:, kept]
    reduced = np.diag(1.0 / values[kept]) + V.T @ compliance @ V
    return int((np.linalg.eigvalsh(reduced) > 0.0).sum() - (values[kept] > 0.0).sum())
