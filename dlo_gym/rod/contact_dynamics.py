"""Implicit Euler steps of a rod that touches something.

Contact sets in within a step whatever its length, so a method of second order would gain nothing;
Euler's takes what a blow leaves of the velocities. A stage is the one of ``_kernels_dynamics``,
with contact in its potential.
"""

from collections.abc import Sequence
from math import sqrt

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import _kernels_dynamics as kernels
from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_energy import Ends, Work, flow_plastically, strains
from dlo_gym.rod._kernels_rates import (
    ClampPath,
    angular_velocities,
    director_velocities,
    directors,
    kinetic_energy,
)
from dlo_gym.rod._kernels_solve import CONVERGED, STALLED, Limits, exact_stress
from dlo_gym.rod.contact import ContactModel
from dlo_gym.rod.obstacles import Obstacle, on_the_way


def advance(
    contact: ContactModel,
    obstacles: Sequence[Obstacle] | None,
    system: System,
    motion: kernels.Motion,
    path: ClampPath,
    ends: Ends,
    state: tuple[Array, Array, Array, Array, Array],
    plan: kernels.Plan,
    limits: Limits,
    work: Work,
) -> tuple[int, float]:
    """Update ``state``, x, q, v, w and creep (see ``_kernels_dynamics``), along ``path``.

    Steps are halved where no solution is found, or, between clamps and obstacles that hold still,
    where energy appears from nowhere; what little is left of such a gain is taken from the
    velocities. Returns a status and the time reached [s].
    """
    x, q, v, w, creep = state
    n = len(q)
    now, scratch = kernels._empty_moment(n), kernels._scratch(system, n)
    now.places[: n + 1], now.speeds[: n + 1] = x, v
    now.q[:], now.w[:] = q, w
    directors(now.q, now.places)
    director_velocities(now.q, now.w, now.speeds)
    kernels._hold(path, ends, now)
    now.creep[:] = creep
    if kernels._inelastic(motion):
        strains(system.rod, now.places, now.q, ends, now.strain[:n], now.strain[n:])
        flow_plastically(system.rod, now.strain[n:], now.plastic)
        kernels._set_material(system, motion, now)
    standing = contact.obstacles
    still = obstacles is None and not path.velocity.any()
    places = now.places[: n + 1]

    def stored() -> float:
        exact_stress(system.rod, places, now.q, work.stress)
        hidden = kernels.hidden_energy(motion, system.rod, now.creep, now.plastic)
        return contact.linearise((system, places, now.q, ends), work)[0] + hidden

    energy = stored() + kinetic_energy(motion, now.speeds, now.w)
    full = plan.duration / plan.steps
    time, h = 0.0, full
    while time < plan.duration:
        final = h > (plan.duration - time) * (1.0 - 1e-9)
        h = plan.duration - time if final else h
        reached = plan.duration if final else time + h
        kernels._copy(now, scratch.before)
        frames, saved = ends.frames.copy(), contact.save()
        bodies = None
        if obstacles is not None:
            bodies = on_the_way(standing, obstacles, reached / plan.duration)
        accepted = _step(
            contact, bodies, system, motion, path, ends, now, scratch, reached, h, limits, work
        )
        if accepted and still:
            kinetic = kinetic_energy(motion, now.speeds, now.w)
            gain = stored() + kinetic - energy
            slack = limits.residual * limits.torque + contact.held_energy(places)
            accepted = gain <= kernels.LARGEST_GAIN * kinetic + slack
            if accepted and gain > 0.0 and kinetic > 0.0:
                now.speeds[:] *= sqrt(max(0.0, 1.0 - gain / kinetic))
                now.w[:] *= sqrt(max(0.0, 1.0 - gain / kinetic))
            energy += min(gain, 0.0)
        if not accepted:
            kernels._copy(scratch.before, now)
            kernels._set_material(system, motion, now)
            ends.frames[:] = frames
            contact.load(saved)
            h *= 0.5
            if h < kernels.SMALLEST_STEP * full:
                return STALLED, time
            continue
        time, h = reached, min(full, 2.0 * h)
    x[:], v[:] = places, now.speeds[: n + 1]
    q[:], w[:], creep[:] = now.q, now.w, now.creep
    return CONVERGED, time


def _step(
    contact, obstacles, system, motion, path, ends, now, scratch, time, h, limits, work
) -> bool:
    """Update ``now`` to ``time`` [s], a step of ``h`` [s]; whether a solution was found."""
    n = len(now.q)
    x, stage = now.places[: n + 1], scratch.stage
    kernels._copy(scratch.before, scratch.base)
    kernels._set_stage(system.rod, motion, h, scratch.base, ends, stage)
    shape = stage, x, now.q, ends
    contact.linearise(shape, work)
    # Rounding errors grow with the stiffness.
    limits = limits._replace(residual=limits.residual * (1.0 + motion.internal / h))
    kernels._follow_clamps(path, time, ends, now, scratch)
    status, _ = contact.follow(shape, scratch.twist, scratch.rotations, obstacles, limits, work)
    if status != CONVERGED or not np.isfinite(now.places).all():
        return False
    x[0] = scratch.clamps[0]
    if ends.right_held:
        x[n] = scratch.clamps[1]
    directors(now.q, now.places)
    now.speeds[:] = (now.places - scratch.base.places) / h
    kernels._hold(path, ends, now)
    if kernels._inelastic(motion):
        kernels._flow(system, motion, h, scratch.base, stage, ends, now)
    angular_velocities(now.q, now.speeds, now.w)
    director_velocities(now.q, now.w, now.speeds)
    return True
