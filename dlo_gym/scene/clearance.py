"""How far the arms are from each other, from the table, from themselves and from obstacles."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.obstacles import Obstacle, pack
from dlo_gym.scene import _kernels_arms as kernels
from dlo_gym.scene._kernels_obstacles import capsule_gaps

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
CAPSULE_FRAMES = np.array([capsule[0] for capsule in CAPSULES])
CAPSULE_ENDS = np.array([capsule[1:3] for capsule in CAPSULES])  # (n, 2, 3)
CAPSULE_RADII = np.array([capsule[3] for capsule in CAPSULES])
_ABOVE_TABLE = CAPSULE_FRAMES >= 2
# Of one arm, links three joints apart can meet, and a folded elbow brings two more pairs together.
_SELF_PAIRS = np.array(
    [
        (a, b)
        for a, frame_a in enumerate(CAPSULE_FRAMES)
        for b, frame_b in enumerate(CAPSULE_FRAMES)
        if frame_a - frame_b >= 3 or (frame_a, frame_b) in ((3, 1), (4, 2))
    ]
)


class Clearance(NamedTuple):
    """Smallest distances [m] between the arms' capsules; negative where they overlap.

    Attributes:
        between_arms: (...) of the two arms, grippers included.
        to_table: (..., 2) of either arm's moving links to the table top.
        within_arm: (..., 2) of either arm to itself.
    """

    between_arms: Array
    to_table: Array
    within_arm: Array

    @property
    def minimum(self) -> float:
        return float(np.min(self.smallest))

    @property
    def smallest(self) -> Array:
        """(...) the smallest of the distances of each pair of arms [m]."""
        own = np.minimum(self.to_table, self.within_arm).min(axis=-1)
        return np.minimum(self.between_arms, own)


def capsule_axes(T_world_base: Array, joint_angles: Array) -> Array:
    """Ends (..., 2, n, 2, 3) [m] of the axes of both arms' capsules in the world.

    Args:
        T_world_base: (2, 4, 4) of the arms' base frames.
        joint_angles: (..., 2, 6) [rad].
    """
    axes = np.empty((*joint_angles.shape[:-2], 2, len(CAPSULES), 2, 3))
    kernels.capsule_axes(
        np.array(T_world_base),
        np.array(joint_angles).reshape(-1, 2, 6),
        CAPSULE_FRAMES,
        CAPSULE_ENDS,
        axes.reshape(-1, *axes.shape[-4:]),
    )
    return axes


def clearance(T_world_base: Array, joint_angles: Array) -> Clearance:
    """Clearances of arms on bases (2, 4, 4) at joint angles (..., 2, 6) [rad].

    NaN of an arm whose joint angles are.
    """
    axes = capsule_axes(T_world_base, joint_angles)
    axes = axes.reshape(-1, *axes.shape[-4:])
    between, table, within = np.empty(len(axes)), np.empty((len(axes), 2)), np.empty((len(axes), 2))
    kernels.clearances(axes, CAPSULE_RADII, _ABOVE_TABLE, _SELF_PAIRS, between, table, within)
    unknown = np.isnan(joint_angles).any(axis=-1).reshape(-1, 2)
    table[unknown] = within[unknown] = np.nan
    between[unknown[:, 0] | unknown[:, 1]] = np.nan
    batch = joint_angles.shape[:-2]
    return Clearance(between.reshape(batch), table.reshape(*batch, 2), within.reshape(*batch, 2))


def obstacle_clearance(
    T_world_base: Array, joint_angles: Array, obstacles: Sequence[Obstacle]
) -> Array:
    """Smallest distances (..., m) [m] of both arms on bases (2, 4, 4), at joint angles (..., 2, 6)
    [rad], to each of m obstacles; negative where they overlap."""
    axes = capsule_axes(T_world_base, joint_angles).reshape(-1, 2 * len(CAPSULES), 2, 3)
    gaps = np.empty((len(axes), len(obstacles)))
    capsule_gaps(axes, np.tile(CAPSULE_RADII, 2), pack(obstacles), gaps)
    return gaps.reshape(*joint_angles.shape[:-2], len(obstacles))


def segment_distances(first: Array, second: Array) -> Array:
    """Distances (...) [m] between line segments (..., 2, 3), given by their ends."""
    batch = np.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    distances = np.empty(batch)
    kernels.segment_distances(
        np.array(np.broadcast_to(first, (*batch, 2, 3))).reshape(-1, 2, 3),
        np.array(np.broadcast_to(second, (*batch, 2, 3))).reshape(-1, 2, 3),
        distances.reshape(-1),
    )
    return distances
