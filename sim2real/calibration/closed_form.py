"""Closed-form hand-eye and robot-world calibration: the seven methods of OpenCV, in NumPy.

OpenCV 5.0's Python package leaves out ``calibrateHandEye`` and ``calibrateRobotWorldHandEye``
(OpenCV issue 29565), and these need no more than an SVD each. Two families, both for a fixed camera
that watches a board carried by the arm:

- hand-eye, ``A X = X B`` over all pairs of poses: A is the arm's motion seen from its base, B the
  board's motion seen from the camera, X = ``T_base_camera``;
- robot-world/hand-eye, ``A X = Z B`` over single poses: A = ``T_camera_board``, B = ``T_base_tcp``,
  X = ``T_board_tcp``, Z = ``T_camera_base``.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array, check_pose, inverse, log_so3, matrix_to_quaternion, pose

HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
ROBOT_WORLD = ("SHAH", "LI")
METHODS = HAND_EYE + ROBOT_WORLD
_SMALLEST_TSAI_ANGLE = np.radians(15.0)


def eye_to_hand(T_base_tcp: Array, T_camera_board: Array, method: str = "PARK") -> Array:
    """``T_base_camera`` (4, 4) of a fixed camera that saw a board in the arm's gripper.

    Args:
        T_base_tcp: (k, 4, 4) where the arm was, k >= 3, with rotations about two axes or more.
        T_camera_board: (k, 4, 4) where the camera saw the board.
        method: one of ``METHODS``.

    Raises:
        ValueError: on an unknown method, unequal or too few poses, or poses that leave the answer
            undetermined.
    """
    T_base_tcp = check_pose(T_base_tcp, "T_base_tcp")
    T_camera_board = check_pose(T_camera_board, "T_camera_board")
    if T_base_tcp.shape != T_camera_board.shape or T_base_tcp.ndim != 3 or len(T_base_tcp) < 3:
        raise ValueError(
            "T_base_tcp, T_camera_board: expected the same number of poses (k, 4, 4), at least 3,"
            f" got {T_base_tcp.shape} and {T_camera_board.shape}"
        )
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    try:
        if method in ROBOT_WORLD:
            solve = _shah if method == "SHAH" else _li
            T_base_camera = inverse(solve(T_camera_board, T_base_tcp))
        else:
            T_base_camera = _HAND_EYE_SOLVERS[method](*_motions(T_base_tcp, T_camera_board))
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{method}: {error}") from error
    if not np.isfinite(T_base_camera).all():
        raise ValueError(f"{method}: the poses leave T_base_camera undetermined")
    return T_base_camera


def _motions(T_base_tcp: Array, T_camera_board: Array) -> tuple[Array, Array]:
    """A and B (m, 4, 4) of ``A X = X B`` over all pairs of poses."""
    i, j = np.triu_indices(len(T_base_tcp), 1)
    A = T_base_tcp[j] @ inverse(T_base_tcp[i])
    B = T_camera_board[j] @ inverse(T_camera_board[i])
    return A, B


def _translation(R_X: Array, A: Array, B: Array) -> Array:
    """X from its rotation: least squares of ``(R_A - I) t_X = R_X t_B - t_A``."""
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ R_X.T - A[:, :3, 3]).ravel()
    return pose(R_X, np.linalg.lstsq(left, right, rcond=None)[0])


def _tsai(A: Array, B: Array) -> Array:
    """Tsai and Lenz 1989, "A new technique for fully autonomous and efficient 3D robotics
    hand/eye calibration", Eqs. (12), (14), (15)."""
    # As OpenCV does: small rotations say little about the axis and are left out.
    angles = [np.linalg.norm(log_so3(motion[:, :3, :3]), axis=1) for motion in (A, B)]
    large = np.min(angles, axis=0) > _SMALLEST_TSAI_ANGLE
    if large.sum() >= 3:
        A, B = A[large], B[large]
    a, b = _modified_rodrigues(A), _modified_rodrigues(B)
    left, right = _skew(a + b).reshape(-1, 3), (b - a).ravel()
    p = np.linalg.lstsq(left, right, rcond=None)[0]
    p = 2.0 * p / np.sqrt(1.0 + p @ p)
    R = (1.0 - p @ p / 2.0) * np.eye(3) + 0.5 * (
        np.outer(p, p) + np.sqrt(4.0 - p @ p) * _skew(p[None])[0]
    )
    return _translation(R, A, B)


def _park(A: Array, B: Array) -> Array:
    """Park and Martin 1994, "Robot sensor calibration: solving AX = XB on the Euclidean group"."""
    M = log_so3(B[:, :3, :3]).T @ log_so3(A[:, :3, :3])
    values, vectors = np.linalg.eigh(M.T @ M)
    with np.errstate(divide="ignore", invalid="ignore"):
        R = vectors @ np.diag(1.0 / np.sqrt(values)) @ vectors.T @ M.T
    return _translation(_nearest_rotation(R), A, B)


def _horaud(A: Array, B: Array) -> Array:
    """Horaud and Dornaika 1995, "Hand-eye calibration", the closed form by unit quaternions."""
    a, b = matrix_to_quaternion(A[:, :3, :3]), matrix_to_quaternion(B[:, :3, :3])
    C = _left_product(a) - _right_product(b)
    q = np.linalg.eigh(np.einsum("mij,mik->jk", C, C))[1][:, 0]
    return _translation(_quaternion_rotation(q), A, B)


def _andreff(A: Array, B: Array) -> Array:
    """Andreff, Horaud, Espiau 1999, "On-line hand-eye calibration": rotation and translation in
    one linear system."""
    m = len(A)
    left = np.zeros((m, 12, 12))
    left[:, :9, :9] = np.eye(9) - _kronecker(A[:, :3, :3], B[:, :3, :3])
    left[:, 9:, :9] = _kronecker(np.broadcast_to(np.eye(3), (m, 3, 3)), B[:, None, :3, 3])
    left[:, 9:, 9:] = np.eye(3) - A[:, :3, :3]
    right = np.zeros((m, 12))
    right[:, 9:] = A[:, :3, 3]
    x = np.linalg.lstsq(left.reshape(-1, 12), right.ravel(), rcond=None)[0]
    return pose(_nearest_rotation(_unit_determinant(x[:9].reshape(3, 3))), x[9:])


def _daniilidis(A: Array, B: Array) -> Array:
    """Daniilidis 1999, "Hand-eye calibration using dual quaternions", Eqs. (31) to (35)."""
    (a, a_dual), (b, b_dual) = _dual_quaternions(A), _dual_quaternions(B)
    T = np.zeros((len(A), 6, 8))
    T[:, :3, 0] = T[:, 3:, 4] = (a - b)[:, 1:]
    T[:, :3, 1:4] = T[:, 3:, 5:] = _skew((a + b)[:, 1:])
    T[:, 3:, 0] = (a_dual - b_dual)[:, 1:]
    T[:, 3:, 1:4] = _skew((a_dual + b_dual)[:, 1:])
    v7, v8 = np.linalg.svd(T.reshape(-1, 8), full_matrices=False)[2][6:]
    (u1, w1), (u2, w2) = np.split(v7, 2), np.split(v8, 2)
    roots = np.roots([u1 @ w1, u1 @ w2 + u2 @ w1, u2 @ w2]).real
    lengths = roots**2 * (u1 @ u1) + 2.0 * roots * (u1 @ u2) + u2 @ u2
    s, length = roots[np.argmax(lengths)], np.max(lengths)
    q, q_dual = (s * u1 + u2) / np.sqrt(length), (s * w1 + w2) / np.sqrt(length)
    conjugate = q * [1.0, -1.0, -1.0, -1.0]
    translation = 2.0 * (_left_product(q_dual[None])[0] @ conjugate)[1:]
    return pose(_quaternion_rotation(q), translation)


_HAND_EYE_SOLVERS: dict[str, Callable[[Array, Array], Array]] = {
    "TSAI": _tsai,
    "PARK": _park,
    "HORAUD": _horaud,
    "ANDREFF": _andreff,
    "DANIILIDIS": _daniilidis,
}


def _shah(A: Array, B: Array) -> Array:
    """Z of ``A X = Z B``. Shah 2013, "Solving the robot-world/hand-eye calibration problem using
    the Kronecker product"."""
    K = _kronecker(A[:, :3, :3], B[:, :3, :3]).sum(axis=0)
    u = np.linalg.svd(K)[0]
    R_Z = _nearest_rotation(_unit_determinant(u[:, 0].reshape(3, 3)))
    left = np.zeros((len(A), 3, 6))
    left[:, :, :3], left[:, :, 3:] = A[:, :3, :3], -np.eye(3)
    right = B[:, :3, 3] @ R_Z.T - A[:, :3, 3]
    t = np.linalg.lstsq(left.reshape(-1, 6), right.ravel(), rcond=None)[0]
    return pose(R_Z, t[3:])


def _li(A: Array, B: Array) -> Array:
    """Z of ``A X = Z B``. Li, Wang, Wu 2010, "Simultaneous robot-world and hand-eye calibration
    using dual-quaternions and Kronecker product", its linear system by Kronecker products."""
    m = len(A)
    eye = np.broadcast_to(np.eye(3), (m, 3, 3))
    left = np.zeros((m, 12, 24))
    left[:, :9, :9] = _kronecker(A[:, :3, :3], eye)
    left[:, :9, 9:18] = -_kronecker(eye, np.swapaxes(B[:, :3, :3], 1, 2))
    left[:, 9:, 9:18] = _kronecker(eye, B[:, None, :3, 3])
    left[:, 9:, 18:21] = -A[:, :3, :3]
    left[:, 9:, 21:] = np.eye(3)
    right = np.zeros((m, 12))
    right[:, 9:] = A[:, :3, 3]
    x = np.linalg.lstsq(left.reshape(-1, 24), right.ravel(), rcond=None)[0]
    return pose(_nearest_rotation(_unit_determinant(x[9:18].reshape(3, 3))), x[21:])


def _modified_rodrigues(transforms: Array) -> Array:
    """2 sin(angle / 2) times the axis (m, 3)."""
    return 2.0 * matrix_to_quaternion(transforms[:, :3, :3])[:, 1:]


def _dual_quaternions(transforms: Array) -> tuple[Array, Array]:
    """Real and dual parts (m, 4), the real part's w positive."""
    q = matrix_to_quaternion(transforms[:, :3, :3])
    t = np.concatenate([np.zeros((len(q), 1)), transforms[:, :3, 3]], axis=1)
    return q, 0.5 * np.einsum("mij,mj->mi", _left_product(t), q)


def _left_product(q: Array) -> Array:
    """Matrices (m, 4, 4) that multiply quaternions wxyz by q (m, 4) from the left."""
    matrices = q[:, :1, None] * np.eye(4)
    matrices[:, 1:, 1:] += _skew(q[:, 1:])
    matrices[:, 1:, 0], matrices[:, 0, 1:] = q[:, 1:], -q[:, 1:]
    return matrices


def _right_product(q: Array) -> Array:
    matrices = q[:, :1, None] * np.eye(4)
    matrices[:, 1:, 1:] -= _skew(q[:, 1:])
    matrices[:, 1:, 0], matrices[:, 0, 1:] = q[:, 1:], -q[:, 1:]
    return matrices


def _quaternion_rotation(q: Array) -> Array:
    w, v = q[0], q[1:]
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * _skew(v[None])[0]


def _skew(v: Array) -> Array:
    """Cross-product matrices (m, 3, 3) of vectors (m, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def _kronecker(first: Array, second: Array) -> Array:
    """Kronecker products (m, a c, b d) of matrices (m, a, b) and (m, c, d)."""
    m, a, b = first.shape
    _, c, d = second.shape
    return np.einsum("mab,mcd->macbd", first, second).reshape(m, a * c, b * d)


def _unit_determinant(matrix: NDArray) -> Array:
    """The multiple of a 3x3 matrix whose determinant is 1."""
    determinant = np.linalg.det(matrix)
    if abs(determinant) < 1e-12:
        raise np.linalg.LinAlgError("the poses leave the rotation undetermined")
    return np.sign(determinant) * abs(determinant) ** (-1.0 / 3.0) * matrix


def _nearest_rotation(matrix: Array) -> Array:
    if not np.isfinite(matrix).all():
        raise np.linalg.LinAlgError("the poses leave the rotation undetermined")
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
