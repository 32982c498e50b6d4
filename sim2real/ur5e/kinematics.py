"""Poses as numbers, and the joint angles of one arm's TCP pose."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.exceptions import UnreachablePose
from dlo_gym.geometry.se3 import (
    Array,
    exp_so3,
    inverse,
    matrix_to_quaternion,
    pose,
    quaternion_to_matrix,
)
from dlo_gym.scene.ur5e import ik_branches, link_frames, nearest_turn


def pose_numbers(transform: Array) -> tuple[float, ...]:
    """x y z [m] and a unit quaternion wxyz of a pose (4, 4)."""
    quaternion = matrix_to_quaternion(transform[:3, :3])
    return (*transform[:3, 3].tolist(), *quaternion.tolist())


def pose_matrix(numbers: Sequence[float]) -> Array:
    """The pose (4, 4) of x y z [m] and a unit quaternion wxyz."""
    return pose(quaternion_to_matrix(numbers[3:]), numbers[:3])


def pose_vector_matrices(vectors: ArrayLike) -> Array:
    """Poses (..., 4, 4) of UR pose vectors (..., 6): x y z [m] and a rotation vector [rad]."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return pose(exp_so3(vectors[..., 3:]), vectors[..., :3])


def tcp_poses(joint_angles: ArrayLike, T_flange_tcp: Array) -> Array:
    """TCP poses (..., 4, 4) in the arm's base frame, at joint angles (..., 6) [rad]."""
    return link_frames(joint_angles)[..., 6, :, :] @ T_flange_tcp


def nearest_joint_angles(T_base_tcp: Array, T_flange_tcp: Array, guess: Array, name: str) -> Array:
    """Joint angles (6,) [rad] of a TCP pose (4, 4), of up to eight solutions the nearest.

    Args:
        T_base_tcp: (4, 4) in the arm's base frame.
        T_flange_tcp: (4, 4) tool centre point.
        guess: (6,) [rad] to stay near to.
        name: of the arm, for the message.

    Raises:
        UnreachablePose: when there is no solution.
    """
    branches = ik_branches(T_base_tcp @ inverse(T_flange_tcp), guess[5])
    branches = branches[np.isfinite(branches[:, 0])]
    if not len(branches):
        raise UnreachablePose(
            f"{name} arm cannot reach the TCP pose at {np.round(T_base_tcp[:3, 3], 4).tolist()} m"
            f" along {np.round(T_base_tcp[:3, 2], 3).tolist()} in its base frame"
        )
    branches = nearest_turn(branches, guess)
    return branches[np.argmin(np.square(branches - guess).sum(axis=1))]
