"""How far the arms are from each other, from the table and from themselves."""

from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.ur5e import link_frames

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
        return min(float(np.min(distances)) for distances in self)


def capsule_axes(T_world_base: Array, joint_angles: Array) -> Array:
    """Ends (..., 2, n, 2, 3) [m] of the axes of both arms' capsules in the world.

    Args:
        T_world_base: (2, 4, 4) of the arms' base frames.
        joint_angles: (..., 2, 6) [rad].
    """
    T = (T_world_base[:, None] @ link_frames(joint_angles))[..., CAPSULE_FRAMES, :, :]
    return (T[..., None, :3, :3] @ CAPSULE_ENDS[..., None])[..., 0] + T[..., None, :3, 3]


def clearance(T_world_base: Array, joint_angles: Array) -> Clearance:
    """Clearances of arms on bases (2, 4, 4) at joint angles (..., 2, 6) [rad]."""
    axes = capsule_axes(T_world_base, joint_angles)
    batch, n = axes.shape[:-4], len(CAPSULES)
    a, b = _SELF_PAIRS.T
    # One call for all pairs: the time goes into calls, not into numbers.
    across = np.broadcast_arrays(axes[..., 0, :, None, :, :], axes[..., 1, None, :, :, :])
    first, second = (
        np.concatenate([x.reshape(*batch, -1, 2, 3), within.reshape(*batch, -1, 2, 3)], axis=-3)
        for x, within in zip(across, (axes[..., a, :, :], axes[..., b, :, :]), strict=True)
    )
    gaps = segment_distances(first, second)
    between = gaps[..., : n**2] - (CAPSULE_RADII[:, None] + CAPSULE_RADII).ravel()
    within = gaps[..., n**2 :].reshape(*batch, 2, -1) - CAPSULE_RADII[a] - CAPSULE_RADII[b]
    table = (axes[..., 2].min(axis=-1) - CAPSULE_RADII)[..., _ABOVE_TABLE]
    return Clearance(between.min(axis=-1), table.min(axis=-1), within.min(axis=-1))


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
