"""The gradient's derivatives by the rod's parameters, at a given shape.

All goes through the stress n of elements and the moment of nodes: at a given shape the gradient is
linear in them, whatever they come from. With ``rate`` what internal damping eta multiplies, a
strain's rate or its difference quotient in a stage,

    n = S (gamma + eta rate),        moment = B (kappa - kappa0 + eta rate)
"""

from math import sqrt

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_bending import plastic_flow

LOG_EI, LOG_GJ, LOG_WEIGHT, REST_CURVATURE, LENGTH = 0, 1, 2, 3, 6  # three rest curvatures
EXTERNAL_DAMPING, INTERNAL_DAMPING = 7, 8


@njit(cache=True)
def lengthen(rod, geometry, codes, strain):
    """Add to ``strain`` (2 n + 1, 3, m) what the rest lengths change at a given shape."""
    n = geometry.R.shape[0]
    length = rod.rest_length.sum()
    for c in range(codes.shape[0]):
        if codes[c] != LENGTH:
            continue
        for k in range(3):
            for e in range(n):
                strain[e, k, c] -= geometry.span[e, k] / (rod.rest_length[e] * length)
            for i in range(n, 2 * n + 1):
                strain[i, k, c] -= geometry.strain[i, k] / length


@njit(cache=True)
def change_stress(rod, geometry, codes, eta, rate, stiffening, stress):
    """Add to ``stress`` (2 n + 1, 3, m), of elements and then of nodes, what the parameters change
    at a given shape and rate; ``stiffening`` is d(n)/d(gamma) over S."""
    n = geometry.R.shape[0]
    length = rod.rest_length.sum()
    strain = geometry.strain
    for c in range(codes.shape[0]):
        code = codes[c]
        if code in (LOG_EI, LOG_GJ):
            for i in range(n + 1):
                for k in range(2) if code == LOG_EI else range(2, 3):
                    bent = strain[n + i, k] - rod.rest_curvature[i, k] + eta * rate[n + i, k]
                    stress[n + i, k, c] += rod.bending[i, k] * bent
        elif REST_CURVATURE <= code < REST_CURVATURE + 3:
            k = code - REST_CURVATURE
            for i in range(n + 1):
                stress[n + i, k, c] -= rod.bending[i, k]
        elif code == LENGTH:
            for k in range(3):
                for e in range(n):
                    lost = geometry.span[e, k] / (rod.rest_length[e] * length)
                    stress[e, k, c] -= stiffening * rod.shear[e, k] * lost
                for i in range(n + 1):
                    lost = strain[n + i, k] / length
                    stress[n + i, k, c] -= stiffening * rod.bending[i, k] * lost
        elif code == INTERNAL_DAMPING:
            for k in range(3):
                for e in range(n):
                    stress[e, k, c] += rod.shear[e, k] * rate[e, k]
                for i in range(n + 1):
                    stress[n + i, k, c] += rod.bending[i, k] * rate[n + i, k]


@njit(cache=True)
def flow_with_parameters(rod, geometry, codes, stress):
    """Update the moments in ``stress``, elastic ones of ``change_stress``, where the rod yields."""
    n = geometry.R.shape[0]
    for i in range(n + 1):
        B, old, limit = rod.bending[i, 0], rod.plastic[i], rod.yield_moment[i]
        H = rod.hardening[i]
        m0 = B * (geometry.strain[n + i, 0] - rod.rest_curvature[i, 0] - old[0])
        m1 = B * (geometry.strain[n + i, 1] - rod.rest_curvature[i, 1] - old[1])
        flows = sqrt((m0 - H * old[0]) ** 2 + (m1 - H * old[1]) ** 2) > limit
        f0, f1, flow, size = 0.0, 0.0, 0.0, 1.0
        if flows:
            f0, f1, flow, size = plastic_flow(m0, m1, B, old, limit, H)
        across = B * flow / size
        less = B / (B + H) - across if flows else 0.0
        for c in range(codes.shape[0]):
            if codes[c] == LOG_EI:  # all moments in proportion, at the same flow
                stress[n + i, 0, c] = m0 - B * flow * f0
                stress[n + i, 1, c] = m1 - B * flow * f1
                continue
            s0, s1 = stress[n + i, 0, c], stress[n + i, 1, c]
            along = less * (f0 * s0 + f1 * s1)
            stress[n + i, 0, c] = (1.0 - across) * s0 - along * f0
            stress[n + i, 1, c] = (1.0 - across) * s1 - along * f1


@njit(cache=True)
def add_stress(geometry, right_held, stress, columns):
    """Add to ``columns`` (6 n + 3, m) the gradient of ``stress`` (2 n + 1, 3, m)."""
    R, span, bend = geometry.R, geometry.span, geometry.bend
    n, m = R.shape[0], columns.shape[1]
    for e in range(n):
        base = 6 * e
        for k in range(3):
            d1, d2, d3 = R[e, k, 0], R[e, k, 1], R[e, k, 2]
            i, j = (k + 1) % 3, (k + 2) % 3
            pi, pj = span[e, i], span[e, j]
            for c in range(m):
                force = d1 * stress[e, 0, c] + d2 * stress[e, 1, c] + d3 * stress[e, 2, c]
                columns[base + k, c] -= force
                columns[base + 6 + k, c] += force
                columns[base + 3 + k, c] += stress[e, i, c] * pj - stress[e, j, c] * pi
    for i in range(n + 1 if right_held else n):
        moment = stress[n + i]
        for side in range(2):
            if (side == 0 and i == 0) or (side == 1 and i == n):
                continue
            theta = 6 * i - 3 if side == 0 else 6 * i + 3
            for k in range(3):
                b0, b1, b2 = bend[i, side, 0, k], bend[i, side, 1, k], bend[i, side, 2, k]
                for c in range(m):
                    columns[theta + k, c] += (
                        b0 * moment[0, c] + b1 * moment[1, c] + b2 * moment[2, c]
                    )


@njit(cache=True)
def add_weight(codes, length, weight, columns):
    """Add to ``columns`` (6 n + 3, m) the gradient's change with the nodes' ``weight`` [N]."""
    for c in range(codes.shape[0]):
        if codes[c] == LOG_WEIGHT or codes[c] == LENGTH:
            scale = 1.0 if codes[c] == LOG_WEIGHT else 1.0 / length
            for i in range(weight.shape[0]):
                for k in range(3):
                    columns[6 * i + k, c] -= scale * weight[i, k]


@njit(cache=True)
def explicit_gradient(rod, geometry, codes, right_held, weight, columns):
    """Update ``columns`` (6 n + 3, m) to d(gradient)/d(parameters) of a rod at rest in the shape
    of ``geometry``."""
    n, m = geometry.R.shape[0], codes.shape[0]
    stress, still = np.zeros((2 * n + 1, 3, m)), np.zeros((2 * n + 1, 3))
    change_stress(rod, geometry, codes, 0.0, still, 1.0, stress)
    flow_with_parameters(rod, geometry, codes, stress)
    columns[:] = 0.0
    add_stress(geometry, right_held, stress, columns)
    add_weight(codes, rod.rest_length.sum(), weight, columns)
