"""Rotations and rigid transforms, batched over leading axes.

Rotations are 3x3 matrices ``R_a_b`` (columns: the axes of b seen in a), poses are 4x4 matrices
``T_a_b`` with ``T_a_b @ p_b = p_a``; quaternions are unit, ``wxyz``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from dlo_gym.geometry import _kernels_rotations as kernels

Array = NDArray[np.float64]


def exp_so3(rotation_vectors: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    vectors = np.asarray(rotation_vectors, dtype=np.float64)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return matrices.reshape(*vectors.shape, 3)


def log_so3(rotations: ArrayLike) -> Array:
    """Rotation vectors (..., 3) [rad], norm at most pi, of rotation matrices (..., 3, 3)."""
    matrices = np.asarray(rotations, dtype=np.float64)
    vectors = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
    return vectors.reshape(matrices.shape[:-1])


def matrix_to_quaternion(rotations: ArrayLike) -> Array:
    """Unit quaternions wxyz (..., 4), w >= 0, of rotation matrices (..., 3, 3)."""
    matrices = np.array(rotations, dtype=np.float64)
    single = matrices.reshape(-1, 3, 3)
    quaternions = np.empty((len(single), 4))
    if not kernels.matrix_to_quaternion(single, quaternions):
        # SciPy finds the nearest rotation, or says what is wrong.
        xyzw = Rotation.from_matrix(single).as_quat(canonical=True)
        quaternions = np.roll(xyzw, 1, axis=-1)
    return quaternions.reshape(*matrices.shape[:-2], 4)


def quaternion_to_matrix(quaternions: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions wxyz (..., 4)."""
    wxyz = np.asarray(quaternions, dtype=np.float64)
    xyzw = np.roll(wxyz.reshape(-1, 4), -1, axis=-1)
    return Rotation.from_quat(xyzw).as_matrix().reshape(*wxyz.shape[:-1], 3, 3)


def pose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """The pose (..., 4, 4) made of rotation (..., 3, 3) and translation (..., 3) [m]."""
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    transform = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
    return transform


def inverse(transform: ArrayLike) -> Array:
    """The inverse (..., 4, 4) of rigid transforms (..., 4, 4)."""
    transform = np.asarray(transform, dtype=np.float64)
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    return pose(rotation, -np.squeeze(rotation @ transform[..., :3, 3:], -1))


def transform_points(transform: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) of frame b seen in frame a, by ``T_a_b`` (4, 4)."""
    transform = np.asarray(transform, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]


def frame_along(tangent: ArrayLike, reference: ArrayLike) -> Array:
    """A rotation (3, 3) with d3 along ``tangent`` (3,) and d1 closest to ``reference`` (3,).

    Raises:
        ValueError: if the two are parallel or one is zero.
    """
    tangent = np.asarray(tangent, dtype=np.float64)
    d3 = tangent / np.linalg.norm(tangent)
    across = np.asarray(reference, dtype=np.float64)
    across = across - float(across @ d3) * d3
    norm = float(np.linalg.norm(across))
    if not norm > 1e-9:
        raise ValueError(f"reference {reference} must not be parallel to tangent {tangent}")
    d1 = across / norm
    return np.column_stack([d1, np.cross(d3, d1), d3])


def check_pose(transform: ArrayLike, name: str, tolerance: float = 1e-6) -> Array:
    """``transform`` as float64 array (..., 4, 4), after checking that it is rigid.

    Raises:
        ValueError: naming ``name``, if the shape is wrong, a value is not finite, or the
            rotation is not orthonormal and right-handed to ``tolerance``.
    """
    transform = np.ascontiguousarray(transform, dtype=np.float64)
    if transform.shape[-2:] != (4, 4):
        raise ValueError(f"{name}: expected a pose of shape (..., 4, 4), got {transform.shape}")
    if not np.isfinite(transform).all():
        raise ValueError(f"{name}: expected finite values, got NaN or infinity")
    rotation = transform[..., :3, :3]
    error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(initial=0.0)
    if error > tolerance or not (np.linalg.det(rotation) > 0).all():
        raise ValueError(
            f"{name}: expected a rigid transform, got a rotation part that is off by {error:.2g}"
            " from orthonormal or is left-handed"
        )
    if np.abs(transform[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) > tolerance:
        raise ValueError(f"{name}: expected the last row 0 0 0 1, got {transform[..., 3, :]}")
    return transform


def check_single_pose(transform: ArrayLike, name: str) -> Array:
    """``transform`` as float64 array (4, 4), after checking that it is one rigid transform.

    Raises:
        ValueError: naming ``name``, on another shape or where ``check_pose`` does.
    """
    single = check_pose(transform, name)
    if single.ndim != 2:
        raise ValueError(f"{name}: expected one pose of shape (4, 4), got {single.shape}")
    return single
