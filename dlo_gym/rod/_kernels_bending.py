"""Bend and twist between two elements: energy and its derivatives, with plastic flow.

With the relative quaternion (w, v) of the frames, kappa = g(w) v / D.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_quaternions import log_factor, relative_quaternion


class Bend(NamedTuple):
    """One bend's quaternion, and its derivatives by turns a and b of the frames beside.

    The turns act as exp(-a/2) q exp(b/2).

    Attributes:
        q: (4,) relative quaternion.
        J, T: (4, 6) its derivative by a and b, and that of the energy's derivative by it.
        grad_a, grad_b: (3,) of the energy [N m].
        H_aa, H_bb, H_ab: (3, 3) its second derivatives [N m].
    """

    q: np.ndarray
    J: np.ndarray
    T: np.ndarray
    grad_a: np.ndarray
    grad_b: np.ndarray
    H_aa: np.ndarray
    H_bb: np.ndarray
    H_ab: np.ndarray


@njit(cache=True)
def plastic_flow(m0, m1, B, plastic, yield_moment, hardening):
    """Direction and amount of plastic curvature under the elastic trial moment (m0, m1).

    Radial return with linear kinematic hardening (Simo and Hughes 1998, 3.3): the minimum over
    the flow of elastic energy + H |plastic|^2 / 2 + yield moment |flow|.
    """
    s0, s1 = m0 - hardening * plastic[0], m1 - hardening * plastic[1]
    size = sqrt(s0 * s0 + s1 * s1)
    return s0 / size, s1 / size, (size - yield_moment) / (B + hardening), size


@njit(cache=True)
def bend_quaternion(q, ends, i, out):
    """Update ``out`` (4,) with the relative quaternion of the frames beside node i."""
    n = q.shape[0]
    if i == 0:
        relative_quaternion(ends.frames[0], q[0], out)
    elif i == n:
        relative_quaternion(q[n - 1], ends.frames[1], out)
    else:
        relative_quaternion(q[i - 1], q[i], out)


@njit(cache=True, inline="always")
def bending(rod, i, bend, with_hessian):
    """Energy [J] of the bend at node i, given its quaternion; updates the derivatives."""
    q, J, T, grad_a, grad_b, H_aa, H_bb, H_ab = bend
    w, v0, v1, v2 = q[0], q[1], q[2], q[3]
    g, dg, ddg = log_factor(w)
    D = rod.voronoi_length[i]
    k0, k1, k2 = g * v0 / D, g * v1 / D, g * v2 / D
    B0, B1, B2 = rod.bending[i, 0], rod.bending[i, 1], rod.bending[i, 2]
    p0, p1 = rod.plastic[i, 0], rod.plastic[i, 1]
    m0 = B0 * (k0 - rod.rest_curvature[i, 0] - p0)
    m1 = B1 * (k1 - rod.rest_curvature[i, 1] - p1)
    m2 = B2 * (k2 - rod.rest_curvature[i, 2])
    B00, B01, B11 = B0, 0.0, B1
    energy = 0.0
    yield_moment, hardening = rod.yield_moment[i], rod.hardening[i]
    s0, s1 = m0 - hardening * p0, m1 - hardening * p1
    if s0 * s0 + s1 * s1 > yield_moment * yield_moment:
        f0, f1, flow, size = plastic_flow(m0, m1, B0, rod.plastic[i], yield_moment, hardening)
        m0 -= B0 * flow * f0
        m1 -= B0 * flow * f1
        along = f0 * p0 + f1 * p1 + 0.5 * flow
        energy += D * flow * (yield_moment + hardening * along)
        # Consistent tangent B (I - B / (B + H) f f - B flow / size (I - f f)).
        across = B0 * flow / size
        less = B0 / (B0 + hardening) - across
        B00 = B0 * (1.0 - across - less * f0 * f0)
        B11 = B0 * (1.0 - across - less * f1 * f1)
        B01 = -B0 * less * f0 * f1
    energy += 0.5 * D * (m0 * m0 / B0 + m1 * m1 / B1 + m2 * m2 / B2)
    V0, V1, V2 = rod.viscous[i, 0], rod.viscous[i, 1], rod.viscous[i, 2]
    r0 = k0 - rod.viscous_centre[i, 0]
    r1 = k1 - rod.viscous_centre[i, 1]
    r2 = k2 - rod.viscous_centre[i, 2]
    energy += 0.5 * D * (V0 * r0 * r0 + V1 * r1 * r1 + V2 * r2 * r2)
    m0 += V0 * r0
    m1 += V1 * r1
    m2 += V2 * r2
    m = (m0, m1, m2)
    diagonal = (B00 + V0, B11 + V1, B2 + V2)
    Bv = (diagonal[0] * v0 + B01 * v1, B01 * v0 + diagonal[1] * v1, diagonal[2] * v2)
    mv = m0 * v0 + m1 * v1 + m2 * v2
    E0, E1, E2, E3 = dg * mv, g * m0, g * m1, g * m2
    # dq/da_i = -e_i q / 2 and dq/db_i = q e_i / 2, as 4 x 6 columns.
    for k in range(3):
        J[0, k], J[0, k + 3] = 0.5 * q[k + 1], -0.5 * q[k + 1]
        J[k + 1, k] = -0.5 * w
        J[k + 1, k + 3] = 0.5 * w
    J[1, 1] = J[1, 4] = -0.5 * v2
    J[1, 2] = J[1, 5] = 0.5 * v1
    J[2, 0] = J[2, 3] = 0.5 * v2
    J[2, 2] = J[2, 5] = -0.5 * v0
    J[3, 0] = J[3, 3] = -0.5 * v1
    J[3, 1] = J[3, 4] = 0.5 * v0
    for i in range(3):
        grad_a[i] = E0 * J[0, i] + E1 * J[1, i] + E2 * J[2, i] + E3 * J[3, i]
        grad_b[i] = E0 * J[0, i + 3] + E1 * J[1, i + 3] + E2 * J[2, i + 3] + E3 * J[3, i + 3]
    if not with_hessian:
        return energy
    E_ww = ddg * mv + dg * dg * (Bv[0] * v0 + Bv[1] * v1 + Bv[2] * v2) / D
    for c in range(6):
        T[0, c] = E_ww * J[0, c]
    for k in range(3):
        E_wk = dg * (m[k] + g * Bv[k] / D)
        E_kk = diagonal[k] * g * g / D
        for c in range(6):
            T[0, c] += E_wk * J[k + 1, c]
            T[k + 1, c] = E_wk * J[0, c] + E_kk * J[k + 1, c]
    if B01 != 0.0:
        for c in range(6):
            T[1, c] += B01 * g * g / D * J[2, c]
            T[2, c] += B01 * g * g / D * J[1, c]
    spin = -0.25 * (E0 * w + E1 * v0 + E2 * v1 + E3 * v2)
    for i in range(3):
        for j in range(i + 1):
            aa = 0.0
            bb = 0.0
            for k in range(4):
                aa += J[k, i] * T[k, j]
                bb += J[k, i + 3] * T[k, j + 3]
            if i == j:
                aa += spin
                bb += spin
            H_aa[i, j] = aa
            H_aa[j, i] = aa
            H_bb[i, j] = bb
            H_bb[j, i] = bb
    # Mixed second derivative of q: -e_i q e_j / 4; row i is e_i q = -2 dq/da_i.
    for i in range(3):
        r0, r1, r2, r3 = -2.0 * J[0, i], -2.0 * J[1, i], -2.0 * J[2, i], -2.0 * J[3, i]
        H_ab[i, 0] = -0.25 * (-E0 * r1 + E1 * r0 + E2 * r3 - E3 * r2)
        H_ab[i, 1] = -0.25 * (-E0 * r2 - E1 * r3 + E2 * r0 + E3 * r1)
        H_ab[i, 2] = -0.25 * (-E0 * r3 + E1 * r2 - E2 * r1 + E3 * r0)
        for j in range(3):
            mixed = 0.0
            for k in range(4):
                mixed += J[k, i] * T[k, j + 3]
            H_ab[i, j] += mixed
    return energy


@njit(cache=True, inline="always")
def add_bends(rod, q, ends, work, with_hessian):
    """Energy [J], added to ``work``'s gradient and, ``with_hessian``, its band.

    Updates ``work``'s clamp terms.
    """
    gradient, band, clamp_terms = work.gradient, work.band, work.clamp_terms
    bend = Bend(
        np.empty(4), np.empty((4, 6)), np.empty((4, 6)), np.empty(3), np.empty(3),
        np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)),
    )  # fmt: skip
    grad_a, grad_b, H_aa, H_bb, H_ab = bend.grad_a, bend.grad_b, bend.H_aa, bend.H_bb, bend.H_ab
    n = q.shape[0]
    energy = 0.0
    for i in range(n + 1):
        if i == n and not ends.right_held:
            continue
        bend_quaternion(q, ends, i, bend.q)
        energy += bending(rod, i, bend, with_hessian)
        left, right = 6 * (i - 1) + 3, 6 * i + 3
        if i == 0:
            for j in range(3):
                clamp_terms[0, 0, j] = grad_a[j]
                for k in range(3):
                    clamp_terms[0, 1 + j, k] = H_ab[k, j]
        else:
            for k in range(3):
                gradient[left + k] += grad_a[k]
        if i == n:
            for j in range(3):
                clamp_terms[1, 0, j] = grad_b[j]
                for k in range(3):
                    clamp_terms[1, 1 + j, k] = H_ab[j, k]
        else:
            for k in range(3):
                gradient[right + k] += grad_b[k]
        if not with_hessian:
            continue
        for j in range(3):
            for k in range(j, 3):
                if i > 0:
                    band[left + j, k - j] += H_aa[k, j]
                if i < n:
                    band[right + j, k - j] += H_bb[k, j]
            if 0 < i < n:
                for k in range(3):
                    band[left + j, 6 + k - j] += H_ab[j, k]
    return energy
