"""Derivatives of a moment, carried along the time steps: exact for the discrete scheme.

A stage ends where its potential's gradient vanishes, so with H its Hessian there

    H d(unknowns) = -(d(gradient)/d(parameters) + d(gradient)/d(b, c) d(b, c) + ... d(clamps))

for every column, be it a parameter, a clamp's motion or a change of the initial state. All else in
a step (``_kernels_dynamics``) is explicit and differentiated as it stands.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import System, assemble
from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH, factorise, multiply_coupling, solve
from dlo_gym.rod._kernels_energy import Ends, quaternion_to_columns
from dlo_gym.rod._kernels_moment import combine, copy_moment
from dlo_gym.rod._kernels_parameters import (
    EXTERNAL_DAMPING,
    LENGTH,
    LOG_EI,
    LOG_GJ,
    LOG_WEIGHT,
    REST_CURVATURE,
    add_stress,
    add_weight,
    change_stress,
    lengthen,
)
from dlo_gym.rod._kernels_rate_tangent import change_accelerations, change_rates, mass_change
from dlo_gym.rod._kernels_rates import accelerations, clamps_at, strain_rates
from dlo_gym.rod._kernels_solve import exact_stress, free_range
from dlo_gym.rod._kernels_stage import BDF_NEW, BDF_OLD, GAMMA, set_stage
from dlo_gym.rod._kernels_tangent import (
    Geometry,
    Tangent,
    add,
    change_director_speeds,
    change_places,
    change_spins,
    change_strains,
    copy_tangent,
    empty_geometry,
    empty_tangent,
    measure,
)


class Carried(NamedTuple):
    """What goes along with the steps, and its scratch space.

    Attributes:
        codes: (m,) which parameter of ``_kernels_parameters`` each column is; -1 if none.
        viscous: whether strains' rates matter to any column.
        weight: (n + 1, 3) of the nodes [N].
        positions: (2, 3, m) change of the clamps' positions at the start of their path [m].
        turns: (2, 3, m) change of their frames there, in themselves [rad].
        velocity: (12, m) change of the path's velocity [m/s, rad/s].
        now, before, middle, base: derivatives of the step's moments.
    """

    codes: np.ndarray
    viscous: bool
    weight: np.ndarray
    positions: np.ndarray
    turns: np.ndarray
    velocity: np.ndarray
    now: Tangent
    before: Tangent
    middle: Tangent
    base: Tangent
    geometry: Geometry
    frames: np.ndarray
    points: np.ndarray
    columns: np.ndarray
    stress: np.ndarray
    rate: np.ndarray
    d_rate: np.ndarray
    spin: np.ndarray
    d_spin: np.ndarray


def empty_carried(n: int, codes: np.ndarray, viscous: bool, weight: np.ndarray) -> Carried:
    m = len(codes)
    return Carried(
        codes, viscous, weight,
        np.zeros((2, 3, m)), np.zeros((2, 3, m)), np.zeros((12, m)),
        empty_tangent(n, m), empty_tangent(n, m), empty_tangent(n, m), empty_tangent(n, m),
        empty_geometry(n), np.zeros((2, 4)), np.zeros((2, 3)), np.zeros((6 * n + 3, m)),
        np.zeros((2 * n + 1, 3, m)), np.zeros((2 * n + 1, 3)), np.zeros((2 * n + 1, 3, m)),
        np.zeros((2, 3)), np.zeros((2, 3, m)),
    )  # fmt: skip


@njit(cache=True)
def _move_clamps(path, time, right_held, carried, tangent):
    """Update the clamps of ``carried`` and ``tangent``, and the held nodes, to ``time`` [s]."""
    n, m = tangent.w.shape[0], tangent.w.shape[2]
    clamps = carried.geometry.clamps
    clamps_at(path, 0.0, carried.points, carried.frames)
    for side in range(2):
        quaternion_to_columns(carried.frames[side], clamps[side])
    turning, J, FJ = carried.velocity, np.empty((3, 3)), np.empty((3, 3))
    for side in range(2):
        base = 6 * side
        r0, r1, r2 = (
            time * path.velocity[base + 3], time * path.velocity[base + 4],
            time * path.velocity[base + 5],
        )  # fmt: skip
        square = r0 * r0 + r1 * r1 + r2 * r2
        angle = sqrt(square)
        # The right Jacobian I - a [r] + b [r]^2 of exp at the turn r
        a, b = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
        if angle > 1e-3:
            a, b = (1.0 - cos(angle)) / square, (angle - sin(angle)) / (square * angle)
        r = (r0, r1, r2)
        for i in range(3):
            for k in range(3):
                J[i, k] = b * r[i] * r[k]
            J[i, i] += 1.0 - b * square
            J[i, (i + 1) % 3] += a * r[(i + 2) % 3]
            J[i, (i + 2) % 3] -= a * r[(i + 1) % 3]
        for i in range(3):
            for k in range(3):
                FJ[i, k] = 0.0
                for j in range(3):
                    FJ[i, k] += time * clamps[side, j, i] * J[j, k]
        node = 0 if side == 0 else 6 * n
        for i in range(3):
            for c in range(m):
                tangent.turns[side, i, c] = (
                    carried.turns[side, i, c]
                    + FJ[i, 0] * turning[base + 3, c]
                    + FJ[i, 1] * turning[base + 4, c]
                    + FJ[i, 2] * turning[base + 5, c]
                )
                if side == 0 or right_held:
                    tangent.unknowns[node + i, c] = (
                        carried.positions[side, i, c] + time * turning[base + i, c]
                    )
    clamps_at(path, time, carried.points, carried.frames)


@njit(cache=True)
def _hold(right_held, carried, tangent):
    """Update the change of the held nodes' speeds to that of the clamps'."""
    n = tangent.w.shape[0]
    tangent.speeds[0] = carried.velocity[:3]
    if right_held:
        tangent.speeds[n] = carried.velocity[6:9]


@njit(cache=True)
def _change_shape(rod, right_held, carried, tangent):
    """Update what follows from the unknowns of ``tangent``, of the shape just measured."""
    change_places(carried.geometry, tangent)
    if carried.viscous:
        change_strains(rod, carried.geometry, right_held, tangent)
        lengthen(rod, carried.geometry, carried.codes, tangent.strain)


@njit(cache=True)
def begin(system, path, ends, now, carried):
    """Update ``carried.now``, of which unknowns, node speeds and spins are given."""
    ends = Ends(carried.frames, ends.right_held)
    _move_clamps(path, 0.0, ends.right_held, carried, carried.now)
    measure(system.rod, now.places, now.q, ends, carried.geometry)
    now.strain[:] = carried.geometry.strain
    _change_shape(system.rod, ends.right_held, carried, carried.now)
    change_director_speeds(carried.geometry.R, now.w, carried.now)
    _hold(ends.right_held, carried, carried.now)


@njit(cache=True)
def _add_inertia(motion, stage, s, base, d_base, places, R, codes, length, columns):
    """Add to ``columns`` what moves the springs of inertia: see ``add_inertia``."""
    n, m = R.shape[0], columns.shape[1]
    shrink = s / (1.0 + motion.external * s)
    centre, weight = stage.inertia.centre, stage.inertia.weight
    heavier, damped = np.empty(m), np.empty(m)
    for c in range(m):
        damped[c] = shrink * shrink if codes[c] == EXTERNAL_DAMPING else 0.0
        heavier[c] = shrink if codes[c] == EXTERNAL_DAMPING else mass_change(codes[c], length)
    for i in range(n + 1):
        for k in range(3):
            W, off, speed = weight[i], centre[i, k] - places[i, k], base.speeds[i, k]
            for c in range(m):
                columns[6 * i + k, c] -= W * (
                    d_base.places[i, k, c] + shrink * d_base.speeds[i, k, c]
                    + heavier[c] * off - damped[c] * speed
                )  # fmt: skip
    for e in range(n):
        theta = 6 * e + 3
        for j in range(2):
            row = n + 1 + 2 * e + j
            W = weight[row]
            for k in range(3):
                off, speed = centre[row, k] - places[row, k], base.speeds[row, k]
                other, out = R[e, k, 1 - j], R[e, k, 2]
                sign = 1.0 if j == 0 else -1.0
                for c in range(m):
                    pull = W * (
                        d_base.places[row, k, c] + shrink * d_base.speeds[row, k, c]
                        + heavier[c] * off - damped[c] * speed
                    )  # fmt: skip
                    columns[theta + 1 - j, c] += sign * out * pull
                    columns[theta + 2, c] -= sign * other * pull


@njit(cache=True)
def _differentiate_stage(
    system, motion, path, s, time, right_held, moment, scratch, tangent, carried, work
):
    """Update ``tangent`` to that of ``moment``, the end of a stage at ``time`` [s]."""
    base, d_base, stage, rod = scratch.base, carried.base, scratch.stage, system.rod
    geometry, columns, codes = carried.geometry, carried.columns, carried.codes
    ends = Ends(carried.frames, right_held)
    n = moment.q.shape[0]
    x = moment.places[: n + 1]
    first, last = free_range(n, right_held)
    length = rod.rest_length.sum()
    set_stage(rod, motion, s, base, ends, stage)
    _move_clamps(path, time, right_held, carried, tangent)
    exact_stress(stage.rod, x, moment.q, work.stress)
    assemble(stage, x, moment.q, ends, work, True)
    factorise(work.band, first, last)
    measure(rod, x, moment.q, ends, geometry)
    moment.strain[:] = geometry.strain
    share = motion.internal / s
    carried.stress[:] = 0.0
    if carried.viscous:
        combine(1.0 / s, moment.strain, -1.0 / s, base.strain, carried.rate)
        _add_viscous(rod, -share, d_base.strain, carried.stress)
    change_stress(rod, geometry, codes, motion.internal, carried.rate, 1.0 + share, carried.stress)
    columns[:] = 0.0
    add_stress(geometry, right_held, carried.stress, columns)
    add_weight(codes, length, carried.weight, columns)
    _add_inertia(motion, stage, s, base, d_base, moment.places, geometry.R, codes, length, columns)
    add(-1.0, columns, 0.0, columns, columns)
    multiply_coupling(work.band, first, last, tangent.unknowns, columns)
    _add_clamp_turns(work.clamp_terms, right_held, -1.0, tangent.turns, columns)
    solve(work.band, first, last, columns)
    tangent.unknowns[first:last] = columns[first:last]
    _change_shape(rod, right_held, carried, tangent)
    add(1.0 / s, tangent.places, -1.0 / s, d_base.places, tangent.speeds)
    _hold(right_held, carried, tangent)


@njit(cache=True)
def _add_viscous(rod, scale, strain, stress):
    """Add ``scale`` times the stress of springs to ``stress`` (2 n + 1, 3, m)."""
    n = rod.shear.shape[0]
    for i in range(2 * n + 1):
        stiffness = rod.shear[i] if i < n else rod.bending[i - n]
        for k in range(3):
            S = scale * stiffness[k]
            for c in range(stress.shape[2]):
                stress[i, k, c] += S * strain[i, k, c]


@njit(cache=True)
def _add_clamp_turns(clamp_terms, right_held, scale, turns, columns):
    """Add to ``columns`` ``scale`` times the gradient's change with the clamps' ``turns``."""
    n_dofs, m = columns.shape
    for side in range(2 if right_held else 1):
        theta = 3 if side == 0 else n_dofs - 6
        for i in range(3):
            for k in range(3):
                term = scale * clamp_terms[side, 1 + i, k]
                for c in range(m):
                    columns[theta + i, c] += term * turns[side, k, c]


@njit(cache=True)
def _multiply(band, unknowns, columns):
    """Add H unknowns to ``columns`` (n_dofs, m), H by its lower band."""
    n_dofs, m = columns.shape
    for j in range(n_dofs):
        diagonal = band[j, 0]
        for c in range(m):
            columns[j, c] += diagonal * unknowns[j, c]
        for k in range(1, min(HALF_BANDWIDTH, n_dofs - 1 - j) + 1):
            value = band[j, k]
            for c in range(m):
                columns[j, c] += value * unknowns[j + k, c]
                columns[j + k, c] += value * unknowns[j, c]


@njit(cache=True)
def _change_gradient(system, motion, moment, ends, scratch, carried, work):
    """Update ``work.gradient`` and its change ``carried.columns`` in the moment before a step,
    and the strains' rates there with theirs."""
    rod, stage, geometry, tangent = system.rod, scratch.stage, carried.geometry, carried.before
    codes, columns, stress, eta = carried.codes, carried.columns, carried.stress, motion.internal
    n, m = moment.q.shape[0], codes.shape[0]
    x = moment.places[: n + 1]
    stress[:] = 0.0
    if carried.viscous:
        strain_rates(rod, x, moment.q, ends, moment.speeds, moment.w, carried.spin, carried.rate)
        change_rates(
            rod, geometry, ends, moment.q, moment.speeds, moment.w, carried.spin, carried.rate,
            codes, tangent, carried.d_spin, carried.d_rate,
        )  # fmt: skip
        _add_viscous(rod, eta, carried.d_rate, stress)
    # S (strain - rest + eta rate) as a shift of the rest strain
    shifted = stage.rod
    combine(1.0, rod.shear, 0.0, rod.shear, shifted.shear)
    combine(1.0, rod.bending, 0.0, rod.bending, shifted.bending)
    combine(0.0, rod.bending, 0.0, rod.bending, shifted.viscous)
    combine(1.0, rod.rest_strain, -eta, carried.rate[:n], shifted.rest_strain)
    combine(1.0, rod.rest_curvature, -eta, carried.rate[n:], shifted.rest_curvature)
    exact_stress(shifted, x, moment.q, work.stress)
    assemble(System(shifted, system.inertia), x, moment.q, ends, work, True)
    change_stress(rod, geometry, codes, eta, carried.rate, 1.0, stress)
    columns[:] = 0.0
    add_stress(geometry, ends.right_held, stress, columns)
    add_weight(codes, rod.rest_length.sum(), carried.weight, columns)
    _multiply(work.band, tangent.unknowns, columns)
    _add_clamp_turns(work.clamp_terms, ends.right_held, 1.0, tangent.turns, columns)
    # H is d(gradient) in frames that turn along; (g x theta) / 2 is what they turn.
    for e in range(n):
        theta = 6 * e + 3
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            gj, gk = 0.5 * work.gradient[theta + j], 0.5 * work.gradient[theta + k]
            for c in range(m):
                columns[theta + i, c] += (
                    gj * tangent.unknowns[theta + k, c] - gk * tangent.unknowns[theta + j, c]
                )


@njit(cache=True)
def _differentiate_trapezoid_base(
    system, motion, path, s, time, right_held, scratch, carried, work
):
    """Update ``scratch.base`` and its change to b = y + s v and c = v + s a(y)."""
    before, base, d_before, d_base = scratch.before, scratch.base, carried.before, carried.base
    geometry, codes = carried.geometry, carried.codes
    m = codes.shape[0]
    ends = Ends(carried.frames, right_held)
    _move_clamps(path, time, right_held, carried, d_before)
    measure(system.rod, before.places, before.q, ends, geometry)
    for side in range(2):
        F, omega = geometry.clamps[side], 6 * side + 3
        spin, turns = carried.spin[side], d_before.turns[side]
        for k in range(3):
            spin[k] = 0.0
            for j in range(3):
                spin[k] += F[j, k] * path.velocity[omega + j]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            for c in range(m):
                carried.d_spin[side, k, c] = (
                    F[0, k] * carried.velocity[omega, c]
                    + F[1, k] * carried.velocity[omega + 1, c]
                    + F[2, k] * carried.velocity[omega + 2, c]
                    + spin[i] * turns[j, c] - spin[j] * turns[i, c]
                )  # fmt: skip
    _change_gradient(system, motion, before, ends, scratch, carried, work)
    accelerations(motion, before.q, before.w, before.speeds, work.gradient, base.speeds)
    change_accelerations(
        motion, geometry.R, before.w, before.speeds, work.gradient, codes,
        system.rod.rest_length.sum(), d_before, carried.columns, d_base.speeds,
    )  # fmt: skip
    combine(1.0, before.speeds, s, base.speeds, base.speeds)
    combine(1.0, before.places, s, before.speeds, base.places)
    add(1.0, d_before.speeds, s, d_base.speeds, d_base.speeds)
    add(1.0, d_before.places, s, d_before.speeds, d_base.places)
    if carried.viscous:
        combine(1.0, before.strain, s, carried.rate, base.strain)
        add(1.0, d_before.strain, s, carried.d_rate, d_base.strain)


@njit(cache=True)
def carry(system, motion, path, order, time, h, right_held, now, scratch, carried, work):
    """Update ``carried.now`` from ``time`` to ``time + h``, over a step from ``scratch.before``
    (through ``scratch.middle``) to ``now``."""
    before, middle, base = scratch.before, scratch.middle, scratch.base
    d_before, d_middle, d_base, d_now = carried.before, carried.middle, carried.base, carried.now
    copy_tangent(d_now, d_before)
    s = h if order == 1 else 0.5 * GAMMA * h
    if order == 1:
        copy_moment(before, base)
        copy_tangent(d_before, d_base)
    else:
        _differentiate_trapezoid_base(
            system, motion, path, s, time, right_held, scratch, carried, work
        )
        _differentiate_stage(
            system, motion, path, s, time + GAMMA * h, right_held, middle, scratch, d_middle,
            carried, work,
        )  # fmt: skip
        combine(BDF_NEW, middle.places, -BDF_OLD, before.places, base.places)
        combine(BDF_NEW, middle.speeds, -BDF_OLD, before.speeds, base.speeds)
        combine(BDF_NEW, middle.strain, -BDF_OLD, before.strain, base.strain)
        add(BDF_NEW, d_middle.places, -BDF_OLD, d_before.places, d_base.places)
        add(BDF_NEW, d_middle.speeds, -BDF_OLD, d_before.speeds, d_base.speeds)
        add(BDF_NEW, d_middle.strain, -BDF_OLD, d_before.strain, d_base.strain)
    _differentiate_stage(
        system, motion, path, s, time + h, right_held, now, scratch, d_now, carried, work
    )
    # The directors' speeds that the stage ended with
    combine(1.0 / s, now.places, -1.0 / s, base.places, base.speeds)
    R = carried.geometry.R
    change_spins(R, d_now.unknowns, base.speeds, d_now.speeds, d_now.w)
    change_director_speeds(R, now.w, d_now)


@njit(cache=True)
def _add_energy_change(system, motion, sign, moment, tangent, ends, carried, work, out):
    """Add to ``out`` (m,) ``sign`` times the change of stored and kinetic energy [J]."""
    rod, codes, strain, weight = system.rod, carried.codes, moment.strain, carried.weight
    n, m = moment.q.shape[0], codes.shape[0]
    x = moment.places[: n + 1]
    length = rod.rest_length.sum()
    assemble(system, x, moment.q, ends, work, False)
    for j in range(6 * n + 3):
        slope = sign * work.gradient[j]
        for c in range(m):
            out[c] += slope * tangent.unknowns[j, c]
    for side in range(2 if ends.right_held else 1):
        for k in range(3):
            slope = sign * work.clamp_terms[side, 0, k]
            for c in range(m):
                out[c] += slope * tangent.turns[side, k, c]
    kinetic = _add_kinetic_change(motion, sign, moment, tangent, out)
    for c in range(m):
        code = codes[c]
        total = mass_change(code, length) * kinetic
        if code in (LENGTH, LOG_WEIGHT):
            share = 1.0 if code == LOG_WEIGHT else 1.0 / length
            for i in range(n + 1):
                for k in range(3):
                    total -= share * weight[i, k] * x[i, k]
        if code == LENGTH:
            for e in range(n):
                for k in range(3):
                    gamma, span = strain[e, k], strain[e, k] + (1.0 if k == 2 else 0.0)
                    less = gamma * (0.5 * gamma - span)
                    total += rod.rest_length[e] / length * rod.shear[e, k] * less
        for i in range(n + 1 if ends.right_held else n):
            for k in range(3):
                stiffness = rod.voronoi_length[i] * rod.bending[i, k]
                bent = strain[n + i, k] - rod.rest_curvature[i, k]
                if code == (LOG_GJ if k == 2 else LOG_EI):
                    total += 0.5 * stiffness * bent * bent
                elif code == REST_CURVATURE + k:
                    total -= stiffness * bent
                elif code == LENGTH:
                    total += stiffness / length * bent * (0.5 * bent - strain[n + i, k])
        out[c] += sign * total


@njit(cache=True)
def _add_kinetic_change(motion, sign, moment, tangent, out):
    """Add ``sign`` times the change of kinetic energy at given masses; returns the energy [J]."""
    n, m = moment.w.shape[0], out.shape[0]
    kinetic = 0.0
    for i in range(n + 1):
        for k in range(3):
            momentum = motion.mass[i] * moment.speeds[i, k]
            kinetic += 0.5 * momentum * moment.speeds[i, k]
            for c in range(m):
                out[c] += sign * momentum * tangent.speeds[i, k, c]
    for e in range(n):
        for k in range(3):
            momentum = motion.mass[n + 1 + 2 * e] * moment.w[e, k] * (2.0 if k == 2 else 1.0)
            kinetic += 0.5 * momentum * moment.w[e, k]
            for c in range(m):
                out[c] += sign * momentum * tangent.w[e, k, c]
    return kinetic


@njit(cache=True)
def share_gain(system, motion, gain, kinetic, noise, ends, now, before, carried, work):
    """Update ``carried.now`` for the velocities' scale sqrt(1 - gain / kinetic), not yet applied to
    ``now``; a gain within the ``noise`` [J] of the solver counts as given."""
    d_now, m = carried.now, carried.codes.shape[0]
    scale = sqrt(max(0.0, 1.0 - gain / kinetic)) if kinetic > 0.0 else 0.0
    change = np.zeros(m)  # of the scale
    if gain > noise and scale > 0.0:
        d_gain, d_kinetic = np.zeros(m), np.zeros(m)
        _add_energy_change(system, motion, 1.0, now, d_now, ends, carried, work, d_gain)
        _add_energy_change(
            system, motion, -1.0, before, carried.before, ends, carried, work, d_gain
        )
        _add_kinetic_change(motion, 1.0, now, d_now, d_kinetic)
        for c in range(m):
            heavier = mass_change(carried.codes[c], system.rod.rest_length.sum())
            lost = d_gain[c] - gain * (d_kinetic[c] / kinetic + heavier)
            change[c] = -0.5 * lost / (scale * kinetic)
    for i in range(now.speeds.shape[0]):
        for k in range(3):
            for c in range(m):
                speed = scale * d_now.speeds[i, k, c]
                d_now.speeds[i, k, c] = speed + change[c] * now.speeds[i, k]
    for e in range(now.w.shape[0]):
        for k in range(3):
            for c in range(m):
                d_now.w[e, k, c] = scale * d_now.w[e, k, c] + change[c] * now.w[e, k]
