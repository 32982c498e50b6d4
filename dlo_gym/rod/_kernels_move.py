"""A whole quasi-static move: sub-steps that follow the equilibrium, and what is believed of them.

After Newton's method has converged a sub-step counts if the equilibrium is stable, the shape is
plausible, and the energy has not risen by more than the clamps' work, which would mean that another
branch was reached. Otherwise it is halved, down to 1/64; then the rod is taken to have lost
stability, and descends to the equilibrium that it snaps to.
"""

from math import ceil, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_clamps import clamp_frame, displace_clamp
from dlo_gym.rod._kernels_energy import Ends, Work, flow_plastically, strains
from dlo_gym.rod._kernels_moment import Motion, hidden_energy
from dlo_gym.rod._kernels_solve import CONVERGED, Limits, copy, follow, linearise, minimise

STRAINED, BENT = 4, 5  # beside the solver's statuses
SMALLEST_SUBSTEP = 1.0 / 64.0
DESCENT = 2000  # steps


class Bounds(NamedTuple):
    """How far one sub-step goes, and what is believed of its end.

    Attributes:
        translation: largest of a clamp in one sub-step [m].
        rotation: [rad].
        strain: largest of an element [-].
        bend: largest between neighbouring elements [rad].
    """

    translation: float
    rotation: float
    strain: float
    bend: float


class Held(NamedTuple):
    """A rod between its clamps: what a move updates, and what it must know.

    Attributes:
        system: the rod, and what acts on it.
        motion: its creep and whether it yields.
        x: (n + 1, 3) nodes [m].
        q: (n, 4) quaternions of the elements.
        creep: (n + 1, 3) curvature at which the relaxing part of the stiffness rests [1/m].
        clamps: (2, 4, 4) poses.
        ends: their frames.
        limits, bounds: of the solver and of sub-steps.
        work: stress and factors at the present shape.
    """

    system: System
    motion: Motion
    x: np.ndarray
    q: np.ndarray
    creep: np.ndarray
    clamps: np.ndarray
    ends: Ends
    limits: Limits
    bounds: Bounds
    work: Work


class Kept(NamedTuple):
    """What a move changes, to go back to."""

    x: np.ndarray
    q: np.ndarray
    clamps: np.ndarray
    frames: np.ndarray
    stress: np.ndarray
    plastic: np.ndarray


class Outcome(NamedTuple):
    """How a move went.

    Attributes:
        status: CONVERGED, or why it was given up.
        reached: the part of it that was made, or at which it was lost.
        measure: what the status speaks of: Newton steps, strain [-] or bend [rad].
        energy: stored at the end [J].
    """

    status: int
    reached: float
    measure: float
    energy: float


@njit(cache=True)
def substeps(twist, bounds):
    """How many sub-steps Newton's method takes with ease for clamps that move by ``twist``."""
    size = 1.0
    for side in range(2):
        for half in range(2):
            j = 6 * side + 3 * half
            length = sqrt(twist[j] ** 2 + twist[j + 1] ** 2 + twist[j + 2] ** 2)
            size = max(size, length / (bounds.translation if half == 0 else bounds.rotation))
    return ceil(size)


@njit(cache=True)
def plausible(rod, strain, kappa, bounds):
    """Returns (CONVERGED, 0), or what is wrong with these strains (n, 3), (n + 1, 3), and it."""
    largest = 0.0
    for e in range(strain.shape[0]):
        for k in range(3):
            if not abs(strain[e, k]) <= largest:  # a NaN counts as large
                largest = abs(strain[e, k])
    if not largest < bounds.strain:
        return STRAINED, largest
    largest = 0.0
    for i in range(kappa.shape[0]):
        bend = sqrt(kappa[i, 0] ** 2 + kappa[i, 1] ** 2 + kappa[i, 2] ** 2)
        bend *= rod.voronoi_length[i]
        if not bend <= largest:
            largest = bend
    if not largest < bounds.bend:
        return BENT, largest
    return CONVERGED, 0.0


@njit(cache=True)
def clamp_wrenches(work, clamps, right_held, wrenches):
    """Update ``wrenches`` (12,) to force and torque of the clamps on the rod, world axes."""
    last = work.gradient.shape[0] - 3
    for side in range(2):
        held = side == 0 or right_held
        for i in range(3):
            torque = 0.0
            for k in range(3):
                torque += clamps[side, i, k] * work.clamp_terms[side, 0, k]
            force = work.gradient[i if side == 0 else last + i]
            wrenches[6 * side + i] = force if held else 0.0
            wrenches[6 * side + 3 + i] = torque if held else 0.0


@njit(cache=True)
def kept_of(held):
    """A copy of what a move changes."""
    work = held.work
    return Kept(
        held.x.copy(), held.q.copy(), held.clamps.copy(), held.ends.frames.copy(),
        work.stress.copy(), held.system.rod.plastic.copy(),
    )  # fmt: skip


@njit(cache=True)
def give_back(kept, held):
    """Update the rod to what was kept of it, but for ``work``'s factors."""
    copy(kept.x, held.x)
    copy(kept.q, held.q)
    copy(kept.frames, held.ends.frames)
    copy(kept.stress, held.work.stress)
    copy(kept.plastic, held.system.rod.plastic)
    for side in range(2):
        copy(kept.clamps[side], held.clamps[side])


@njit(cache=True)
def displace_from(start, twist, part, held):
    """Update the clamps to ``start`` (2, 4, 4) displaced by ``part`` of ``twist`` (12,)."""
    rotation = np.empty((3, 3))
    for side in range(2):
        motion = part * twist[6 * side : 6 * side + 6]
        displace_clamp(start[side], motion, held.clamps[side])
        clamp_frame(held.clamps[side], rotation, held.ends.frames[side])


@njit(cache=True)
def flow(held):
    """Take what has bent plastically as given before the next solve."""
    if held.motion.yields:
        rod, n = held.system.rod, held.q.shape[0]
        strain, kappa, plastic = np.empty((n, 3)), np.empty((n + 1, 3)), np.empty((n + 1, 2))
        strains(rod, held.x, held.q, held.ends, strain, kappa)
        flow_plastically(rod, kappa, plastic)
        copy(plastic, rod.plastic)


@njit(cache=True)
def judge(held, potential):
    """Returns (status, what it measures, energy stored [J]) of a shape of this ``potential``.

    An incremental potential counts what was dissipated as well.
    """
    rod, motion, n = held.system.rod, held.motion, held.q.shape[0]
    strain, kappa = np.empty((n, 3)), np.empty((n + 1, 3))
    strains(rod, held.x, held.q, held.ends, strain, kappa)
    status, measure = plausible(rod, strain, kappa, held.bounds)
    if motion.yields or motion.creep > 0.0:
        potential -= flow_plastically(rod, kappa, np.empty((n + 1, 2)))
        potential += hidden_energy(motion, rod, held.creep, rod.plastic)
    return status, measure, potential


@njit(cache=True, inline="always")
def substep(held, energy, start, twist, done, reached, kept):
    """Follow the equilibrium from one part of ``twist`` to another; returns (whether to go on from
    there, energy stored [J])."""
    ends, work, right_held = held.ends, held.work, held.ends.right_held
    before, after = np.empty(12), np.empty(12)
    clamp_wrenches(work, held.clamps, right_held, before)
    displace_from(start, twist, reached, held)
    moved = (reached - done) * twist
    status, potential = follow(
        held.system, held.x, held.q, ends, moved, kept.clamps, held.limits, work
    )
    if status != CONVERGED:
        return False, energy
    clamp_wrenches(work, held.clamps, right_held, after)
    clamps_work = 0.0
    for j in range(12):
        clamps_work += 0.5 * moved[j] * (before[j] + after[j])
    slack = abs(clamps_work) + 1e-3 * held.limits.torque
    status, _, stored = judge(held, potential)
    return status == CONVERGED and potential - energy <= clamps_work + slack, stored


@njit(cache=True)
def take_ends_along(held, start, twist, reached):
    """Update the clamps to ``start`` displaced by a part of ``twist``, and the nodes they hold."""
    n = held.q.shape[0]
    displace_from(start, twist, reached, held)
    for k in range(3):
        held.x[0, k] = held.clamps[0, k, 3]
        if held.ends.right_held:
            held.x[n, k] = held.clamps[1, k, 3]


@njit(cache=True, inline="always")
def snap(held):
    """Descend from the present shape; returns (status, what it measures, energy stored [J])."""
    status, potential, steps = minimise(
        held.system, held.x, held.q, held.ends, held.limits, DESCENT, held.work
    )
    if status != CONVERGED:
        return status, float(steps), potential
    return judge(held, potential)


@njit(cache=True, nogil=True)
def move(held, energy, twist, descend):
    """Move the clamps by ``twist`` (12,) and the rod with them; returns an Outcome.

    On entry ``work`` holds the factors at the present shape, of stored ``energy`` [J]. To
    ``descend`` is for clamps that hold still around any shape. A move that is lost leaves all as it
    was.
    """
    before, energy_before = kept_of(held), energy
    full_stride = 1.0 / substeps(twist, held.bounds)
    done, stride = 0.0, full_stride
    while done < 1.0:
        reached = done + stride if done + stride < 1.0 - 1e-9 else 1.0
        if not descend:
            flow(held)
            kept = kept_of(held)
            followed, stored = substep(held, energy, before.clamps, twist, done, reached, kept)
            if followed:
                done, energy = reached, stored
                continue
            give_back(kept, held)
            linearise(held.system, held.x, held.q, held.ends, held.work)
            stride *= 0.5
            if stride >= SMALLEST_SUBSTEP * full_stride:
                continue
            take_ends_along(held, before.clamps, twist, reached)
        status, measure, energy_after = snap(held)
        if status != CONVERGED:
            give_back(before, held)
            linearise(held.system, held.x, held.q, held.ends, held.work)
            return Outcome(status, reached, measure, energy_before)
        done, stride, energy = reached, full_stride, energy_after
    return Outcome(CONVERGED, 1.0, 0.0, energy)
