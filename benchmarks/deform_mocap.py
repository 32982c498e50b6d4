"""Motion capture of real cables held at both ends (github.com/roahmlab/DEFORM), as cable motions.

Looks for it in ``$DLO_DATA/real/deform_mocap``, by default under ``../shared/data`` beside the
project. Each clip is (500, n_markers, 3) at 100 Hz [m]; the first two and the last two markers move
with the grippers: they tell where a clamp is and where it points, but not its roll.
"""

import os
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from dlo_gym.geometry.curves import parallel_transport
from dlo_gym.geometry.se3 import Array, frame_along
from sim2real.identification.cable_motion import CableMotion

FOLDER = (
    Path(os.environ.get("DLO_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "real" / "deform_mocap"
)  # fmt: skip
CABLES = ("DLO1", "DLO3")
PERIOD = 0.01
EVERY = 2  # samples used
SMOOTHING = 11  # samples of the held markers that a clamp's pose is smoothed over
WRONG = 0.012  # a marker whose distance to a neighbour is off by more was mistaken [m]
ELEMENTS = 24
RADIUS, MASS_PER_LENGTH = 0.004, 0.05  # unknown; motion only tells ratios to the mass


def load(cable: str) -> tuple[list[CableMotion], list[CableMotion]]:
    """Clips to identify from, every third, and the others, to be predicted.

    The arc lengths between markers are a cable's, not a clip's: the 95th percentile of their
    distances in the clips to identify from, as chords are shorter than the cable.
    """
    with np.load(FOLDER / f"{cable}_eval.npz") as file:
        clips = [file[name].astype(np.float64) for name in file.files]
    known, unseen = clips[::3], [clip for i, clip in enumerate(clips) if i % 3]
    between = np.percentile(_distances(np.concatenate(known)), 95, axis=0)
    return [_motion(clip, between) for clip in known], [_motion(clip, between) for clip in unseen]


def _distances(clip: Array) -> Array:
    return np.linalg.norm(np.diff(clip, axis=1), axis=2)


def _motion(clip: Array, between: Array) -> CableMotion:
    arc_length = np.concatenate([[0.0], np.cumsum(between[1:-1])])
    points = clip[:, 1:-1].copy()
    wrong = np.abs(_distances(points) - between[1:-1]) > WRONG
    points[:, 1:][wrong] = points[:, :-1][wrong] = np.nan
    left = savgol_filter(clip[:, :2], SMOOTHING, 2, axis=0)
    right = savgol_filter(clip[:, -2:], SMOOTHING, 2, axis=0)
    first = frame_along(left[0, 1] - left[0, 0], [0.0, 1.0, 0.0])
    # Without roll along the cable at the start, and without roll in time from there.
    tangents = [left[0, 1] - left[0, 0], *np.diff(clip[0, 1:-1], axis=0), right[0, 1] - right[0, 0]]
    last = parallel_transport([t / np.linalg.norm(t) for t in tangents], first)[-1]
    return CableMotion(
        PERIOD * np.arange(len(clip))[::EVERY],
        _poses(left[:, 1], left[:, 1] - left[:, 0], first)[::EVERY],
        _poses(right[:, 0], right[:, 1] - right[:, 0], last)[::EVERY],
        points[::EVERY, 1:-1],
        arc_length[1:-1] / arc_length[-1],
        float(arc_length[-1]),
        RADIUS,
        MASS_PER_LENGTH,
        ELEMENTS,
        clamp="node",
        grip_known=False,
    )


def _poses(origins: Array, along: Array, first: Array) -> Array:
    """(T, 4, 4) frames along tangents, carried from sample to sample without roll."""
    poses = np.tile(np.eye(4), (len(origins), 1, 1))
    poses[:, :3, :3] = parallel_transport(
        along / np.linalg.norm(along, axis=1, keepdims=True), first
    )
    poses[:, :3, 3] = origins
    return poses
