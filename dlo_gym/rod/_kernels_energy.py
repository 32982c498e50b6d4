"""The rod's energy with its exact gradient and Hessian.

Discretisation (Gazzola et al. 2018, Sections 3-4, as in PyElastica): nodes x_i, elements e between
x_e and x_e+1 carrying a material frame R_e = [d1 d2 d3]. With rest lengths l and Voronoi lengths D

    shear and stretch  gamma_e = R_e^T (x_e+1 - x_e) / l_e - e3
    curvature          kappa_i = log(R_i-1^T R_i) / D_i
    energy             sum l/2 gamma.S.gamma + sum D/2 (kappa-kappa0).B.(kappa-kappa0) - sum f.x

Unknowns are interleaved along the rod, x_0 theta_0 x_1 theta_1 ... x_n, where theta_e is an
increment in the element's own frame, R_e <- R_e exp(theta_e); so the Hessian's half-bandwidth
is 8. A clamp is a frame joined to the end element by a short piece of the same rod.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_bending import add_bends, plastic_flow
from dlo_gym.rod._kernels_quaternions import (
    log_factor,
    quaternion_to_columns,
    relative_quaternion,
)
from dlo_gym.rod._kernels_stretch import add_stretch


class RodArrays(NamedTuple):
    """The rod's constants: n elements, n + 1 nodes.

    Attributes:
        rest_length: (n,) l [m].
        shear: (n, 3) S: kGA, kGA, EA [N].
        rest_strain: (n, 3) gamma0 [-].
        bending: (n + 1, 3) B: EI, EI, GJ [N m^2] at every node; at the ends that of the element.
        rest_curvature: (n + 1, 3) kappa0 [1/m].
        voronoi_length: (n + 1,) D [m]; at the ends the length of rod between clamp and element.
        forces: (n + 1, 3) weight and other dead loads on the nodes [N].
        plastic: (n + 1, 2) plastic curvature about d1 and d2 before this solve [1/m].
        yield_moment: (n + 1,) [N m]; infinite where the rod stays elastic.
        hardening: (n + 1,) moment that each plastic curvature adds to resist it [N m^2].
        viscous: (n + 1, 3) stiffness of the springs that stand for internal damping [N m^2].
        viscous_centre: (n + 1, 3) curvature and twist where they rest [1/m].
    """

    rest_length: np.ndarray
    shear: np.ndarray
    rest_strain: np.ndarray
    bending: np.ndarray
    rest_curvature: np.ndarray
    voronoi_length: np.ndarray
    forces: np.ndarray
    plastic: np.ndarray
    yield_moment: np.ndarray
    hardening: np.ndarray
    viscous: np.ndarray
    viscous_centre: np.ndarray


class Ends(NamedTuple):
    """What holds the rod.

    Attributes:
        frames: (2, 4) quaternions of the left and right clamp frame.
        right_held: whether the right clamp exists.
    """

    frames: np.ndarray
    right_held: bool


class Work(NamedTuple):
    """What an assembly reads and writes, allocated once; H's rows are x_0 theta_0 x_1 ... x_n.

    Attributes:
        stress: (n, 3) S (gamma - gamma0) [N] used in the Hessian's geometric part, which may be a
            prediction of the stress after the next step (Magisano et al. 2017, MIP Newton).
        gradient: (6 n + 3,) of the potential [N, N m].
        band: (6 n + 3, 9) lower band of its Hessian, see ``_kernels_banded``.
        clamp_terms: (2, 4, 3) per clamp the torque [N m] on the rod in the clamp's frame, then
            d(gradient of the end element's rotation)/d(clamp's rotation) (3, 3).
    """

    stress: np.ndarray
    gradient: np.ndarray
    band: np.ndarray
    clamp_terms: np.ndarray


@njit(cache=True)
def strains(rod, x, q, ends, gamma, kappa):
    """Update ``gamma`` (n, 3) and ``kappa`` (n + 1, 3) given nodes x and frames q."""
    n = q.shape[0]
    R = np.empty((3, 3))
    relative = np.empty(4)
    for e in range(n):
        quaternion_to_columns(q[e], R)
        for i in range(3):
            p = 0.0
            for k in range(3):
                p += R[k, i] * (x[e + 1, k] - x[e, k])
            gamma[e, i] = p / rod.rest_length[e]
        gamma[e, 2] -= 1.0
    kappa[n] = 0.0
    for i in range(n + 1 if ends.right_held else n):
        before = ends.frames[0] if i == 0 else q[i - 1]
        relative_quaternion(before, ends.frames[1] if i == n else q[i], relative)
        g, _, _ = log_factor(relative[0])
        for k in range(3):
            kappa[i, k] = g * relative[k + 1] / rod.voronoi_length[i]


@njit(cache=True)
def flow_plastically(rod, kappa, plastic):
    """Update ``plastic`` (n + 1, 2) to its value at curvatures ``kappa`` (n + 1, 3).

    Returns the energy dissipated [J].
    """
    dissipated = 0.0
    for i in range(kappa.shape[0]):
        B, old, limit, H = rod.bending[i, 0], rod.plastic[i], rod.yield_moment[i], rod.hardening[i]
        m0 = B * (kappa[i, 0] - rod.rest_curvature[i, 0] - old[0])
        m1 = B * (kappa[i, 1] - rod.rest_curvature[i, 1] - old[1])
        f0, f1, flow = 0.0, 0.0, 0.0
        if (m0 - H * old[0]) ** 2 + (m1 - H * old[1]) ** 2 > limit * limit:
            f0, f1, flow, _ = plastic_flow(m0, m1, B, old, limit, H)
        plastic[i, 0] = old[0] + flow * f0
        plastic[i, 1] = old[1] + flow * f1
        dissipated += rod.voronoi_length[i] * limit * flow if flow > 0.0 else 0.0
    return dissipated


@njit(cache=True)
def assemble_rod(rod, x, q, ends, work, with_hessian):
    """Elastic energy and that of dead loads [J]; overwrites ``work`` but for its stress.

    The band is written ``with_hessian`` only.
    """
    energy = 0.0
    work.gradient[:] = 0.0
    if with_hessian:
        work.band[:] = 0.0
    for i in range(q.shape[0] + 1):
        for k in range(3):
            energy -= rod.forces[i, k] * x[i, k]
            work.gradient[6 * i + k] = -rod.forces[i, k]
    energy += add_stretch(rod, x, q, work, with_hessian)
    energy += add_bends(rod, q, ends, work, with_hessian)
    return energy
