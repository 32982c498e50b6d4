"""Newton's method on the rod's energy: following a moving clamp, and settling from afar."""

from math import cos, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import assemble
from dlo_gym.rod._kernels_banded import (
    factorise,
    multiply_coupling,
    shift_diagonal,
    solve,
    solve_one,
)
from dlo_gym.rod._kernels_quaternions import rotate

CONVERGED, STALLED, UNSTABLE = 0, 1, 2

LARGEST_TURN = 0.7  # of an element in one Newton step [rad]; beyond, the quadratic model is void
NEWTON_STEPS = 16
NEUTRAL = 1e-9  # damping below which a negative curvature is rounding: a helix may slide along


class Limits(NamedTuple):
    """When a solve is over: every free residual is below ``residual`` times its scale.

    Attributes:
        residual: [-].
        force: scale of forces on nodes [N].
        torque: scale of torques on elements [N m].
    """

    residual: float
    force: float
    torque: float


@njit(cache=True)
def free_range(n, right_held):
    """The unknowns that are free: all but the held end nodes' positions."""
    return 3, 6 * n if right_held else 6 * n + 3


@njit(cache=True)
def _rotate_back(w, a, b, c, t0, t1, t2):
    """R^T t for the rotation R of the unit quaternion (w, a, b, c)."""
    u0, u1, u2 = 2.0 * (b * t2 - c * t1), 2.0 * (c * t0 - a * t2), 2.0 * (a * t1 - b * t0)
    return (
        t0 - w * u0 + b * u2 - c * u1,
        t1 - w * u1 + c * u0 - a * u2,
        t2 - w * u2 + a * u1 - b * u0,
    )


@njit(cache=True)
def exact_stress(rod, x, q, stress):
    """Update ``stress`` (n, 3) with S gamma [N] of the present shape."""
    for e in range(q.shape[0]):
        w, a, b, c = q[e, 0], q[e, 1], q[e, 2], q[e, 3]
        t0 = (x[e + 1, 0] - x[e, 0]) / rod.rest_length[e]
        t1 = (x[e + 1, 1] - x[e, 1]) / rod.rest_length[e]
        t2 = (x[e + 1, 2] - x[e, 2]) / rod.rest_length[e]
        p0, p1, p2 = _rotate_back(w, a, b, c, t0, t1, t2)
        stress[e, 0] = rod.shear[e, 0] * (p0 - rod.rest_strain[e, 0])
        stress[e, 1] = rod.shear[e, 1] * (p1 - rod.rest_strain[e, 1])
        stress[e, 2] = rod.shear[e, 2] * (p2 - 1.0 - rod.rest_strain[e, 2])


@njit(cache=True)
def apply_step(rod, x, q, step, scale, stress):
    """Update shape by ``scale * step`` and ``stress`` to its linear prediction at the new shape."""
    n = q.shape[0]
    exact_stress(rod, x, q, stress)
    for e in range(n):
        w, a, b, c = q[e, 0], q[e, 1], q[e, 2], q[e, 3]
        length = rod.rest_length[e]
        base = 6 * e
        # d gamma = (R^T d(t) + p x theta) / l
        t0, t1, t2 = x[e + 1, 0] - x[e, 0], x[e + 1, 1] - x[e, 1], x[e + 1, 2] - x[e, 2]
        p0, p1, p2 = _rotate_back(w, a, b, c, t0, t1, t2)
        d0, d1, d2 = _rotate_back(
            w, a, b, c,
            step[base + 6] - step[base], step[base + 7] - step[base + 1],
            step[base + 8] - step[base + 2],
        )  # fmt: skip
        r0, r1, r2 = step[base + 3], step[base + 4], step[base + 5]
        factor = scale / length
        stress[e, 0] += rod.shear[e, 0] * factor * (d0 + p1 * r2 - p2 * r1)
        stress[e, 1] += rod.shear[e, 1] * factor * (d1 + p2 * r0 - p0 * r2)
        stress[e, 2] += rod.shear[e, 2] * factor * (d2 + p0 * r1 - p1 * r0)
    for i in range(n + 1):
        for k in range(3):
            x[i, k] += scale * step[6 * i + k]
    for e in range(n):
        rotate(q[e], scale * step[6 * e + 3], scale * step[6 * e + 4], scale * step[6 * e + 5])


@njit(cache=True)
def copy(source, out):
    """Update ``out`` (m, k) with ``source`` of the same shape."""
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            out[i, k] = source[i, k]


@njit(cache=True)
def _largest_turn(step, n):
    largest = 0.0
    for e in range(n):
        s = 6 * e + 3
        largest = max(largest, step[s] ** 2 + step[s + 1] ** 2 + step[s + 2] ** 2)
    return sqrt(largest)


@njit(cache=True)
def _residual(gradient, first, last, limits):
    """The largest free component of the gradient, relative to the limits' scales."""
    largest = 0.0
    for j in range(first, last):
        scale = limits.force if (j // 3) % 2 == 0 else limits.torque
        size = abs(gradient[j]) / scale
        if not size <= largest:  # a NaN counts as large
            largest = size
    return largest


@njit(cache=True)
def linearise(system, x, q, ends, work):
    """Factorise the Hessian, with ``work``'s stress, at a solution.

    Returns (potential, number of negative pivots).
    """
    energy = assemble(system, x, q, ends, work, True)
    first, last = free_range(q.shape[0], ends.right_held)
    return energy, factorise(work.band, first, last)


@njit(cache=True)
def sensitivity(work, clamp_rotations, right_held, columns):
    """Update ``columns`` (n_dofs, 12) with d(unknowns)/d(clamp twists) at a factorised state.

    Twists are in world axes, translation then rotation about the clamp, left then right.
    """
    band, clamp_terms = work.band, work.clamp_terms
    n_dofs = columns.shape[0]
    n = (n_dofs - 3) // 6
    first, last = free_range(n, right_held)
    prescribed = np.zeros((n_dofs, 12))
    columns[:] = 0.0
    for k in range(3):
        prescribed[k, k] = 1.0
        if right_held:
            prescribed[6 * n + k, 6 + k] = 1.0
    multiply_coupling(band, first, last, prescribed, columns)
    for side in range(2 if right_held else 1):
        theta = 3 if side == 0 else 6 * n - 3
        for i in range(3):
            for j in range(3):
                coupling = 0.0
                for k in range(3):  # a turn w in world is R^T w in the clamp's frame
                    coupling += clamp_terms[side, 1 + i, k] * clamp_rotations[side, j, k]
                columns[theta + i, 6 * side + 3 + j] -= coupling
    solve(band, first, last, columns)
    for k in range(3):
        columns[k, k] = 1.0
        if right_held:
            columns[6 * n + k, 6 + k] = 1.0


@njit(cache=True, inline="always")
def follow(system, x, q, ends, twist, clamp_rotations, limits, work):
    """Move the clamps by ``twist`` (12,) and update the shape to the new equilibrium.

    On entry ``band`` holds the factors at the present equilibrium. The first step is their
    linear answer to the moving clamps; then Newton's method with predicted stresses.
    ``ends`` must already hold the new frames. Returns a status and the potential [J].
    """
    gradient, band, clamp_terms = work.gradient, work.band, work.clamp_terms
    right_held = ends.right_held
    n = q.shape[0]
    n_dofs = 6 * n + 3
    first, last = free_range(n, right_held)
    step = np.zeros(n_dofs)
    prescribed = np.zeros((n_dofs, 1))
    for k in range(3):
        prescribed[k, 0] = twist[k]
        if right_held:
            prescribed[6 * n + k, 0] = twist[6 + k]
    for j in range(first, last):
        step[j] = -gradient[j]
    multiply_coupling(band, first, last, prescribed, step.reshape((n_dofs, 1)))
    for side in range(2 if right_held else 1):
        theta = 3 if side == 0 else 6 * n - 3
        for k in range(3):
            turn = 0.0
            for j in range(3):
                turn += clamp_rotations[side, j, k] * twist[6 * side + 3 + j]
            for i in range(3):
                step[theta + i] -= clamp_terms[side, 1 + i, k] * turn
    for count in range(NEWTON_STEPS):
        solve_one(band, first, last, step)
        if count == 0:
            for j in range(n_dofs):
                if j < first or j >= last:
                    step[j] = prescribed[j, 0]
        turn = _largest_turn(step, n)
        if not turn < LARGEST_TURN:
            return STALLED, 0.0
        apply_step(system.rod, x, q, step, 1.0, work.stress)
        energy = assemble(system, x, q, ends, work, True)
        negative = factorise(band, first, last)
        if _residual(gradient, first, last, limits) < limits.residual:
            return (UNSTABLE if negative else CONVERGED), energy
        for j in range(n_dofs):
            step[j] = -gradient[j] if first <= j < last else 0.0
    return STALLED, 0.0


@njit(cache=True, inline="always")
def minimise(system, x, q, ends, limits, max_steps, work):
    """Descend the potential from any shape to a stable equilibrium (Levenberg's damped Newton).

    Every step lowers the energy; the Hessian, with stresses predicted as in ``follow``, is shifted
    until it is positive definite. Leaves ``band`` factorised at the solution. Returns a status, the
    potential [J] and the steps taken.
    """
    stress, gradient, band = work.stress, work.gradient, work.band
    tolerance = limits.residual
    n = q.shape[0]
    n_dofs = 6 * n + 3
    first, last = free_range(n, ends.right_held)
    rotation = limits.torque * n
    translation = rotation / system.rod.rest_length[0] ** 2
    damping, scale, saddle = 1e-3, 0.0, False
    step = np.zeros(n_dofs)
    exact_stress(system.rod, x, q, stress)
    x_kept, q_kept, stress_kept = x.copy(), q.copy(), stress.copy()
    undamped, downhill = np.zeros_like(band), np.zeros(n_dofs)
    energy, count, refused = np.inf, 0, 0
    while count <= max_steps and refused < 60:
        # The shape is a trial: keep it if it is lower, else return to the last and damp more.
        trial = assemble(system, x, q, ends, work, True)
        if trial < energy + 1e-13 * abs(energy) or saddle:
            energy, refused = trial, 0
            copy(x, x_kept)
            copy(q, q_kept)
            copy(stress, stress_kept)
            copy(band, undamped)
            for j in range(n_dofs):
                downhill[j] = -gradient[j]
            if scale == 1.0:
                damping /= 5.0
            saddle = False
            if _residual(gradient, first, last, limits) < tolerance:
                shift_diagonal(band, first, last, NEUTRAL * translation, NEUTRAL * rotation)
                if factorise(band, first, last) == 0:
                    copy(undamped, band)
                    factorise(band, first, last)
                    return CONVERGED, energy, count
                saddle = True  # leave it in a fixed, generic direction
                for j in range(n_dofs):
                    downhill[j] = 1e-3 * limits.torque * cos(1.0 + 0.7 * j)
            count += 1
        else:
            copy(x_kept, x)
            copy(q_kept, q)
            copy(stress_kept, stress)
            damping = max(4.0 * damping, 1e-9)
            refused += 1
        negative = 1
        while negative > 0 and refused < 60:
            copy(undamped, band)
            shift_diagonal(band, first, last, damping * translation, damping * rotation)
            negative = factorise(band, first, last)
            if negative > 0:
                damping = max(4.0 * damping, 1e-9)
                refused += 1
        for j in range(n_dofs):
            step[j] = downhill[j] if first <= j < last else 0.0
        solve_one(band, first, last, step)
        scale = min(1.0, 0.5 * LARGEST_TURN / max(_largest_turn(step, n), 1e-300))
        apply_step(system.rod, x, q, step, scale, stress)
        if scale < 1.0:
            exact_stress(system.rod, x, q, stress)
    return STALLED, energy, count - 1
