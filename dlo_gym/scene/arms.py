"""Kinematics of the two UR5e arms: where the grippers are, joint angles, clearances."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.exceptions import UnreachablePose
from dlo_gym.geometry.se3 import Array, check_pose, exp_so3, inverse, pose
from dlo_gym.rod.boundary import BoundaryPoses

SIDES = ("left", "right")

# Denavit-Hartenberg parameters of the UR5e (Universal Robots, public table) [m], [rad].
DH_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
DH_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
DH_ALPHA = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
JOINT_LIMIT = 2.0 * np.pi  # every joint turns +-360 degrees

# The gripper holds the rod in line: TCP z points out of the fingers, which close along TCP x.
# With the clamp's d2 upwards, one finger is above the rod and one below.
TCP_DISTANCE = 0.163  # flange to fingertips [m]
T_FLANGE_TCP = pose(np.eye(3), [0.0, 0.0, TCP_DISTANCE])
T_CLAMP_TCP = np.stack(
    [
        pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)),
        pose(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3)),
    ]
)


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


# Capsules around the links and the gripper: DH frame, axis from, axis to [m], radius [m].
CAPSULES = (
    (0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.16), 0.078),
    (1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.138), 0.068),
    (2, (0.425, 0.0, 0.138), (0.0, 0.0, 0.138), 0.066),
    (2, (0.0, 0.0, 0.138), (0.0, 0.0, 0.007), 0.062),
    (3, (0.3922, 0.0, 0.007), (0.0, 0.0, 0.007), 0.058),
    (4, (0.0, -0.1263, 0.0), (0.0, 0.0, 0.0), 0.052),
    (5, (0.0, 0.0997, 0.0), (0.0, 0.0, 0.0), 0.052),
    (6, (0.0, 0.0, -0.04), (0.0, 0.0, 0.03), 0.05),
    (6, (-0.015, 0.0, 0.07), (0.015, 0.0, 0.07), 0.05),
    (6, (0.0, 0.0, 0.12), (0.0, 0.0, 0.14), 0.035),
)
_FRAME_OF_CAPSULE = np.array([capsule[0] for capsule in CAPSULES])
_CAPSULE_ENDS = np.array([capsule[1:3] for capsule in CAPSULES])  # (n, 2, 3)
_CAPSULE_RADII = np.array([capsule[3] for capsule in CAPSULES])
_ABOVE_TABLE = _FRAME_OF_CAPSULE >= 2
# Of one arm, links three joints apart can meet, and a folded elbow brings two more pairs together.
_SELF_PAIRS = np.array(
    [
        (a, b)
        for a, frame_a in enumerate(_FRAME_OF_CAPSULE)
        for b, frame_b in enumerate(_FRAME_OF_CAPSULE)
        if frame_a - frame_b >= 3 or (frame_a, frame_b) in ((3, 1), (4, 2))
    ]
)


@dataclass(frozen=True)
class Clearance:
    """Smallest distances [m] between the arms' capsules; negative where they overlap.

    Attributes:
        between_arms: of the two arms, grippers included.
        to_table: of either arm's moving links to the table top.
        within_arm: of either arm to itself.
    """

    between_arms: float
    to_table: float
    within_arm: float

    @property
    def minimum(self) -> float:
        return min(self.between_arms, self.to_table, self.within_arm)


def _default_bases() -> Array:
    """On plinths beside the rod, a little behind it as the side camera sees it."""
    return pose(
        exp_so3([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]), [[-0.74, 0.15, 0.1], [0.74, 0.15, 0.1]]
    )


def _default_home() -> Array:
    """Elbows and wrists up, the rod's ends at x = -0.2 and 0.2, z = 0.34."""
    return np.array(
        [
            [2.21, -1.61, 2.30, -0.68, 0.64, 1.57],
            [0.93, -1.53, -2.30, -2.46, -0.64, 1.57],
        ]
    )


@dataclass(frozen=True, eq=False)
class DualArm:
    """Two UR5e whose grippers hold the rod's ends.

    Attributes:
        T_world_base: (2, 4, 4) the arms' base frames, left then right.
        home: (2, 6) joint angles [rad] that the first inverse kinematics start from.
        T_flange_tcp: (2, 4, 4) the grippers' tool centre points.

    Raises:
        ValueError: on a base or tool centre point that is not rigid or a home outside the joint
            limits.
    """

    T_world_base: Array = field(default_factory=_default_bases)
    home: Array = field(default_factory=_default_home)
    T_flange_tcp: Array = field(default_factory=lambda: np.stack([T_FLANGE_TCP, T_FLANGE_TCP]))

    def __post_init__(self) -> None:
        for name in ("T_world_base", "T_flange_tcp"):
            poses = check_pose(getattr(self, name), name)
            if poses.shape != (2, 4, 4):
                raise ValueError(f"{name}: expected shape (2, 4, 4), got {poses.shape}")
            object.__setattr__(self, name, poses)
        object.__setattr__(self, "home", _check_joint_angles(self.home, "home"))

    def inverse_kinematics(self, boundary: BoundaryPoses, guess: ArrayLike | None = None) -> Array:
        """Joint angles (2, 6) [rad] whose grippers hold the rod at ``boundary``.

        Of each arm's up to eight solutions the one nearest to ``guess`` (2, 6) [rad], home when
        omitted. Where the right end is free, the right arm stays at ``guess``.

        Raises:
            UnreachablePose: naming the arm, the pose and the distance that is out of range.
        """
        guess = self.home if guess is None else _check_joint_angles(guess, "guess")
        joint_angles = guess.copy()
        for side, clamp in enumerate((boundary.left, boundary.right)):
            if clamp is None:
                continue
            T_base_flange = self._flange_in_base(side, clamp)
            branches = ik_branches(T_base_flange, guess[side, 5])
            branches = branches[np.isfinite(branches[:, 0])]
            if not len(branches):
                raise UnreachablePose(_why_unreachable(SIDES[side], clamp, T_base_flange))
            branches = nearest_turn(branches, guess[side])
            away = np.square(branches - guess[side]).sum(axis=1)
            joint_angles[side] = branches[np.argmin(away)]
        return joint_angles

    def forward_kinematics(self, joint_angles: ArrayLike) -> BoundaryPoses:
        """The clamp poses where joint angles (2, 6) [rad] hold the rod's ends."""
        frames = link_frames(_check_joint_angles(joint_angles, "joint_angles"))
        T_world_tcp = self.T_world_base @ frames[:, 6] @ self.T_flange_tcp
        left, right = T_world_tcp @ inverse(T_CLAMP_TCP)
        return BoundaryPoses(left, right)

    def clearance(self, joint_angles: ArrayLike) -> Clearance:
        """Distances of arms and grippers to each other, to the table and to themselves."""
        frames = link_frames(_check_joint_angles(joint_angles, "joint_angles"))
        T = (self.T_world_base[:, None] @ frames)[:, _FRAME_OF_CAPSULE]  # (2, n, 4, 4)
        ends = np.einsum("snij,nej->snei", T[..., :3, :3], _CAPSULE_ENDS) + T[..., None, :3, 3]
        left, right = ends
        between = segment_distances(left[:, None], right[None])
        between -= _CAPSULE_RADII[:, None] + _CAPSULE_RADII
        table = ends[..., 2].min(axis=-1) - _CAPSULE_RADII
        a, b = _SELF_PAIRS.T
        within = segment_distances(ends[:, a], ends[:, b]) - _CAPSULE_RADII[a] - _CAPSULE_RADII[b]
        return Clearance(
            float(between.min()), float(table[:, _ABOVE_TABLE].min()), float(within.min())
        )

    def _flange_in_base(self, side: int, clamp: Array) -> Array:
        T_world_flange = clamp @ T_CLAMP_TCP[side] @ inverse(self.T_flange_tcp[side])
        return inverse(self.T_world_base[side]) @ T_world_flange


def segment_distances(first: Array, second: Array) -> Array:
    """Distances (...) [m] between line segments (..., 2, 3), given by their ends.

    Ericson, Real-Time Collision Detection, 5.1.9.
    """
    start, d1 = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    d2 = second[..., 1, :] - second[..., 0, :]
    r = start - second[..., 0, :]
    a, e = (d1 * d1).sum(-1) + 1e-15, (d2 * d2).sum(-1) + 1e-15
    b, c, f = (d1 * d2).sum(-1), (d1 * r).sum(-1), (d2 * r).sum(-1)
    determinant = a * e - b * b
    s = np.clip((b * f - c * e) / np.maximum(determinant, 1e-15), 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    return np.linalg.norm(r + s[..., None] * d1 - t[..., None] * d2, axis=-1)


def _check_joint_angles(joint_angles: ArrayLike, name: str) -> Array:
    joint_angles = np.ascontiguousarray(joint_angles, dtype=np.float64)
    if joint_angles.shape != (2, 6) or not np.isfinite(joint_angles).all():
        raise ValueError(
            f"{name}: expected finite joint angles of shape (2, 6), got {joint_angles}"
        )
    if (np.abs(joint_angles) > JOINT_LIMIT + 1e-9).any():
        raise ValueError(
            f"{name}: expected joint angles within +-{JOINT_LIMIT:.4g} rad, got {joint_angles}"
        )
    return joint_angles


def _why_unreachable(side: str, clamp: Array, T_base_flange: Array) -> str:
    """A sentence with the arm, the pose and the distance that puts it out of reach."""
    where = (
        f"{side} arm cannot hold the rod's end at {np.round(clamp[:3, 3], 4).tolist()} m"
        f" along {np.round(clamp[:3, 2], 3).tolist()}"
    )
    wrist = T_base_flange[:3, 3] - DH_D[5] * T_base_flange[:3, 2]
    from_axis = np.hypot(wrist[0], wrist[1])
    if from_axis < DH_D[3]:
        return (
            f"{where}: its wrist would be {from_axis:.3f} m from the base's axis,"
            f" at least {DH_D[3]:.3f} m is needed"
        )
    span = np.linalg.norm(_planar_wrist(_wrist_branches(T_base_flange, 0.0).T_1_4), axis=0)
    shortest, longest = abs(DH_A[1] - DH_A[2]), abs(DH_A[1] + DH_A[2])
    nearest = span.flat[np.argmin(np.maximum(span - longest, shortest - span))]
    return (
        f"{where}: upper arm and forearm would have to span {nearest:.3f} m,"
        f" they span {shortest:.3f} to {longest:.3f} m"
    )
