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

from math import acos, cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit


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
    """

    rest_length: np.ndarray
    shear: np.ndarray
    rest_strain: np.ndarray
    bending: np.ndarray
    rest_curvature: np.ndarray
    voronoi_length: np.ndarray
    forces: np.ndarray


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
def quaternion_to_columns(q, R):
    """Update ``R`` (3, 3) with the rotation matrix of unit quaternion ``q`` wxyz (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - w * z)
    R[0, 2] = 2.0 * (x * z + w * y)
    R[1, 0] = 2.0 * (x * y + w * z)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - w * x)
    R[2, 0] = 2.0 * (x * z - w * y)
    R[2, 1] = 2.0 * (y * z + w * x)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def relative_quaternion(a, b, out):
    """Update ``out`` (4,) with conj(a) b, of the two the one with w >= 0."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    sign = 1.0 if w >= 0.0 else -1.0
    out[0] = sign * w
    out[1] = sign * x
    out[2] = sign * y
    out[3] = sign * z


@njit(cache=True)
def rotate(q, vx, vy, vz):
    """Update unit quaternion ``q`` to q exp(v / 2): a turn by v [rad] in the body's own frame."""
    angle = 0.5 * sqrt(vx * vx + vy * vy + vz * vz)
    if angle > 1e-8:
        scale = 0.5 * sin(angle) / angle
        c = cos(angle)
    else:
        scale = 0.5
        c = 1.0
    x, y, z = scale * vx, scale * vy, scale * vz
    a, b, d, e = q[0], q[1], q[2], q[3]
    q[0] = a * c - b * x - d * y - e * z
    q[1] = a * x + b * c + d * z - e * y
    q[2] = a * y - b * z + d * c + e * x
    q[3] = a * z + b * y - d * x + e * c
    norm = 1.0 / sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] *= norm


@njit(cache=True)
def log_factor(w):
    """g, g' and g'' for the rotation vector g(w) v of a unit quaternion (w, v), w >= 0."""
    z = 0.5 * (1.0 - w)
    if z < 0.02:
        # Series of 2 arcsin(sqrt z) / sqrt(z (1 - z)); ratio of coefficients 2k / (2k + 1).
        coefficient = 1.0
        power = 1.0
        value = 1.0
        first = 0.0
        second = 0.0
        power_1 = 1.0
        power_2 = 1.0
        for k in range(1, 11):
            coefficient *= 2.0 * k / (2.0 * k + 1.0)
            if k > 1:
                second += coefficient * k * (k - 1) * power_2
                power_2 *= z
            first += coefficient * k * power_1
            power_1 *= z
            power *= z
            value += coefficient * power
        return 2.0 * value, -first, 0.5 * second
    s2 = 1.0 - w * w
    g = 2.0 * acos(w) / sqrt(s2)
    dg = (w * g - 2.0) / s2
    return g, dg, (g + 3.0 * w * dg) / s2


@njit(cache=True)
def _bending(q, B, rest, D, grad_a, grad_b, H_aa, H_bb, H_ab, with_hessian):
    """Energy of one bend; update its derivatives by the turns a and b of the frames it joins.

    ``q`` (4,) is the relative quaternion; a and b act as exp(-a/2) q exp(b/2).
    """
    w, v0, v1, v2 = q[0], q[1], q[2], q[3]
    g, dg, ddg = log_factor(w)
    v = (v0, v1, v2)
    m0 = B[0] * (g * v0 / D - rest[0])
    m1 = B[1] * (g * v1 / D - rest[1])
    m2 = B[2] * (g * v2 / D - rest[2])
    m = (m0, m1, m2)
    energy = 0.0
    for i in range(3):
        energy += 0.5 * D * m[i] * m[i] / B[i]
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
    E_ww = ddg * mv + dg * dg * (B[0] * v0 * v0 + B[1] * v1 * v1 + B[2] * v2 * v2) / D
    T = np.empty((4, 6))
    for c in range(6):
        T[0, c] = E_ww * J[0, c]
    for k in range(3):
        E_wk = dg * (m[k] + B[k] * g * v[k] / D)
        E_kk = B[k] * g * g / D
        for c in range(6):
            T[0, c] += E_wk * J[k + 1, c]
            T[k + 1, c] = E_wk * J[0, c] + E_kk * J[k + 1, c]
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
def assemble_rod(rod, x, q, ends, work, with_hessian):
    """Elastic energy and that of dead loads [J]; overwrites ``work`` but for its stress.

    The band is written ``with_hessian`` only.
    """
    stress, gradient, band, clamp_terms = work
    n = q.shape[0]
    energy = 0.0
    gradient[:] = 0.0
    if with_hessian:
        band[:] = 0.0
    for i in range(n + 1):
        for k in range(3):
            energy -= rod.forces[i, k] * x[i, k]
            gradient[6 * i + k] = -rod.forces[i, k]

    R = np.empty((3, 3))
    p = np.empty(3)
    C = np.empty((3, 3))
    P = np.zeros((3, 3))
    for e in range(n):
        base = 6 * e
        length = rod.rest_length[e]
        S = rod.shear[e]
        quaternion_to_columns(q[e], R)
        for i in range(3):
            p[i] = 0.0
            for k in range(3):
                p[i] += R[k, i] * (x[e + 1, k] - x[e, k])
            p[i] /= length
        rest = rod.rest_strain[e]
        g0, g1, g2 = p[0] - rest[0], p[1] - rest[1], p[2] - 1.0 - rest[2]
        n0, n1, n2 = S[0] * g0, S[1] * g1, S[2] * g2
        energy += 0.5 * length * (n0 * g0 + n1 * g1 + n2 * g2)
        for k in range(3):
            force = R[k, 0] * n0 + R[k, 1] * n1 + R[k, 2] * n2
            gradient[base + k] -= force
            gradient[base + 6 + k] += force
        gradient[base + 3] += length * (n1 * p[2] - n2 * p[1])
        gradient[base + 4] += length * (n2 * p[0] - n0 * p[2])
        gradient[base + 5] += length * (n0 * p[1] - n1 * p[0])
        if not with_hessian:
            continue
        s0, s1, s2 = stress[e, 0], stress[e, 1], stress[e, 2]
        # P = S [p]x - [s]x
        P[0, 1] = -S[0] * p[2] + s2
        P[0, 2] = S[0] * p[1] - s1
        P[1, 0] = S[1] * p[2] - s2
        P[1, 2] = -S[1] * p[0] + s0
        P[2, 0] = -S[2] * p[1] + s1
        P[2, 1] = S[2] * p[0] - s0
        for i in range(3):
            for j in range(3):
                C[i, j] = R[i, 0] * P[0, j] + R[i, 1] * P[1, j] + R[i, 2] * P[2, j]
        for j in range(3):
            for i in range(j, 3):
                stretch = (
                    R[i, 0] * S[0] * R[j, 0] + R[i, 1] * S[1] * R[j, 1] + R[i, 2] * S[2] * R[j, 2]
                ) / length
                band[base + j, i - j] += stretch
                band[base + 6 + j, i - j] += stretch
                band[base + j, 6 + i - j] -= stretch
                if i != j:
                    band[base + i, 6 + j - i] -= stretch
            for i in range(3):
                band[base + j, 3 + i - j] -= C[j, i]
                band[base + 3 + j, 3 + i - j] += C[i, j]
        sp = s0 * p[0] + s1 * p[1] + s2 * p[2]
        a, b, c = p[0], p[1], p[2]
        theta = base + 3
        band[theta, 0] += length * (S[1] * c * c + S[2] * b * b + s0 * a - sp)
        band[theta + 1, 0] += length * (S[0] * c * c + S[2] * a * a + s1 * b - sp)
        band[theta + 2, 0] += length * (S[0] * b * b + S[1] * a * a + s2 * c - sp)
        band[theta, 1] += length * (-S[2] * a * b + 0.5 * (s0 * b + s1 * a))
        band[theta, 2] += length * (-S[1] * a * c + 0.5 * (s0 * c + s2 * a))
        band[theta + 1, 1] += length * (-S[0] * b * c + 0.5 * (s1 * c + s2 * b))

    relative = np.empty(4)
    grad_a = np.empty(3)
    grad_b = np.empty(3)
    H_aa = np.empty((3, 3))
    H_bb = np.empty((3, 3))
    H_ab = np.empty((3, 3))
    for i in range(n + 1):
        if i == n and not ends.right_held:
            continue
        before = ends.frames[0] if i == 0 else q[i - 1]
        after = ends.frames[1] if i == n else q[i]
        relative_quaternion(before, after, relative)
        energy += _bending(
            relative, rod.bending[i], rod.rest_curvature[i], rod.voronoi_length[i],
            grad_a, grad_b, H_aa, H_bb, H_ab, with_hessian,
        )  # fmt: skip
        left, right = 6 * (i - 1) + 3, 6 * i + 3
        if i == 0:
            clamp_terms[0, 0] = grad_a
            for j in range(3):
                for k in range(3):
                    clamp_terms[0, 1 + j, k] = H_ab[k, j]
        else:
            for k in range(3):
                gradient[left + k] += grad_a[k]
        if i == n:
            clamp_terms[1, 0] = grad_b
            clamp_terms[1, 1:] = H_ab
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
