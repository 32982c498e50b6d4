"""The potential of inertia in one implicit time step.

A node is a mass m, a round section's spin two masses m r^2 / 4 at the tips of the directors d1 and
d2, whose velocities are those of d1 and d2: the kinetic energy of a Cosserat rod (Simo and Vu-Quoc
1988). An implicit stage of length s seeks the minimum of

    sum m / (2 s^2) |x - x^|^2 + sum J / (2 s^2) (|d1 - d1^|^2 + |d2 - d2^|^2) + elastic energy

where the hatted places are those without acceleration in the stage.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_energy import quaternion_to_columns


class Inertia(NamedTuple):
    """Springs to where nodes and directors would go unaccelerated; empty arrays for equilibria.

    Rows are those of "places": the n + 1 nodes, then d1 and d2 of every element in turn.

    Attributes:
        weight: (3 n + 1,) m / s^2 [N/m], J / s^2 [N m].
        centre: (3 n + 1, 3) x^ [m], d1^ and d2^ [-].
    """

    weight: np.ndarray
    centre: np.ndarray


NO_INERTIA = Inertia(np.zeros(0), np.zeros((0, 3)))


@njit(cache=True)
def add_inertia(inertia, x, q, work, with_hessian):
    """Potential [J] of inertia, added to ``work``'s gradient and, ``with_hessian``, its band."""
    gradient, band = work.gradient, work.band
    energy = 0.0
    for i in range(x.shape[0]):
        weight = inertia.weight[i]
        for k in range(3):
            offset = x[i, k] - inertia.centre[i, k]
            energy += 0.5 * weight * offset * offset
            gradient[6 * i + k] += weight * offset
            if with_hessian:
                band[6 * i + k, 0] += weight
    R = np.empty((3, 3))
    Q = np.empty((3, 2))
    for e in range(q.shape[0]):
        row = x.shape[0] + 2 * e
        weight = inertia.weight[row]
        quaternion_to_columns(q[e], R)
        for j in range(2):
            c = inertia.centre[row + j]
            c0, c1, c2 = c[0], c[1], c[2]
            energy += (
                0.5 * weight * ((R[0, j] - c0) ** 2 + (R[1, j] - c1) ** 2 + (R[2, j] - c2) ** 2)
            )
            for k in range(3):
                Q[k, j] = R[0, k] * c0 + R[1, k] * c1 + R[2, k] * c2
        theta = 6 * e + 3
        gradient[theta] -= weight * Q[2, 1]
        gradient[theta + 1] += weight * Q[2, 0]
        gradient[theta + 2] += weight * (Q[0, 1] - Q[1, 0])
        if with_hessian:  # J (tr Q - sym Q), Q = R^T [d1^ d2^ 0]
            band[theta, 0] += weight * Q[1, 1]
            band[theta + 1, 0] += weight * Q[0, 0]
            band[theta + 2, 0] += weight * (Q[0, 0] + Q[1, 1])
            band[theta, 1] -= 0.5 * weight * (Q[0, 1] + Q[1, 0])
            band[theta, 2] -= 0.5 * weight * Q[2, 0]
            band[theta + 1, 1] -= 0.5 * weight * Q[2, 1]
    return energy
