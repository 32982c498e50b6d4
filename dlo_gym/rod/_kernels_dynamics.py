"""Implicit time steps: Euler's (order 1) and TR-BDF2 (order 2; Bank et al. 1985).

Every stage has one form. With y the places of nodes and directors, V their speeds and s the
stage's implicit length, V = (Y - b) / s and V = c + s a(Y), so Y minimises

    M / (2 s^2) |Y - b - s c|^2 + E(Y)

    Euler        s = h,      b = y,                c = v
    trapezoid    s = g h/2,  b = y + s v,          c = v + s a(y)      to t + g h, g = 2 - sqrt 2
    BDF2         s = g h/2,  b = p Y_g - r y,      c = p V_g - r v     to t + h

TR-BDF2 is L-stable, and its stages are of order 2: stiff stretch, and the directors' constraint,
which one-step methods of lower stage order answer with order 1, keep the full order. Damping stays
a quadratic: external -c m V shifts M's springs, and the stress S eta d(strain)/dt of a Kelvin-Voigt
rod is a stiffness S eta / s that rests at the strain's own b. So is a share of the stiffness that
relaxes towards the present curvature. Plastic curvature flows within each stage.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import System, assemble
from dlo_gym.rod._kernels_banded import factorise
from dlo_gym.rod._kernels_energy import (
    flow_plastically,
    quaternion_to_columns,
    strains,
)
from dlo_gym.rod._kernels_moment import (
    bent,
    combine,
    copy_moment,
    empty_moment,
    empty_scratch,
    flow,
    hidden_energy,
    hold,
    inelastic,
    set_material,
)
from dlo_gym.rod._kernels_rates import (
    accelerations,
    angular_velocities,
    clamps_at,
    director_velocities,
    directors,
    kinetic_energy,
    strain_rates,
)
from dlo_gym.rod._kernels_sensitivity import begin, carry, share_gain
from dlo_gym.rod._kernels_solve import (
    CONVERGED,
    STALLED,
    Limits,
    exact_stress,
    follow,
    free_range,
)
from dlo_gym.rod._kernels_stage import BDF_NEW, BDF_OLD, GAMMA, set_stage

ERROR = 2.0 * abs(-3.0 * GAMMA**2 + 4.0 * GAMMA - 2.0) / (12.0 * (2.0 - GAMMA))

SMALLEST_STEP = 1.0 / 1024.0  # of the step that was asked for
LARGEST_GAIN = 0.02  # of energy in a step, relative to the kinetic energy: beyond, it is halved
LARGEST_IMBALANCE = 0.2  # of energy against the work of moving clamps


class Plan(NamedTuple):
    """How to step: ``steps`` equal steps over ``duration`` [s] unless they must be shorter.

    Attributes:
        duration: [s].
        steps: how many, at least 1.
        order: 1 or 2.
        tolerance: on the error estimate of a node's position in one step [m]; 0 for none.
    """

    duration: float
    steps: int
    order: int
    tolerance: float


@njit(cache=True)
def follow_clamps(path, time, ends, now, scratch):
    """Update ``ends`` to the clamps at ``time`` and ``scratch`` to their motion from ``now``."""
    n = now.q.shape[0]
    twist, clamps, former = scratch.twist, scratch.clamps, scratch.frames
    for side in range(2):
        quaternion_to_columns(ends.frames[side], scratch.rotations[side])
        for k in range(4):
            former[side, k] = ends.frames[side, k]
    clamps_at(path, time, clamps, ends.frames)
    for side in range(2 if ends.right_held else 1):
        node, base = (0 if side == 0 else n), 6 * side
        a, b = former[side], ends.frames[side]
        sign = 2.0 if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] >= 0.0 else -2.0
        twist[base + 3] = sign * (b[1] * a[0] - b[0] * a[1] - b[2] * a[3] + b[3] * a[2])
        twist[base + 4] = sign * (b[2] * a[0] - b[0] * a[2] - b[3] * a[1] + b[1] * a[3])
        twist[base + 5] = sign * (b[3] * a[0] - b[0] * a[3] - b[1] * a[2] + b[2] * a[1])
        for k in range(3):
            twist[base + k] = clamps[side, k] - now.places[node, k]


@njit(cache=True)
def _solve_stage(system, motion, path, s, time, ends, now, scratch, limits, work):
    """Update ``now`` from the shape it holds to the end of a stage at ``time`` [s]."""
    n = now.q.shape[0]
    base, stage = scratch.base, scratch.stage
    x = now.places[: n + 1]
    set_stage(system.rod, motion, s, base, ends, stage)
    exact_stress(stage.rod, x, now.q, work.stress)
    assemble(stage, x, now.q, ends, work, True)
    first, last = free_range(n, ends.right_held)
    factorise(work.band, first, last)
    follow_clamps(path, time, ends, now, scratch)
    # Rounding errors grow with the stiffness.
    residual = limits.residual * (1.0 + motion.internal / s)
    looser = Limits(residual, limits.force, limits.torque)
    status, _ = follow(stage, x, now.q, ends, scratch.twist, scratch.rotations, looser, work)
    for k in range(3):
        x[0, k] = scratch.clamps[0, k]
        if ends.right_held:
            x[n, k] = scratch.clamps[1, k]
    directors(now.q, now.places)
    combine(1.0 / s, now.places, -1.0 / s, base.places, now.speeds)
    hold(path, ends, now)
    if inelastic(motion):
        flow(system, motion, s, base, stage, ends, now)
    return status


@njit(cache=True)
def _trapezoid_base(system, motion, path, s, ends, now, scratch, work):
    """Update ``scratch.base`` to b = y + s v and c = v + s a(y)."""
    n = now.q.shape[0]
    base, stage, rod = scratch.base, scratch.stage, system.rod
    x, v = now.places[: n + 1], now.speeds[: n + 1]
    if motion.internal > 0.0:
        spin = np.empty((2, 3))
        for side in range(2):
            quaternion_to_columns(ends.frames[side], scratch.rotations[side])
            for k in range(3):
                spin[side, k] = 0.0
                for j in range(3):
                    spin[side, k] += scratch.rotations[side, j, k] * path.velocity[6 * side + 3 + j]
        strain_rates(rod, x, now.q, ends, v, now.w, spin, base.strain)
        # The stress S eta d(strain)/dt as that of springs.
        eta = motion.internal
        combine(1.0, rod.shear, 0.0, rod.shear, stage.rod.shear)
        combine(1.0, rod.bending, 0.0, rod.bending, stage.rod.bending)
        combine(1.0, rod.rest_strain, -eta, base.strain, stage.rod.rest_strain)
        combine(1.0, rod.rest_curvature, 0.0, rod.rest_curvature, stage.rod.rest_curvature)
        combine(eta / s, rod.bending, 0.0, rod.bending, stage.rod.viscous)
        combine(1.0, now.strain[n:], -s, base.strain[n:], stage.rod.viscous_centre)
        combine(1.0, now.strain, s, base.strain, base.strain)
        assemble(System(stage.rod, system.inertia), x, now.q, ends, work, False)
    else:
        assemble(system, x, now.q, ends, work, False)
    if motion.creep > 0.0:
        a = s / motion.relaxation
        bent(motion, now, base.creep)
        combine(1.0 - a, now.creep, a, base.creep, base.creep)
    accelerations(motion, now.q, now.w, now.speeds, work.gradient, base.speeds)
    combine(1.0, now.speeds, s, base.speeds, base.speeds)
    combine(1.0, now.places, s, now.speeds, base.places)


@njit(cache=True)
def _bdf_base(before, middle, base):
    """Update ``base`` to b = p Y_g - r y and c = p V_g - r v."""
    combine(BDF_NEW, middle.places, -BDF_OLD, before.places, base.places)
    combine(BDF_NEW, middle.speeds, -BDF_OLD, before.speeds, base.speeds)
    combine(BDF_NEW, middle.strain, -BDF_OLD, before.strain, base.strain)
    combine(BDF_NEW, middle.creep, -BDF_OLD, before.creep, base.creep)


@njit(cache=True)
def _power(ends, path, rotations, work):
    """Of the clamps on the rod [W], at an assembled state."""
    power = 0.0
    last = work.gradient.shape[0] - 3
    for side in range(2 if ends.right_held else 1):
        quaternion_to_columns(ends.frames[side], rotations[side])
        for k in range(3):
            power += work.gradient[k if side == 0 else last + k] * path.velocity[6 * side + k]
            torque = 0.0
            for j in range(3):
                torque += rotations[side, k, j] * work.clamp_terms[side, 0, j]
            power += torque * path.velocity[6 * side + 3 + k]
    return power


@njit(cache=True)
def _step(system, motion, path, plan, time, h, ends, now, scratch, limits, work):
    """Update ``now`` to ``time + h``; returns (status, error estimate [m], clamps' work [J]).

    ``scratch.before`` holds the moment that ``now`` was.
    """
    n = now.q.shape[0]
    before, middle = scratch.before, scratch.middle
    rotations = scratch.rotations
    stages = plan.order
    clamp_work = 0.0
    s = h if stages == 1 else 0.5 * GAMMA * h
    for stage in range(stages):
        if stages == 1:
            copy_moment(before, scratch.base)
        elif stage == 0:
            _trapezoid_base(system, motion, path, s, ends, now, scratch, work)
            clamp_work += 0.5 * (h - s) * _power(ends, path, rotations, work)
        else:
            copy_moment(now, middle)
            clamp_work += 0.5 * (h - s) * _power(ends, path, rotations, work)
            _bdf_base(before, middle, scratch.base)
        end = time + (h if stage == stages - 1 else GAMMA * h)
        status = _solve_stage(system, motion, path, s, end, ends, now, scratch, limits, work)
        if status != CONVERGED:
            return status, 0.0, 0.0
    clamp_work += s * _power(ends, path, rotations, work)
    error = 0.0
    for i in range(1, n if ends.right_held else n + 1):
        for k in range(3):
            change = 0.5 * (now.speeds[i, k] - before.speeds[i, k])
            if stages == 2:
                change = ERROR * (
                    before.speeds[i, k] / GAMMA
                    - middle.speeds[i, k] / (GAMMA * (1.0 - GAMMA))
                    + now.speeds[i, k] / (1.0 - GAMMA)
                )
            error = max(error, h * abs(change))
    angular_velocities(now.q, now.speeds, now.w)
    director_velocities(now.q, now.w, now.speeds)
    return CONVERGED, error, clamp_work


@njit(cache=True)
def advance(system, motion, path, ends, x, q, v, w, creep, plan, limits, work, carried=None):
    """Update x, q, v, w, creep along ``path``; returns (status, time reached [s], energy [J]).

    Steps are shortened where Newton's method fails, where the error estimate exceeds the
    tolerance, or where energy appears from nowhere; what little is left of such a gain is taken
    from the velocities, so that between clamps that hold still the total energy never grows.
    ``carried`` (``_kernels_sensitivity.Carried``) goes along, where it is given.
    """
    n = q.shape[0]
    now, scratch = empty_moment(n), empty_scratch(system, n)
    before = scratch.before
    now.places[: n + 1], now.speeds[: n + 1] = x, v
    now.q[:], now.w[:] = q, w
    directors(now.q, now.places)
    director_velocities(now.q, now.w, now.speeds)
    hold(path, ends, now)
    now.creep[:] = creep
    if inelastic(motion):
        strains(system.rod, now.places, now.q, ends, now.strain[:n], now.strain[n:])
        flow_plastically(system.rod, now.strain[n:], now.plastic)
        set_material(system, motion, now)
    if carried is not None:
        begin(system, path, ends, now, carried)
    still = True
    for k in range(12):
        still = still and path.velocity[k] == 0.0
    full = plan.duration / plan.steps
    h, time, status = full, 0.0, CONVERGED
    frames = ends.frames.copy()
    stored = assemble(system, now.places[: n + 1], now.q, ends, work, False)
    stored += hidden_energy(motion, system.rod, now.creep, now.plastic)
    kinetic = kinetic_energy(motion, now.speeds, now.w)
    while time < plan.duration:
        final = h > (plan.duration - time) * (1.0 - 1e-9)
        if final:
            h = plan.duration - time
        copy_moment(now, before)
        status, error, clamp_work = _step(
            system, motion, path, plan, time, h, ends, now, scratch, limits, work
        )
        accepted = status == CONVERGED
        new_stored, new_kinetic, gain, growth = stored, kinetic, 0.0, 0.5
        if accepted:
            new_stored = assemble(system, now.places[: n + 1], now.q, ends, work, False)
            new_stored += hidden_energy(motion, system.rod, now.creep, now.plastic)
            new_kinetic = kinetic_energy(motion, now.speeds, now.w)
            gain = new_stored + new_kinetic - stored - kinetic - clamp_work
            growth = 2.0
            if plan.tolerance > 0.0:
                ratio = plan.tolerance / max(error, 1e-3 * plan.tolerance)
                growth = min(2.0, max(0.2, 0.9 * ratio ** (1.0 / (plan.order + 1))))
                accepted = error <= plan.tolerance
            slack = limits.residual * limits.torque
            if still:
                slack += LARGEST_GAIN * new_kinetic
            else:
                slack += LARGEST_IMBALANCE * (abs(clamp_work) + kinetic + new_kinetic)
            if gain > slack:
                accepted, growth = False, min(growth, 0.5)
        if not accepted:
            copy_moment(before, now)
            set_material(system, motion, now)
            ends.frames[:] = frames
            h *= growth
            if h < SMALLEST_STEP * full:
                status = STALLED
                break
            continue
        if carried is not None:
            carry(
                system,
                motion,
                path,
                plan.order,
                time,
                h,
                ends.right_held,
                now,
                scratch,
                carried,
                work,
            )
        if still and gain > 0.0:
            if carried is not None:
                share_gain(
                    system, motion, gain, new_kinetic, limits.residual * limits.torque, ends,
                    now, before, carried, work,
                )  # fmt: skip
            scale = sqrt(max(0.0, 1.0 - gain / new_kinetic)) if new_kinetic > 0.0 else 0.0
            combine(scale, now.speeds, 0.0, now.speeds, now.speeds)
            combine(scale, now.w, 0.0, now.w, now.w)
            new_kinetic *= scale * scale
        stored, kinetic = new_stored, new_kinetic
        frames[:] = ends.frames
        time = plan.duration if final else time + h
        h = min(full, h * growth)
    x[:], v[:] = now.places[: n + 1], now.speeds[: n + 1]
    q[:], w[:], creep[:] = now.q, now.w, now.creep
    return status, time, stored
