"""A rod at one time: what moves, what it remembers, and how its material flows in a stage."""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_energy import RodArrays, flow_plastically, strains
from dlo_gym.rod._kernels_inertia import Inertia


class Motion(NamedTuple):
    """What moves, and what slows it.

    Attributes:
        mass: (3 n + 1,) of the places: m [kg] of nodes, J = m r^2 / 4 [kg m^2] of directors.
        external: damping proportional to mass [1/s].
        internal: damping proportional to stiffness [s].
        creep: share of the bending and twisting stiffness that relaxes [-].
        relaxation: its time constant [s].
        yields: whether the rod bends plastically.
        rest_curvature: (n + 1, 3) kappa0 of the rod as made [1/m].
    """

    mass: np.ndarray
    external: float
    internal: float
    creep: float
    relaxation: float
    yields: bool
    rest_curvature: np.ndarray


class Moment(NamedTuple):
    """Shape and motion at one time.

    Attributes:
        places: (3 n + 1, 3) nodes [m] and directors [-].
        speeds: (3 n + 1, 3) of places [1/s].
        strain: (2 n + 1, 3) of elements, curvature of nodes; kept for inelastic rods only.
        plastic: (n + 1, 2) plastic curvature [1/m].
        creep: (n + 1, 3) curvature at which the relaxing part of the stiffness rests [1/m].
        q: (n, 4) quaternions of the elements.
        w: (n, 3) their angular velocities [rad/s].
    """

    places: np.ndarray
    speeds: np.ndarray
    strain: np.ndarray
    plastic: np.ndarray
    creep: np.ndarray
    q: np.ndarray
    w: np.ndarray


class Scratch(NamedTuple):
    """What one step needs beside the moment it moves."""

    before: Moment
    middle: Moment
    base: Moment
    stage: System
    rotations: np.ndarray
    clamps: np.ndarray
    twist: np.ndarray
    frames: np.ndarray


@njit(cache=True)
def empty_moment(n):
    return Moment(
        np.empty((3 * n + 1, 3)), np.zeros((3 * n + 1, 3)), np.zeros((2 * n + 1, 3)),
        np.zeros((n + 1, 2)),
        np.zeros((n + 1, 3)),
        np.empty((n, 4)), np.empty((n, 3)),
    )  # fmt: skip


@njit(cache=True)
def empty_scratch(system, n):
    rod = system.rod
    stage_rod = RodArrays(
        rod.rest_length, rod.shear.copy(), rod.rest_strain.copy(), rod.bending.copy(),
        rod.rest_curvature.copy(), rod.voronoi_length, rod.forces,
        rod.plastic, rod.yield_moment, rod.hardening, np.zeros((n + 1, 3)), np.zeros((n + 1, 3)),
    )  # fmt: skip
    stage = System(stage_rod, Inertia(np.empty(3 * n + 1), np.empty((3 * n + 1, 3))))
    return Scratch(
        empty_moment(n), empty_moment(n), empty_moment(n), stage,
        np.empty((2, 3, 3)), np.empty((2, 3)), np.zeros(12), np.empty((2, 4)),
    )  # fmt: skip


@njit(cache=True)
def combine(a, A, b, B, out):
    """Update ``out`` to a A + b B, all of one shape; ``out`` may be one of them."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            out[i, k] = a * A[i, k] + b * B[i, k]


@njit(cache=True)
def copy_moment(source, out):
    """Update the moment ``out`` with ``source``."""
    combine(1.0, source.places, 0.0, source.places, out.places)
    combine(1.0, source.speeds, 0.0, source.speeds, out.speeds)
    combine(1.0, source.strain, 0.0, source.strain, out.strain)
    combine(1.0, source.plastic, 0.0, source.plastic, out.plastic)
    combine(1.0, source.creep, 0.0, source.creep, out.creep)
    combine(1.0, source.w, 0.0, source.w, out.w)
    combine(1.0, source.q, 0.0, source.q, out.q)


@njit(cache=True)
def hold(path, ends, now):
    """Update the held nodes' speeds to the clamps'."""
    n = now.q.shape[0]
    for k in range(3):
        now.speeds[0, k] = path.velocity[k]
        if ends.right_held:
            now.speeds[n, k] = path.velocity[6 + k]


@njit(cache=True)
def inelastic(motion):
    return motion.internal > 0.0 or motion.creep > 0.0 or motion.yields


@njit(cache=True)
def set_material(system, motion, now):
    """Update the system's plastic and rest curvature to those of ``now``."""
    combine(1.0, now.plastic, 0.0, now.plastic, system.rod.plastic)
    rest = system.rod.rest_curvature
    combine(1.0, motion.rest_curvature, motion.creep, now.creep, rest)


@njit(cache=True)
def bent(motion, now, out):
    """Update ``out`` (n + 1, 3) to the elastic curvature kappa - kappa0 - plastic."""
    n = now.q.shape[0]
    combine(1.0, now.strain[n:], -1.0, motion.rest_curvature, out)
    for i in range(n + 1):
        for k in range(2):
            out[i, k] -= now.plastic[i, k]


@njit(cache=True)
def flow(system, motion, s, base, stage, ends, now):
    """Update the moment's plastic curvature, creep and strain at the end of a stage."""
    n = now.q.shape[0]
    kappa = now.strain[n:]
    strains(system.rod, now.places, now.q, ends, now.strain[:n], kappa)
    if motion.yields:
        flow_plastically(stage.rod, kappa, now.plastic)
    if motion.creep > 0.0:
        bent(motion, now, now.creep)
        a = s / motion.relaxation
        combine(1.0 / (1.0 + a), base.creep, a / (1.0 + a), now.creep, now.creep)
    set_material(system, motion, now)


@njit(cache=True)
def hidden_energy(motion, rod, creep, plastic):
    """Energy [J] of hardening and of the relaxing stiffness that ``assemble`` leaves out."""
    energy = 0.0
    for i in range(plastic.shape[0]):
        for k in range(2):
            energy += 0.5 * rod.voronoi_length[i] * rod.hardening[i] * plastic[i, k] ** 2
        for k in range(3):
            stiffness = motion.creep * (1.0 - motion.creep) * rod.bending[i, k]
            energy += 0.5 * rod.voronoi_length[i] * stiffness * creep[i, k] ** 2
    return energy
