"""The cable's centre from its known width, to a fraction of a pixel.

A segmented cable may lack the side that lies in its own shade or melts into the background, and
then the middle of the mask is not the middle of the cable. Its true width is known, though: the
cable is where a window of that width holds the most of what differs from both flanks.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array

STEP = 0.25  # across [pixels]
SEARCH = 0.9  # how far the centre is moved at most, in radii
FLANK = 3.5  # outer limit of the flanks, in radii from the given point
QUIET = 6.0  # difference from the flanks that is noise, in colour levels
CLEAR = 10.0  # difference beyond that, that counts half
PLATEAU = 0.985  # of the highest score, shifts that are as good
AGREEMENT = 5  # neighbouring nodes whose median shift counts


def centre_between_borders(
    image: NDArray[np.uint8], points: Array, directions: Array, radius: float, spacing: float
) -> Array:
    """Points (n, 2) [pixels] on a cable moved across it to the middle between its borders.

    Args:
        image: (h, w, 3).
        points: (n, 2) roughly on the centerline, in their order along it [pixels].
        directions: (n, 2) unit vectors along the centerline.
        radius: of the cable [pixels].
        spacing: between the points [pixels]; what is seen is averaged over it.
    """
    normals = np.column_stack([-directions[:, 1], directions[:, 0]])
    half = int(np.ceil(FLANK * max(radius, 1.0) / STEP))
    across = STEP * np.arange(-half, half + 1, dtype=np.float64)
    profile = _profiles(image, points, directions, normals, across, spacing)
    beyond = (1.0 + SEARCH) * radius + 1.0
    flanks = [np.median(profile[:, side * across > beyond][:, ::2], axis=1) for side in (-1, 1)]
    differences = [np.linalg.norm(profile - flank[:, None], axis=2) for flank in flanks]
    excess = np.maximum(np.minimum(*differences) - QUIET, 0.0)
    excess /= excess + CLEAR
    total = np.cumsum(np.pad(excess, ((0, 0), (1, 0))), axis=1)
    window, reach = round(radius / STEP), round(SEARCH * radius / STEP)
    middles = np.arange(half - reach, half + reach + 1)
    held = total[:, middles + window + 1] - total[:, middles - window]
    best = held >= PLATEAU * held.max(axis=1, keepdims=True)
    shifts = (best * across[middles]).sum(axis=1) / best.sum(axis=1)
    padded = np.pad(shifts, AGREEMENT // 2, mode="edge")
    agreed = np.median(np.lib.stride_tricks.sliding_window_view(padded, AGREEMENT), axis=1)
    return points + agreed[:, None] * normals


def _profiles(
    image: NDArray[np.uint8],
    points: Array,
    directions: Array,
    normals: Array,
    across: Array,
    spacing: float,
) -> Array:
    """Colours (n, columns, 3) across the cable at each point, averaged over the spacing."""
    along = np.array([-0.3, 0.0, 0.3]) * spacing
    places = (
        points[:, None, None]
        + along[:, None, None] * directions[:, None, None]
        + across[:, None] * normals[:, None, None]
    ).astype(np.float32)
    places = places.reshape(len(points), -1, 2)
    colours = cv2.remap(
        image, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return colours.reshape(len(points), len(along), len(across), 3).mean(axis=1, dtype=np.float32)
