"""Kinematics of one UR5e: from joint angles to link frames and back."""

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene import _kernels_arms as kernels
from dlo_gym.scene._kernels_arms import DH_A as DH_A
from dlo_gym.scene._kernels_arms import DH_ALPHA as DH_ALPHA
from dlo_gym.scene._kernels_arms import DH_D as DH_D
from dlo_gym.scene._kernels_arms import JOINT_LIMIT as JOINT_LIMIT


def link_frames(joint_angles: ArrayLike) -> Array:
    """DH frames 0 to 6 in the arm's base frame (..., 7, 4, 4) of joint angles (..., 6) [rad]."""
    q = np.asarray(joint_angles, dtype=np.float64)
    frames = np.empty((*q.shape[:-1], 7, 4, 4))
    kernels.link_frames(np.array(q).reshape(-1, 6), frames.reshape(-1, 7, 4, 4))
    return frames


def ik_branches(T_base_flange: ArrayLike, wrist_3: ArrayLike = 0.0) -> Array:
    """All joint angles that reach a flange pose, in closed form.

    Args:
        T_base_flange: (..., 4, 4) flange (DH frame 6) in the arm's base frame.
        wrist_3: (...) the last joint's angle [rad] where the wrist is singular and leaves it free.

    Returns:
        (..., 8, 6) joint angles in (-pi, pi]; a branch that does not exist is NaN.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    wrist_3 = np.asarray(wrist_3, dtype=np.float64)
    batch = np.broadcast_shapes(T.shape[:-2], wrist_3.shape)
    branches = np.empty((*batch, 8, 6))
    kernels.ik_branches(
        np.array(np.broadcast_to(T, (*batch, 4, 4))).reshape(-1, 4, 4),
        np.array(np.broadcast_to(wrist_3, batch)).ravel(),
        branches.reshape(-1, 8, 6),
    )
    return branches


def nearest_turn(joint_angles: ArrayLike, guess: ArrayLike) -> Array:
    """``joint_angles`` (..., 6) by whole turns as close to ``guess`` (6,) as the limits allow."""
    angles, guess = np.asarray(joint_angles, dtype=np.float64), np.asarray(guess, dtype=np.float64)
    turned = angles + 2 * np.pi * np.round((guess - angles) / (2 * np.pi))
    excess = np.where(np.abs(turned) > JOINT_LIMIT, np.sign(turned), 0.0)
    return turned - 2 * np.pi * excess


def nearest_solution(T_base_flange: ArrayLike, guess: ArrayLike) -> Array:
    """Of the joint angles that reach a flange pose, those nearest to where the arm is.

    Args:
        T_base_flange: (..., 4, 4) flange in the arm's base frame.
        guess: (..., 6) joint angles [rad]; broadcast against the poses.

    Returns:
        (..., 6) joint angles [rad]; NaN where there are none.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    guess = np.asarray(guess, dtype=np.float64)
    batch = np.broadcast_shapes(T.shape[:-2], guess.shape[:-1])
    joint_angles = np.empty((*batch, 6))
    kernels.nearest_solution(
        np.array(np.broadcast_to(T, (*batch, 4, 4))).reshape(-1, 4, 4),
        np.array(np.broadcast_to(guess, (*batch, 6))).reshape(-1, 6),
        joint_angles.reshape(-1, 6),
    )
    return joint_angles


def wrist_angle(joint_angles: Array) -> Array:
    """Angle (...) [rad] from the wrist's singularity at joint angles (..., 6): 0 where the fourth
    and the sixth axis fall together, its sign that of the side."""
    return np.arcsin(np.sin(joint_angles[..., 4]))


def why_unreachable(T_base_flange: Array) -> str:
    """The distance that puts a flange pose (4, 4) out of reach, in words."""
    wrist = T_base_flange[:3, 3] - DH_D[5] * T_base_flange[:3, 2]
    from_axis = np.hypot(wrist[0], wrist[1])
    if from_axis < DH_D[3]:
        return (
            f"its wrist would be {from_axis:.3f} m from the base's axis,"
            f" at least {DH_D[3]:.3f} m is needed"
        )
    span = np.array(
        [
            np.hypot(*kernels.wrist_branch(T_base_flange, 0.0, shoulder, flip)[3:5])
            for shoulder in (1.0, -1.0)
            for flip in (1.0, -1.0)
        ]
    )
    shortest, longest = abs(DH_A[1] - DH_A[2]), abs(DH_A[1] + DH_A[2])
    nearest = span[np.argmin(np.maximum(span - longest, shortest - span))]
    return (
        f"upper arm and forearm would have to span {nearest:.3f} m,"
        f" they span {shortest:.3f} to {longest:.3f} m"
    )
