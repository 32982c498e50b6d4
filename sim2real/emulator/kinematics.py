"""Kinematics of the UR5e as its controller computes them: compiled kernels on plain arrays.

Written apart from ``dlo_gym.scene.arms`` on purpose, so that the emulated robot and the code that
drives it do not share a mistake. Poses are 4x4 matrices in the base frame (DH frame 0); pose
vectors are the robot's [x y z rx ry rz] in [m] and [rad], a rotation vector.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Denavit-Hartenberg parameters of the UR5e, Universal Robots' public table [m], [rad].
_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
_COS_ALPHA = np.array([0.0, 1.0, 1.0, 0.0, 0.0, 1.0])
_SIN_ALPHA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0])

# Below this |det J| the arm is as good as singular; about 0.05 in the middle of its workspace.
SINGULAR_DETERMINANT = 2e-4
_NEWTON_STEPS = 30
_LARGEST_NEWTON_STEP = 0.5  # rad, keeps the iteration on the branch it starts from


@njit(cache=True)
def _axes_and_flange(q: Array, axes: Array, origins: Array, T: Array) -> None:
    """Update joint axes (6, 3), their origins (6, 3) and the flange ``T`` (4, 4) given q (6,)."""
    T[:] = 0.0
    for i in range(4):
        T[i, i] = 1.0
    for i in range(6):
        c, s = np.cos(q[i]), np.sin(q[i])
        ca, sa = _COS_ALPHA[i], _SIN_ALPHA[i]
        for row in range(3):
            x, y, z = T[row, 0], T[row, 1], T[row, 2]
            axes[i, row] = z
            origins[i, row] = T[row, 3]
            across = y * c - x * s
            T[row, 0] = x * c + y * s
            T[row, 1] = across * ca + z * sa
            T[row, 2] = z * ca - across * sa
            T[row, 3] += T[row, 0] * _A[i] + z * _D[i]


@njit(cache=True)
def _multiply(first: Array, second: Array, out: Array) -> None:
    """Update ``out`` = ``first`` ``second``, rigid transforms (4, 4); ``out`` is neither."""
    for i in range(3):
        for j in range(4):
            out[i, j] = (
                first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]
            )
        out[i, 3] += first[i, 3]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@njit(cache=True)
def forward(q: Array, T_flange_tcp: Array) -> Array:
    """``T_base_tcp`` (4, 4) of joint angles q (6,) [rad]."""
    flange, tcp = np.empty((4, 4)), np.empty((4, 4))
    _axes_and_flange(q, np.empty((6, 3)), np.empty((6, 3)), flange)
    _multiply(flange, T_flange_tcp, tcp)
    return tcp


@njit(cache=True)
def forward_and_jacobian(q: Array, T_flange_tcp: Array, T_base_tcp: Array, jacobian: Array) -> None:
    """Update the TCP pose (4, 4) and its geometric Jacobian (6, 6), base axes, given q (6,)."""
    axes, origins, flange = np.empty((6, 3)), np.empty((6, 3)), np.empty((4, 4))
    _axes_and_flange(q, axes, origins, flange)
    _multiply(flange, T_flange_tcp, T_base_tcp)
    for i in range(6):
        x = T_base_tcp[0, 3] - origins[i, 0]
        y = T_base_tcp[1, 3] - origins[i, 1]
        z = T_base_tcp[2, 3] - origins[i, 2]
        jacobian[0, i] = axes[i, 1] * z - axes[i, 2] * y
        jacobian[1, i] = axes[i, 2] * x - axes[i, 0] * z
        jacobian[2, i] = axes[i, 0] * y - axes[i, 1] * x
        jacobian[3, i] = axes[i, 0]
        jacobian[4, i] = axes[i, 1]
        jacobian[5, i] = axes[i, 2]


@njit(cache=True)
def solve6(matrix: Array, right: Array) -> float:
    """Update ``right`` (6,) to matrix^-1 right and return |det matrix|; destroys ``matrix``.

    Gaussian elimination with partial pivoting. At a zero pivot it returns 0 and ``right`` is void.
    """
    determinant = 1.0
    for k in range(6):
        pivot = k
        for i in range(k + 1, 6):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        largest = matrix[pivot, k]
        if abs(largest) < 1e-12:
            return 0.0
        determinant *= abs(largest)
        if pivot != k:
            for j in range(6):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            right[k], right[pivot] = right[pivot], right[k]
        for i in range(k + 1, 6):
            factor = matrix[i, k] / largest
            for j in range(k + 1, 6):
                matrix[i, j] -= factor * matrix[k, j]
            right[i] -= factor * right[k]
    for k in range(5, -1, -1):
        for j in range(k + 1, 6):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]
    return determinant


@njit(cache=True)
def rotation_vector(R: Array, out: Array) -> None:
    """Update ``out`` (3,) [rad] to the rotation vector, norm <= pi, of R (3, 3) or wider.

    By the quaternion with the largest component first, which is stable at every angle.
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        w = 1.0 + trace
        x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        x = 1.0 + R[0, 0] - R[1, 1] - R[2, 2]
        w, y, z = R[2, 1] - R[1, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        y = 1.0 + R[1, 1] - R[0, 0] - R[2, 2]
        w, x, z = R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], R[2, 1] + R[1, 2]
    else:
        z = 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
        w, x, y = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 * w else 2.0 / w
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True)
def pose_matrix(vector: Array, out: Array) -> None:
    """Update ``out`` (4, 4) to the transform of a pose vector (6,), by Rodrigues' formula."""
    rx, ry, rz = vector[3], vector[4], vector[5]
    angle = np.sqrt(rx * rx + ry * ry + rz * rz)
    if angle > 1e-7:
        s, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    else:
        s, c = 1.0, 0.5
    diagonal = 1.0 - c * angle * angle
    out[0, 0], out[1, 1], out[2, 2] = (
        diagonal + c * rx * rx,
        diagonal + c * ry * ry,
        diagonal + c * rz * rz,
    )
    out[0, 1], out[1, 0] = c * rx * ry - s * rz, c * rx * ry + s * rz
    out[0, 2], out[2, 0] = c * rx * rz + s * ry, c * rx * rz - s * ry
    out[1, 2], out[2, 1] = c * ry * rz - s * rx, c * ry * rz + s * rx
    for i in range(3):
        out[i, 3], out[3, i] = vector[i], 0.0
    out[3, 3] = 1.0


@njit(cache=True)
def pose_vector(T: Array, out: Array) -> None:
    """Update the pose vector ``out`` (6,) given a transform (4, 4)."""
    for i in range(3):
        out[i] = T[i, 3]
    rotation_vector(T, out[3:])


@njit(cache=True)
def pose_difference(T_from: Array, T_to: Array, out: Array) -> None:
    """Update ``out`` (6,): the shift [m] and the rotation vector [rad], base axes, between poses.

    R_to = exp(out[3:]) R_from, in the axes the geometric Jacobian has.
    """
    R = np.empty((3, 3))
    for i in range(3):
        out[i] = T_to[i, 3] - T_from[i, 3]
        for j in range(3):
            R[i, j] = (
                T_to[i, 0] * T_from[j, 0] + T_to[i, 1] * T_from[j, 1] + T_to[i, 2] * T_from[j, 2]
            )
    rotation_vector(R, out[3:])


@njit(cache=True)
def inverse_from(T_base_tcp: Array, T_flange_tcp: Array, q: Array, tolerance: float) -> float:
    """Update q (6,) to joint angles that reach a TCP pose, by Newton's method from q.

    Returns |det J| at the solution, 0 where the iteration met a singularity or did not get within
    ``tolerance`` ([m] and [rad] alike).
    """
    T, J, step = np.empty((4, 4)), np.empty((6, 6)), np.empty(6)
    for _ in range(_NEWTON_STEPS):
        forward_and_jacobian(q, T_flange_tcp, T, J)
        pose_difference(T, T_base_tcp, step)
        error = 0.0
        for i in range(6):
            error = max(error, abs(step[i]))
        determinant = solve6(J, step)
        if error <= tolerance:
            return determinant
        if determinant == 0.0:
            return 0.0
        largest = 0.0
        for i in range(6):
            largest = max(largest, abs(step[i]))
        scale = min(1.0, _LARGEST_NEWTON_STEP / largest) if largest > 0.0 else 1.0
        for i in range(6):
            q[i] += scale * step[i]
    return 0.0


def transform(pose: Array | list[float]) -> Array:
    """The transform (4, 4) of a pose vector (6,) [m], [rad]."""
    T = np.empty((4, 4))
    pose_matrix(np.asarray(pose, dtype=np.float64), T)
    return T


def vector(T: Array) -> Array:
    """The pose vector (6,) [m], [rad] of a transform (4, 4)."""
    pose = np.empty(6)
    pose_vector(np.ascontiguousarray(T, dtype=np.float64), pose)
    return pose


@njit(cache=True)
def report(
    q: Array, qd: Array, qdd: Array, T_flange_tcp: Array, wrench: Array, zero: Array, live: Array
) -> float:
    """Update what the controller reports, ``live`` (11, 6) as ``OutputImage.live`` has it.

    Returns the square of the force [N^2].
    """
    T, J = np.empty((4, 4)), np.empty((6, 6))
    forward_and_jacobian(q, T_flange_tcp, T, J)
    pose_vector(T, live[5])
    for i in range(6):
        live[0, i] = live[1, i] = q[i]
        live[2, i] = live[3, i] = qd[i]
        live[4, i] = qdd[i]
        live[6, i] = live[5, i]
        speed = 0.0
        for j in range(6):
            speed += J[i, j] * qd[j]
        live[7, i] = live[8, i] = speed
        live[9, i] = wrench[i] - zero[i]
        live[10, i] = wrench[i]
    return live[9, 0] ** 2 + live[9, 1] ** 2 + live[9, 2] ** 2


def inverse_nearest(T_base_tcp: Array, T_flange_tcp: Array, near: Array) -> Array | None:
    """Joint angles (6,) [rad] within the limits that reach a TCP pose, closest to ``near``.

    Newton's method from ``near`` and, where that ends far away or nowhere, from the other ways
    the arm can fold. None where no start leads to a solution.
    """
    best, nearest = None, np.inf
    around = np.arctan2(T_base_tcp[1, 3], T_base_tcp[0, 3])
    folds = [
        np.array([base, lift, elbow, -1.57, wrist, near[5]])
        for base, lift in ((around + np.pi - 0.3, -1.2), (around + 0.3, -1.9))
        for elbow in (1.6, -1.6)
        for wrist in (1.5, -1.5)
    ]
    for start in (near, *folds):
        q = np.array(start, dtype=np.float64)
        if inverse_from(T_base_tcp, T_flange_tcp, q, 1e-10) == 0.0:
            continue
        q += 2 * np.pi * np.round((near - q) / (2 * np.pi))
        q -= 2 * np.pi * np.sign(q) * (np.abs(q) > 2 * np.pi)
        away = float(np.abs(q - near).max())
        if away < nearest:
            best, nearest = q, away
        if nearest < 1.0:
            break
    return best
