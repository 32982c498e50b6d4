"""Velocities of directors and strains, and where the clamps are at a time.

"Places" and their speeds are (3 n + 1, 3): the n + 1 nodes, then d1 and d2 of every element.
Angular velocities w (n, 3) [rad/s] are in the elements' own frames.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_energy import log_factor, quaternion_to_columns, relative_quaternion


class ClampPath(NamedTuple):
    """Clamps that move with constant velocity and angular velocity.

    Attributes:
        positions: (2, 3) at the start [m].
        frames: (2, 4) quaternions at the start.
        velocity: (12,) left then right, world axes: translation [m/s], rotation [rad/s].
    """

    positions: np.ndarray
    frames: np.ndarray
    velocity: np.ndarray


@njit(cache=True)
def clamps_at(path, time, positions, frames):
    """Update ``positions`` (2, 3) and ``frames`` (2, 4) to the clamps at ``time`` [s]."""
    for side in range(2):
        base = 6 * side
        r0, r1, r2 = path.velocity[base + 3], path.velocity[base + 4], path.velocity[base + 5]
        half = 0.5 * time * np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
        scale = 0.5 * time * (np.sin(half) / half if half > 1e-8 else 1.0)
        c, x, y, z = np.cos(half), scale * r0, scale * r1, scale * r2
        q = path.frames[side]
        frames[side, 0] = c * q[0] - x * q[1] - y * q[2] - z * q[3]
        frames[side, 1] = c * q[1] + x * q[0] + y * q[3] - z * q[2]
        frames[side, 2] = c * q[2] + y * q[0] + z * q[1] - x * q[3]
        frames[side, 3] = c * q[3] + z * q[0] + x * q[2] - y * q[1]
        for k in range(3):
            positions[side, k] = path.positions[side, k] + time * path.velocity[base + k]


@njit(cache=True)
def directors(q, places):
    """Update the directors' rows of ``places``."""
    n = q.shape[0]
    R = np.empty((3, 3))
    for e in range(n):
        quaternion_to_columns(q[e], R)
        for j in range(2):
            for k in range(3):
                places[n + 1 + 2 * e + j, k] = R[k, j]


@njit(cache=True)
def director_velocities(q, w, speeds):
    """Update the directors' rows of ``speeds``: d1' = w3 d2 - w2 d3, d2' = w1 d3 - w3 d1."""
    n = q.shape[0]
    R = np.empty((3, 3))
    for e in range(n):
        quaternion_to_columns(q[e], R)
        row = n + 1 + 2 * e
        for k in range(3):
            speeds[row, k] = w[e, 2] * R[k, 1] - w[e, 1] * R[k, 2]
            speeds[row + 1, k] = w[e, 0] * R[k, 2] - w[e, 2] * R[k, 0]


@njit(cache=True)
def angular_velocities(q, speeds, w):
    """Update ``w`` to the spins with the angular momentum of the directors' speeds."""
    n = q.shape[0]
    R = np.empty((3, 3))
    for e in range(n):
        quaternion_to_columns(q[e], R)
        row = n + 1 + 2 * e
        w0, w1, w2 = 0.0, 0.0, 0.0
        for k in range(3):
            w0 += R[k, 2] * speeds[row + 1, k]
            w1 -= R[k, 2] * speeds[row, k]
            w2 += 0.5 * (R[k, 1] * speeds[row, k] - R[k, 0] * speeds[row + 1, k])
        w[e, 0], w[e, 1], w[e, 2] = w0, w1, w2


@njit(cache=True)
def accelerations(motion, q, w, speeds, gradient, out):
    """Update ``out`` (3 n + 1, 3) to the places' accelerations given the potential's gradient.

    For elements these are Euler's equations of a body with moments of inertia J, J, 2 J.
    """
    n = q.shape[0]
    R = np.empty((3, 3))
    damping = motion.external
    for i in range(n + 1):
        for k in range(3):
            out[i, k] = -gradient[6 * i + k] / motion.mass[i] - damping * speeds[i, k]
    for e in range(n):
        quaternion_to_columns(q[e], R)
        row, theta = n + 1 + 2 * e, 6 * e + 3
        spin_mass = motion.mass[row]
        w0, w1, w2 = w[e, 0], w[e, 1], w[e, 2]
        a0 = -gradient[theta] / spin_mass - w1 * w2 - damping * w0
        a1 = -gradient[theta + 1] / spin_mass + w0 * w2 - damping * w1
        a2 = -0.5 * gradient[theta + 2] / spin_mass - damping * w2
        square = w0 * w0 + w1 * w1 + w2 * w2
        for k in range(3):
            d0, d1, d2 = R[k, 0], R[k, 1], R[k, 2]
            along = w0 * d0 + w1 * d1 + w2 * d2
            # alpha x d + w x (w x d)
            out[row, k] = a2 * d1 - a1 * d2 + w0 * along - square * d0
            out[row + 1, k] = a0 * d2 - a2 * d0 + w1 * along - square * d1


@njit(cache=True)
def strain_rates(rod, x, q, ends, v, w, clamp_spin, rates):
    """Update ``rates`` (2 n + 1, 3): d gamma/dt of the elements, then d kappa/dt of the nodes.

    ``clamp_spin`` (2, 3) [rad/s] is that of the clamps, in the clamps' frames.
    """
    n = q.shape[0]
    R = np.empty((3, 3))
    p, u = np.empty(3), np.empty(3)
    relative = np.empty(4)
    for e in range(n):
        quaternion_to_columns(q[e], R)
        for i in range(3):
            p[i], u[i] = 0.0, 0.0
            for k in range(3):
                p[i] += R[k, i] * (x[e + 1, k] - x[e, k])
                u[i] += R[k, i] * (v[e + 1, k] - v[e, k])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            rates[e, i] = (u[i] + p[j] * w[e, k] - p[k] * w[e, j]) / rod.rest_length[e]
    for i in range(n + 1):
        if i == n and not ends.right_held:
            for k in range(3):
                rates[n + i, k] = 0.0
            continue
        a = clamp_spin[0] if i == 0 else w[i - 1]
        b = clamp_spin[1] if i == n else w[i]
        relative_quaternion(
            ends.frames[0] if i == 0 else q[i - 1], ends.frames[1] if i == n else q[i], relative
        )
        r, s = relative[0], relative[1:]
        g, dg, _ = log_factor(r)
        # d(conj(A) B) = (-a q + q b) / 2
        dr = 0.5 * ((a[0] - b[0]) * s[0] + (a[1] - b[1]) * s[1] + (a[2] - b[2]) * s[2])
        for k in range(3):
            j, m = (k + 1) % 3, (k + 2) % 3
            ds = 0.5 * (r * (b[k] - a[k]) + s[j] * (a[m] + b[m]) - s[m] * (a[j] + b[j]))
            rates[n + i, k] = (dg * dr * s[k] + g * ds) / rod.voronoi_length[i]


@njit(cache=True)
def kinetic_energy(motion, v, w):
    """Kinetic energy [J]."""
    n = w.shape[0]
    energy = 0.0
    for i in range(n + 1):
        energy += 0.5 * motion.mass[i] * (v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
    for e in range(n):
        square = w[e, 0] ** 2 + w[e, 1] ** 2 + 2.0 * w[e, 2] ** 2
        energy += 0.5 * motion.mass[n + 1 + 2 * e] * square
    return energy
