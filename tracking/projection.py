"""Where the predicted rod lies in an image, and the band around it (Section V-A1)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, transform_points


def pixels_per_metre(camera: CameraModel, points: Array) -> Array:
    """Image scale (n,) [pixels/m] at points (n, 3); of a point behind the camera as at 1 mm."""
    depth = transform_points(camera.T_camera_world, points)[:, 2]
    return np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.maximum(depth, 1e-3)


def occupancy_mask(
    pixels: Array, reach: Array, shape: tuple[int, int]
) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Where the rod may be (Section V-A1): a band around its projection, cut out of the image.

    Args:
        pixels: (n, 2) projected centerline; NaN where behind the camera.
        reach: (n,) half-width of the band at each node [pixels].
        shape: (height, width) of the image.

    Returns:
        The cut-out's first (column, row) and its mask (h, w), 1 inside the band.
    """
    height, width = shape
    good = np.isfinite(pixels).min(axis=1)
    limit = 4.0 * max(height, width)
    points = np.clip(np.where(good[:, None], pixels, 0.0), -limit, limit)
    low = np.floor((points - reach[:, None])[good].min(axis=0)).astype(int)
    high = np.ceil((points + reach[:, None])[good].max(axis=0)).astype(int) + 1
    first = np.clip(low, 0, [width - 1, height - 1])
    last = np.clip(high, first + 1, [width, height])
    mask = np.zeros((last[1] - first[1], last[0] - first[0]), np.uint8)
    local = np.round(points - first).astype(np.int32)
    thickness = np.clip(2.0 * reach, 1, limit).astype(int)
    for i in range(len(points) - 1):
        if good[i] and good[i + 1]:
            ends = (local[i].tolist(), local[i + 1].tolist())
            cv2.line(mask, *ends, 1, int(max(thickness[i], thickness[i + 1])))
    return (int(first[0]), int(first[1])), mask
