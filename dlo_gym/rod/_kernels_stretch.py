"""Shear and stretch of the elements: energy, gradient and Hessian."""

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_quaternions import quaternion_to_columns


@njit(cache=True, inline="always")
def add_stretch(rod, x, q, work, with_hessian):
    """Energy [J], added to ``work``'s gradient and, ``with_hessian``, its band.

    The Hessian's geometric part is that of ``work``'s stress.
    """
    stress, gradient, band = work.stress, work.gradient, work.band
    energy = 0.0
    R = np.empty((3, 3))
    p = np.empty(3)
    C = np.empty((3, 3))
    P = np.zeros((3, 3))
    for e in range(q.shape[0]):
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
    return energy
