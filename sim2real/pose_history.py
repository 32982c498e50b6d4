"""Where a gripper was at the time of an image, from the poses its arm reported."""

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array, check_pose, exp_so3, log_so3, pose


def interpolate_poses(
    stamps: ArrayLike,
    poses: ArrayLike,
    query: ArrayLike,
    *,
    extrapolation: float = 0.02,
    max_gap: float = 0.25,
) -> Array:
    """Poses at other times: positions linearly, rotations along the shortest arc.

    Args:
        stamps: (n,) times of the poses, strictly increasing, n >= 2 [s].
        poses: (n, 4, 4) rigid transforms.
        query: (...,) times asked for, on the same clock [s].
        extrapolation: how far beyond the first and last pose the motion next to them is carried
            on; the newest image is often a little newer than the newest pose [s].
        max_gap: between neighbouring poses, across which nobody knows how the arm moved [s].

    Returns:
        (..., 4, 4) poses.

    Raises:
        ValueError: on wrong shapes, stamps out of order, or a query outside the range or inside
            a gap.
    """
    stamps = np.asarray(stamps, dtype=np.float64)
    poses = check_pose(poses, "poses")
    times = np.asarray(query, dtype=np.float64)
    if stamps.ndim != 1 or len(stamps) < 2 or poses.shape != (len(stamps), 4, 4):
        raise ValueError(
            "stamps, poses: expected shapes (n,) and (n, 4, 4) with n >= 2,"
            f" got {stamps.shape} and {poses.shape}"
        )
    if not (np.diff(stamps) > 0).all():
        raise ValueError("stamps: expected finite times that strictly increase")
    _check_range(times, stamps[0] - extrapolation, stamps[-1] + extrapolation)
    i = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(stamps) - 2)
    duration = stamps[i + 1] - stamps[i]
    inside = (times > stamps[i]) & (times < stamps[i + 1])
    if (inside & (duration > max_gap)).any():
        raise ValueError(
            f"query: expected times with poses around them, got one in a gap of"
            f" {duration[inside].max():.3f} s (limit {max_gap:g} s)"
        )
    fraction = ((times - stamps[i]) / duration)[..., None]
    positions, rotations = poses[:, :3, 3], poses[:, :3, :3]
    turn = log_so3(np.swapaxes(rotations[i], -1, -2) @ rotations[i + 1])
    return pose(
        rotations[i] @ exp_so3(fraction * turn),
        positions[i] + fraction * (positions[i + 1] - positions[i]),
    )


def _check_range(times: Array, first: float, last: float) -> None:
    outside = ~((times >= first) & (times <= last))
    if outside.any():
        worst = float(times[outside].flat[0])
        raise ValueError(
            f"query: expected times from {first:.3f} to {last:.3f} s, where poses are known,"
            f" got {worst:.3f} s"
        )
