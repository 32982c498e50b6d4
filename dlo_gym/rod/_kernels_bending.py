"""Bend and twist between two elements: energy and its derivatives, with plastic flow.

With the relative quaternion (w, v) of the frames, kappa = g(w) v / D.
"""

from math import sqrt

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_quaternions import log_factor


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
def bending(q, rod, i, grad_a, grad_b, H_aa, H_bb, H_ab, with_hessian):
    """Energy of the bend at node i; updates its derivatives by turns a and b of the frames beside.

    ``q`` (4,) is the relative quaternion; a and b act as exp(-a/2) q exp(b/2).
    """
    B, rest, D, plastic = (
        rod.bending[i],
        rod.rest_curvature[i],
        rod.voronoi_length[i],
        rod.plastic[i],
    )
    w, v0, v1, v2 = q[0], q[1], q[2], q[3]
    g, dg, ddg = log_factor(w)
    m0 = B[0] * (g * v0 / D - rest[0] - plastic[0])
    m1 = B[1] * (g * v1 / D - rest[1] - plastic[1])
    m2 = B[2] * (g * v2 / D - rest[2])
    B00, B01, B11 = B[0], 0.0, B[1]
    energy = 0.0
    yield_moment, hardening = rod.yield_moment[i], rod.hardening[i]
    s0, s1 = m0 - hardening * plastic[0], m1 - hardening * plastic[1]
    if s0 * s0 + s1 * s1 > yield_moment * yield_moment:
        f0, f1, flow, size = plastic_flow(m0, m1, B[0], plastic, yield_moment, hardening)
        m0 -= B[0] * flow * f0
        m1 -= B[0] * flow * f1
        along = f0 * plastic[0] + f1 * plastic[1] + 0.5 * flow
        energy += D * flow * (yield_moment + hardening * along)
        # Consistent tangent B (I - B / (B + H) f f - B flow / size (I - f f)).
        across = B[0] * flow / size
        less = B[0] / (B[0] + hardening) - across
        B00 = B[0] * (1.0 - across - less * f0 * f0)
        B11 = B[0] * (1.0 - across - less * f1 * f1)
        B01 = -B[0] * less * f0 * f1
    energy += 0.5 * D * (m0 * m0 / B[0] + m1 * m1 / B[1] + m2 * m2 / B[2])
    V, centre = rod.viscous[i], rod.viscous_centre[i]
    r0, r1, r2 = g * v0 / D - centre[0], g * v1 / D - centre[1], g * v2 / D - centre[2]
    energy += 0.5 * D * (V[0] * r0 * r0 + V[1] * r1 * r1 + V[2] * r2 * r2)
    m0 += V[0] * r0
    m1 += V[1] * r1
    m2 += V[2] * r2
    m = (m0, m1, m2)
    diagonal = (B00 + V[0], B11 + V[1], B[2] + V[2])
    Bv = (diagonal[0] * v0 + B01 * v1, B01 * v0 + diagonal[1] * v1, diagonal[2] * v2)
    mv = m0 * v0 + m1 * v1 + m2 * v2
    E0, E1, E2, E3 = dg * mv, g * m0, g * m1, g * m2
    # dq/da_i = -e_i q / 2 and dq/db_i = q e_i / 2, as 4 x 6 columns.
    J = np.array(
        (
            (0.5 * v0, 0.5 * v1, 0.5 * v2, -0.5 * v0, -0.5 * v1, -0.5 * v2),
            (-0.5 * w, -0.5 * v2, 0.5 * v1, 0.5 * w, -0.5 * v2, 0.5 * v1),
            (0.5 * v2, -0.5 * w, -0.5 * v0, 0.5 * v2, 0.5 * w, -0.5 * v0),
            (-0.5 * v1, 0.5 * v0, -0.5 * w, -0.5 * v1, 0.5 * v0, 0.5 * w),
        )
    )
    for i in range(3):
        grad_a[i] = E0 * J[0, i] + E1 * J[1, i] + E2 * J[2, i] + E3 * J[3, i]
        grad_b[i] = E0 * J[0, i + 3] + E1 * J[1, i + 3] + E2 * J[2, i + 3] + E3 * J[3, i + 3]
    if not with_hessian:
        return energy
    E_ww = ddg * mv + dg * dg * (Bv[0] * v0 + Bv[1] * v1 + Bv[2] * v2) / D
    T = np.empty((4, 6))
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
