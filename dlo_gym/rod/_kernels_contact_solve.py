"""Newton's method on the rod's energy with contact: following moving clamps, and settling.

As ``_kernels_solve``, with three differences: the tangent is unsymmetric where the rod slides, a
step ends before it would take the rod through an obstacle or itself, and friction descends with
normal forces that lag behind, for only then it has a potential.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import assemble
from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH
from dlo_gym.rod._kernels_contact import (
    Hold,
    Touch,
    add_obstacles,
    free_fraction,
    update_anchors,
)
from dlo_gym.rod._kernels_distance import ObstacleArrays
from dlo_gym.rod._kernels_self_contact import (
    add_pairs,
    factorise,
    free_fraction_of_pairs,
    multiply_coupling,
    no_remote,
    solve,
)
from dlo_gym.rod._kernels_solve import (
    CONVERGED,
    LARGEST_TURN,
    STALLED,
    _largest_turn,
    _residual,
    apply_step,
    exact_stress,
    free_range,
)
from dlo_gym.rod._kernels_unsymmetric import expand

BLOCKED = 3  # the linear answer to the clamps' motion goes through an obstacle

DEPTH = 0.3  # of the radius: what a Newton step may overlap
NEWTON_STEPS = 40
PATIENCE = 5  # steps without halving the least residual, before Newton's method is given up


class Contact(NamedTuple):
    """All that acts between the rod, the obstacles and itself."""

    touch: Touch
    obstacles: ObstacleArrays
    hold: Hold


@njit(cache=True)
def evaluate(system, x, q, ends, contact, work, matrix):
    """Potential [J] with contact, and its Hessian beyond the band; update ``work``'s derivatives
    and ``matrix`` (n_dofs, 17), the tangent by rows (``_kernels_unsymmetric``)."""
    energy = assemble(system, x, q, ends, work, True)
    expand(work.band, matrix)
    hold, gradient = contact.hold, work.gradient
    energy += add_obstacles(contact.touch, contact.obstacles, hold, x, gradient, matrix)
    more, remote = add_pairs(contact.touch, x, gradient, matrix)
    return energy + more, remote


@njit(cache=True)
def linearise(system, x, q, ends, contact, work, matrix):
    """Factorise the tangent; returns (potential, number of negative pivots, what is beyond the
    band)."""
    exact_stress(system.rod, x, q, work.stress)
    energy, remote = evaluate(system, x, q, ends, contact, work, matrix)
    first, last = free_range(q.shape[0], ends.right_held)
    negative, remote = factorise(matrix, remote, first, last)
    return energy, negative, remote


@njit(cache=True)
def _answer(work, matrix, remote, clamp_rotations, right_held, twists, columns):
    """Update ``columns`` (n_dofs, m): with minus the gradient, or zeros, on entry, the linearised
    rod's answer to clamp ``twists`` (12, m)."""
    n_dofs, width = columns.shape
    n = (n_dofs - 3) // 6
    first, last = free_range(n, right_held)
    prescribed = np.zeros((n_dofs, width))
    for k in range(3):
        prescribed[k] = twists[k]
        if right_held:
            prescribed[6 * n + k] = twists[6 + k]
    multiply_coupling(matrix, remote, first, last, prescribed, columns)
    for side in range(2 if right_held else 1):
        theta = 3 if side == 0 else 6 * n - 3
        for i in range(3):
            for j in range(3):
                coupling = 0.0
                for k in range(3):  # a turn w in world is R^T w in the clamp's frame
                    coupling += work.clamp_terms[side, 1 + i, k] * clamp_rotations[side, j, k]
                for c in range(width):
                    columns[theta + i, c] -= coupling * twists[6 * side + 3 + j, c]
    solve(matrix, remote, first, last, columns)
    columns += prescribed


@njit(cache=True)
def sensitivity(work, matrix, remote, clamp_rotations, right_held, columns):
    """Update ``columns`` (n_dofs, 12) with d(unknowns)/d(clamp twists) at a factorised state."""
    columns[:] = 0.0
    _answer(work, matrix, remote, clamp_rotations, right_held, np.eye(12), columns)


@njit(cache=True)
def _free(contact, x, step):
    """The part of ``step`` (n_dofs, 1) that the rod can take before it overlaps too much."""
    after = x.copy()
    for i in range(x.shape[0]):
        for k in range(3):
            after[i, k] += step[6 * i + k, 0]
    obstacles = contact.obstacles
    fraction = free_fraction(contact.touch, obstacles, obstacles, x, after, DEPTH)
    if contact.touch.neighbours > 0:
        fraction = min(fraction, free_fraction_of_pairs(contact.touch, x, after, DEPTH))
    return fraction


@njit(cache=True)
def step_within_reach(system, x, q, ends, contact, step, work):
    """Update the shape by as much of ``step`` (n_dofs, 1) as goes through nothing, and
    ``work.stress`` to that of the new shape."""
    apply_step(system.rod, x, q, step[:, 0], _free(contact, x, step), work.stress)
    exact_stress(system.rod, x, q, work.stress)


@njit(cache=True)
def predict(system, x, q, ends, contact, twist, clamp_rotations, work, matrix, remote):
    """Take the linearised rod's answer to a ``twist`` (12,) of the clamps, from the factors at the
    present state; BLOCKED, and no step, if it would go through something."""
    n_dofs = work.gradient.shape[0]
    first, last = free_range(q.shape[0], ends.right_held)
    step = np.zeros((n_dofs, 1))
    for j in range(first, last):
        step[j, 0] = -work.gradient[j]
    twists = twist.reshape(12, 1)
    _answer(work, matrix, remote, clamp_rotations, ends.right_held, twists, step)
    if not _largest_turn(step[:, 0], q.shape[0]) < LARGEST_TURN:
        return STALLED
    if _free(contact, x, step) < 1.0:
        return BLOCKED
    apply_step(system.rod, x, q, step[:, 0], 1.0, work.stress)
    return CONVERGED


@njit(cache=True)
def newton(system, x, q, ends, contact, limits, max_steps, work, matrix):
    """Newton's method from a shape near the solution, with predicted stresses.

    ``work.stress`` holds the prediction of the step before, or that of the shape. At the solution
    friction takes hold anew. Returns a status and the steps taken.
    """
    n = q.shape[0]
    first, last = free_range(n, ends.right_held)
    step = np.zeros((6 * n + 3, 1))
    least, idle, count = np.inf, 0, 0
    for count in range(max_steps + 1):
        _, remote = evaluate(system, x, q, ends, contact, work, matrix)
        residual = _residual(work.gradient, first, last, limits)
        if residual < limits.residual:
            update_anchors(contact.touch, contact.obstacles, x, contact.hold.anchors)
            return CONVERGED, count
        idle = 0 if residual < 0.5 * least else idle + 1
        least = min(least, residual)
        if idle > PATIENCE or count == max_steps:
            break
        _, remote = factorise(matrix, remote, first, last)
        step[:] = 0.0
        for j in range(first, last):
            step[j, 0] = -work.gradient[j]
        solve(matrix, remote, first, last, step)
        turn = _largest_turn(step[:, 0], n)
        if not turn < 4.0 * LARGEST_TURN:
            break
        step *= min(1.0, LARGEST_TURN / max(turn, 1e-300))
        apply_step(system.rod, x, q, step[:, 0], _free(contact, x, step), work.stress)
    return STALLED, count


@njit(cache=True)
def descend(system, x, q, ends, contact, limits, max_steps, work, matrix):
    """Descend the potential from any shape (Levenberg's damped Newton), with lagging friction and
    predicted stresses. Returns a status and the steps taken.
    """
    n = q.shape[0]
    n_dofs = 6 * n + 3
    first, last = free_range(n, ends.right_held)
    rotation = limits.torque * n
    translation = rotation / system.rod.rest_length[0] ** 2
    damping = 1e-3
    gradient = work.gradient
    step = np.zeros((n_dofs, 1))
    x_kept, q_kept, gradient_kept = x.copy(), q.copy(), gradient.copy()
    undamped = np.empty_like(matrix)
    remote = no_remote()
    energy, whole, count = np.inf, False, 0
    for _ in range(4 * max_steps):
        # The shape is a trial: keep it if it is lower, else return to the last and damp more.
        if not whole:
            exact_stress(system.rod, x, q, work.stress)
        trial, remote_trial = evaluate(system, x, q, ends, contact, work, matrix)
        if trial < energy + 1e-13 * abs(energy):
            count += 1
            damping = damping / 5.0 if whole else damping
            x_kept[:] = x
            q_kept[:] = q
            gradient_kept[:] = gradient
            undamped[:] = matrix
            energy, remote = trial, remote_trial
            if _residual(gradient, first, last, limits) < limits.residual:
                return CONVERGED, count
            if count > max_steps:
                break
        else:
            x[:] = x_kept
            q[:] = q_kept
            gradient[:] = gradient_kept
            damping = max(4.0 * damping, 1e-9)
        while damping < 1e12:
            matrix[:] = undamped
            for j in range(first, last):
                matrix[j, HALF_BANDWIDTH] += damping * (
                    translation if (j // 3) % 2 == 0 else rotation
                )
            negative, factors = factorise(matrix, remote, first, last)
            if negative == 0:
                step[:] = 0.0
                for j in range(first, last):
                    step[j, 0] = -gradient[j]
                solve(matrix, factors, first, last, step)
                slope = 0.0
                for j in range(first, last):
                    slope += step[j, 0] * gradient[j]
                if slope < 0.0:
                    break
            damping = max(4.0 * damping, 1e-9)
        if not damping < 1e12:
            break
        turn = _largest_turn(step[:, 0], n)
        step *= min(1.0, 0.5 * LARGEST_TURN / max(turn, 1e-300))
        free = _free(contact, x, step)
        whole = turn <= 0.5 * LARGEST_TURN and free == 1.0
        apply_step(system.rod, x, q, step[:, 0], free, work.stress)
    x[:] = x_kept
    q[:] = q_kept
    return STALLED, count
