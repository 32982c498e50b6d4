"""Kinematics of one UR5e: from joint angles to link frames and back."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.geometry.se3 import Array, inverse

# Denavit-Hartenberg parameters of the UR5e (Universal Robots, public table) [m], [rad].
DH_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
DH_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
DH_ALPHA = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
JOINT_LIMIT = 2.0 * np.pi  # every joint turns +-360 degrees


def link_frames(joint_angles: ArrayLike) -> Array:
    """DH frames 0 to 6 in the arm's base frame (..., 7, 4, 4) of joint angles (..., 6) [rad]."""
    q = np.asarray(joint_angles, dtype=np.float64)
    transforms = _dh_transform(np.arange(6), q)
    frames = np.empty((*q.shape[:-1], 7, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for i in range(6):
        np.matmul(frames[..., i, :, :], transforms[..., i, :, :], out=frames[..., i + 1, :, :])
    return frames


def _dh_transform(i: int | NDArray[np.int_], angle: Array) -> Array:
    """Transforms (..., 4, 4) of joints ``i`` (0 to 5) at angles (...) [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    ca, sa = np.cos(DH_ALPHA[i]), np.sin(DH_ALPHA[i])
    transform = np.zeros((*np.shape(angle), 4, 4))
    transform[..., 0, 0], transform[..., 0, 1], transform[..., 0, 2] = c, -s * ca, s * sa
    transform[..., 1, 0], transform[..., 1, 1], transform[..., 1, 2] = s, c * ca, -c * sa
    transform[..., 2, 1], transform[..., 2, 2], transform[..., 2, 3] = sa, ca, DH_D[i]
    transform[..., 0, 3], transform[..., 1, 3] = DH_A[i] * c, DH_A[i] * s
    transform[..., 3, 3] = 1.0
    return transform


def ik_branches(T_base_flange: ArrayLike, wrist_3: ArrayLike = 0.0) -> Array:
    """All joint angles that reach a flange pose.

    The closed-form solution for an arm with three parallel axes (Hawkins 2013, "Analytic inverse
    kinematics for the Universal Robots UR-5/UR-10 arms").

    Args:
        T_base_flange: (..., 4, 4) flange (DH frame 6) in the arm's base frame.
        wrist_3: (...) the last joint's angle [rad] where the wrist is singular and leaves it free.

    Returns:
        (..., 8, 6) joint angles in (-pi, pi]; a branch that does not exist is NaN.
    """
    wrist = _wrist_branches(T_base_flange, wrist_3)
    T_1_4 = wrist.T_1_4
    a2, a3 = DH_A[1], DH_A[2]
    px, py = _planar_wrist(T_1_4)
    sign = np.array([1.0, -1.0])
    with np.errstate(invalid="ignore"):
        q3 = sign * np.arccos(_unit_range((px**2 + py**2 - a2**2 - a3**2) / (2 * a2 * a3)))
    q2 = np.arctan2(py, px) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    q4 = np.arctan2(T_1_4[..., 1, 0], T_1_4[..., 0, 0]) - q2 - q3
    branches = np.stack(np.broadcast_arrays(wrist.q1, q2, q3, q4, wrist.q5, wrist.q6), axis=-1)
    branches = branches.reshape(*branches.shape[:-4], 8, 6)
    branches[np.isnan(branches).any(axis=-1)] = np.nan
    return np.pi - np.mod(np.pi - branches, 2 * np.pi)


class _WristBranches(NamedTuple):
    """Joints 1, 5, 6 (..., 2, 2, 1) [rad] by shoulder and wrist, and what is left for 2, 3, 4."""

    q1: Array
    q5: Array
    q6: Array
    T_1_4: Array


def _wrist_branches(T_base_flange: ArrayLike, wrist_3: ArrayLike) -> _WristBranches:
    T = np.asarray(T_base_flange, dtype=np.float64)[..., None, None, None, :, :]
    d4, d6 = DH_D[3], DH_D[5]
    sign = np.array([1.0, -1.0])
    x, y = T[..., 0, 3], T[..., 1, 3]
    wrist_x, wrist_y = x - d6 * T[..., 0, 2], y - d6 * T[..., 1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        around = np.arccos(_unit_range(d4 / np.hypot(wrist_x, wrist_y)))
        q1 = np.arctan2(wrist_y, wrist_x) + sign[:, None, None] * around + np.pi / 2
        s1, c1 = np.sin(q1), np.cos(q1)
        q5 = sign[:, None] * np.arccos(_unit_range((x * s1 - y * c1 - d4) / d6))
    s5 = np.sin(q5)
    q6 = np.arctan2(
        np.sign(s5) * (T[..., 1, 1] * c1 - T[..., 0, 1] * s1),
        np.sign(s5) * (T[..., 0, 0] * s1 - T[..., 1, 0] * c1),
    )
    q6 = np.where(np.abs(s5) < 1e-7, np.asarray(wrist_3)[..., None, None, None], q6)
    T_4_6 = _dh_transform(4, q5) @ _dh_transform(5, q6)
    return _WristBranches(q1, q5, q6, inverse(_dh_transform(0, q1)) @ T @ inverse(T_4_6))


def _planar_wrist(T_1_4: Array) -> Array:
    """The first wrist joint (2, ...) [m] in the plane of upper arm and forearm."""
    return np.stack([T_1_4[..., axis, 3] - DH_D[3] * T_1_4[..., axis, 1] for axis in (0, 1)])


def _unit_range(cosine: Array) -> Array:
    """A cosine that rounding took past +-1 set back to it; farther off stays (arccos: NaN)."""
    return np.where(np.abs(np.abs(cosine) - 1.0) < 1e-9, np.clip(cosine, -1.0, 1.0), cosine)


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
    guess = np.asarray(guess, dtype=np.float64)
    branches = ik_branches(T_base_flange, guess[..., 5])
    branches = nearest_turn(branches, guess[..., None, :])
    away = np.square(branches - guess[..., None, :]).sum(axis=-1)
    nearest = np.argmin(np.where(np.isnan(away), np.inf, away), axis=-1)
    return np.take_along_axis(branches, nearest[..., None, None], axis=-2)[..., 0, :]


def why_unreachable(T_base_flange: Array) -> str:
    """The distance that puts a flange pose (4, 4) out of reach, in words."""
    wrist = T_base_flange[:3, 3] - DH_D[5] * T_base_flange[:3, 2]
    from_axis = np.hypot(wrist[0], wrist[1])
    if from_axis < DH_D[3]:
        return (
            f"its wrist would be {from_axis:.3f} m from the base's axis,"
            f" at least {DH_D[3]:.3f} m is needed"
        )
    span = np.linalg.norm(_planar_wrist(_wrist_branches(T_base_flange, 0.0).T_1_4), axis=0)
    shortest, longest = abs(DH_A[1] - DH_A[2]), abs(DH_A[1] + DH_A[2])
    nearest = span.flat[np.argmin(np.maximum(span - longest, shortest - span))]
    return (
        f"upper arm and forearm would have to span {nearest:.3f} m,"
        f" they span {shortest:.3f} to {longest:.3f} m"
    )
