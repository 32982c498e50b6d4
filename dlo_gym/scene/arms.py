"""The two UR5e arms: where they stand, where the grippers are, joint angles that hold the rod."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.exceptions import UnreachablePose
from dlo_gym.geometry.se3 import Array, check_pose, exp_so3, inverse, pose
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene._kernels_arms import follow_solutions
from dlo_gym.scene.clearance import Clearance, clearance
from dlo_gym.scene.ur5e import JOINT_LIMIT, link_frames, nearest_solution, why_unreachable

SIDES = ("left", "right")

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
        clamps = [clamp for clamp in (boundary.left, boundary.right) if clamp is not None]
        joint_angles = self.reach(np.stack(clamps), guess)
        if not np.isnan(joint_angles).any():
            return joint_angles
        side = int(np.argmax(np.isnan(joint_angles).any(axis=1)))
        clamp, flange = clamps[side], self.flange_in_base(np.stack(clamps))[side]
        raise UnreachablePose(
            f"{SIDES[side]} arm cannot hold the rod's end at {np.round(clamp[:3, 3], 4).tolist()}"
            f" m along {np.round(clamp[:3, 2], 3).tolist()}: {why_unreachable(flange)}"
        )

    def reach(self, clamps: Array, guess: Array) -> Array:
        """Joint angles (..., 2, 6) [rad] nearest to ``guess`` (..., 2, 6) that hold clamps
        (..., k, 4, 4) of the first k arms; NaN where an arm cannot reach its clamp."""
        k = clamps.shape[-3]
        joint_angles = np.array(np.broadcast_to(guess, (*clamps.shape[:-3], 2, 6)))
        joint_angles[..., :k, :] = nearest_solution(
            self.flange_in_base(clamps), joint_angles[..., :k, :]
        )
        return joint_angles

    def follow(self, way: Array, guess: Array) -> Array:
        """Joint angles (s, 2, 6) [rad] along a way of clamps (s, k, 4, 4), each nearest to those
        before it, the first to ``guess`` (2, 6); NaN where an arm cannot reach its clamp."""
        joint_angles = np.empty((len(way), 2, 6))
        follow_solutions(self.flange_in_base(way), guess, joint_angles)
        return joint_angles

    def forward_kinematics(self, joint_angles: ArrayLike) -> BoundaryPoses:
        """The clamp poses where joint angles (2, 6) [rad] hold the rod's ends."""
        frames = link_frames(_check_joint_angles(joint_angles, "joint_angles"))
        T_world_tcp = self.T_world_base @ frames[:, 6] @ self.T_flange_tcp
        left, right = T_world_tcp @ inverse(T_CLAMP_TCP)
        return BoundaryPoses(left, right)

    def clearance(self, joint_angles: ArrayLike) -> Clearance:
        """Distances of arms and grippers to each other, to the table and to themselves."""
        return clearance(self.T_world_base, _check_joint_angles(joint_angles, "joint_angles"))

    def flange_in_base(self, clamps: Array) -> Array:
        """``T_base_flange`` (..., k, 4, 4) of the first k arms whose grippers hold clamps
        (..., k, 4, 4) in world."""
        k = clamps.shape[-3]
        return self._T_base_world[:k] @ clamps @ self._T_clamp_flange[:k]

    @cached_property
    def _T_base_world(self) -> Array:
        return inverse(self.T_world_base)

    @cached_property
    def _T_clamp_flange(self) -> Array:
        return T_CLAMP_TCP @ inverse(self.T_flange_tcp)


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
