"""Finds a thin band of unknown colour near a predicted curve: where a cable's appearance is learnt.

The image is straightened along the prediction. A cable is a ridge there: it differs from both of
its flanks in the same sense, while a table's edge or a shadow differs from one. The best ridge from
one held end to the other is found by dynamic programming, so a prediction that is off by many
diameters (a cable of other stiffness, say) still leads to it.
"""

from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array

ROW_STEP = 0.75  # of the radius, along the curve
COLUMN_STEP = 0.25  # of the radius, across
STEEPEST = 2  # columns per row


class Strip(NamedTuple):
    """An image straightened along a curve.

    Attributes:
        colours: (rows, columns, 3) float32, row by row along the curve, columns across it.
        offsets: (columns,) signed distance from the curve [pixels].
        radius: of the cable [pixels].
    """

    colours: NDArray[np.float32]
    offsets: Array
    radius: float


def straighten(image: NDArray[np.uint8], pixels: Array, radius: float, half_width: float) -> Strip:
    """The band of ``half_width`` [pixels] around a curve (n, 2) [pixels]."""
    step = max(ROW_STEP * radius, 0.75)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    rows = np.linspace(0.0, lengths[-1], max(int(lengths[-1] / step), 8))
    curve = np.column_stack([np.interp(rows, lengths, pixels[:, axis]) for axis in range(2)])
    tangents = np.gradient(curve, axis=0)
    tangents = cv2.blur(tangents, (1, 9), borderType=cv2.BORDER_REPLICATE)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    spacing = max(COLUMN_STEP * radius, 0.5)
    half = max(int(half_width / spacing), 8)
    offsets = np.arange(-half, half + 1, dtype=np.float64) * spacing
    places = (curve[:, None, :] + offsets[:, None] * normals[:, None, :]).astype(np.float32)
    colours = cv2.remap(
        image, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return Strip(colours.astype(np.float32), offsets, radius)


def ridge_strength(strip: Strip) -> NDArray[np.float32]:
    """How much each place (rows, columns) differs from both its flanks, in colour levels."""
    spacing = strip.offsets[1] - strip.offsets[0]
    inner = max(round(1.2 * strip.radius / spacing) | 1, 1)
    outer = max(round(1.2 * strip.radius / spacing) | 1, 1)
    gap = round(2.2 * strip.radius / spacing)
    smooth = cv2.blur(strip.colours, (1, 3))
    centre = cv2.blur(smooth, (inner, 1))
    flank = cv2.blur(smooth, (outer, 1))
    left = np.roll(flank, gap, axis=1)
    right = np.roll(flank, -gap, axis=1)
    left_difference, right_difference = centre - left, centre - right
    agreement = (left_difference * right_difference).sum(axis=2)
    strength = np.minimum(
        np.linalg.norm(left_difference, axis=2), np.linalg.norm(right_difference, axis=2)
    )
    strength[agreement <= 0.0] = 0.0
    margin = gap + outer // 2
    strength[:, :margin] = 0.0
    strength[:, len(strip.offsets) - margin :] = 0.0
    return strength.astype(np.float32)


def best_path(
    strength: NDArray[np.float32], held: tuple[bool, bool], bend_cost: float
) -> NDArray[np.int64]:
    """Column (rows,) of the strongest path; at a held end it starts in the middle column."""
    return _best_path(np.ascontiguousarray(strength), held[0], held[1], bend_cost)


@numba.njit(cache=True)
def _best_path(strength, start_held, end_held, bend_cost):  # pragma: no cover
    """Dynamic programming over rows; ``bend_cost`` per column moved and row."""
    rows, columns = strength.shape
    middle = columns // 2
    total = np.full((rows, columns), -1e18)
    came_from = np.zeros((rows, columns), np.int64)
    for column in range(columns):
        if not start_held or column == middle:
            total[0, column] = strength[0, column]
    for row in range(1, rows):
        for column in range(columns):
            for move in range(-STEEPEST, STEEPEST + 1):
                previous = column + move
                if previous < 0 or previous >= columns:
                    continue
                value = total[row - 1, previous] - bend_cost * move * move
                if value > total[row, column]:
                    total[row, column] = value
                    came_from[row, column] = previous
            total[row, column] += strength[row, column]
    path = np.empty(rows, np.int64)
    path[-1] = middle if end_held else np.argmax(total[-1])
    for row in range(rows - 1, 0, -1):
        path[row - 1] = came_from[row, path[row]]
    return path
