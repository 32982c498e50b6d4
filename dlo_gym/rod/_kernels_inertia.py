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

    Attributes:
        node_weight: (n + 1,) m / s^2 [N/m].
        node_centre: (n + 1, 3) x^ [m].
        spin_weight: (n,) J / s^2 [N m].
        spin_centre: (n, 2, 3) d1^ and d2^ [-].
    """

    node_weight: np.ndarray
    node_centre: np.ndarray
    spin_weight: np.ndarray
    spin_centre: np.ndarray


NO_INERTIA = Inertia(np.zeros(0), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2, 3)))


@njit(cache=True)
def add_inertia(inertia, x, q, work, with_hessian):
    """Potential [J] of inertia, added to ``work``'s gradient and, ``with_hessian``, its band."""
    gradient, band = work.gradient, work.band
    energy = 0.0
    for i in range(x.shape[0]):
        weight = inertia.node_weight[i]
        for k in range(3):
            offset = x[i, k] - inertia.node_centre[i, k]
            energy += 0.5 * weight * offset * offset
            gradient[6 * i + k] += weight * offset
            if with_hessian:
                band[6 * i + k, 0] += weight
    R = np.empty((3, 3))
    Q = np.empty((3, 2))
    for e in range(q.shape[0]):
        weight = inertia.spin_weight[e]
        centre = inertia.spin_centre[e]
        quaternion_to_columns(q[e], R)
        for j in range(2):
            for k in range(3):
                offset = R[k, j] - centre[j, k]
                energy += 0.5 * weight * offset * offset
                Q[k, j] = R[0, k] * centre[j, 0] + R[1, k] * centre[j, 1] + R[2, k] * centre[j, 2]
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
