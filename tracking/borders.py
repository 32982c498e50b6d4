"""The cable's centre from its known width, to a fraction of a pixel.

A segmented cable may lack the side that lies in its own shade or melts into the background, and
then the middle of the mask is not the middle of the cable. Its true width is known, though: the
cable is where a window of that width holds the most of what differs from both flanks.
"""

import cv2
import numba
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
    # Every second column from where no cable can be to the outer limit.
    gap = half + 1 - int(np.ceil(((1.0 + SEARCH) * radius + 1.0) / STEP + 1e-9))
    shifts = STEP * _shifts(profile, gap, round(radius / STEP), round(SEARCH * radius / STEP))
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


@numba.njit(cache=True)
def _shifts(profile, flank, window, reach):  # pragma: no cover
    """Shifts (n,) [columns] from the middle to the best of colours (n, columns, 3).

    Args:
        flank: columns at either end that the cable cannot reach.
        window: half the cable's width in columns.
        reach: largest shift in columns.
    """
    n, n_columns = profile.shape[:2]
    half = n_columns // 2
    shifts = np.empty(n)
    flanks = np.empty((2, 3))
    total = np.empty(n_columns + 1)
    held = np.empty(2 * reach + 1)
    for i in range(n):
        for channel in range(3):
            flanks[0, channel] = np.median(profile[i, :flank:2, channel])
            flanks[1, channel] = np.median(profile[i, n_columns - flank :: 2, channel])
        total[0] = 0.0
        for column in range(n_columns):
            difference = np.inf
            for side in range(2):
                squared = 0.0
                for channel in range(3):
                    squared += (profile[i, column, channel] - flanks[side, channel]) ** 2
                difference = min(difference, np.sqrt(squared))
            excess = max(difference - QUIET, 0.0)
            total[column + 1] = total[column] + excess / (excess + CLEAR)
        best = 0.0
        for k in range(2 * reach + 1):
            middle = half - reach + k
            held[k] = total[middle + window + 1] - total[middle - window]
            best = max(best, held[k])
        weight, moment = 0, 0
        for k in range(2 * reach + 1):
            if held[k] >= PLATEAU * best:
                weight += 1
                moment += k - reach
        shifts[i] = moment / weight
    return shifts
