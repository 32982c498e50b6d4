"""Opaque patches pasted over views, to measure tracking under occlusion."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import View
from dlo_gym.geometry.se3 import Array

TOLERANCE = 0.03  # of the share of hidden nodes
MOST_PATCHES = 400


class Patch(NamedTuple):
    """An opaque rectangle, fixed in the image: first and last column and row, RGB colour."""

    left: int
    top: int
    right: int
    bottom: int
    colour: tuple[int, int, int]


def random_patches(
    rng: np.random.Generator, pixels: Array, share: float, size: float
) -> tuple[Patch, ...]:
    """Patches that together hide about ``share`` of the nodes, in the mean over time.

    Args:
        pixels: (T, n, 2) where the nodes are while the patches are there [pixels].
        share: of the nodes to hide, 0 to 1.
        size: typical edge length of a patch [pixels].
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share: expected 0 to 1, got {share}")
    patches: list[Patch] = []
    for _ in range(MOST_PATCHES):
        if hidden_by(patches, pixels).mean() >= share - TOLERANCE:
            break
        centre = pixels[rng.integers(pixels.shape[0]), rng.integers(pixels.shape[1])]
        half = size * rng.uniform(0.3, 0.8, size=2)
        colour = rng.integers(0, 256, size=3)
        if not np.isfinite(centre).all():
            continue
        low, high = np.round(centre - half).astype(int), np.round(centre + half).astype(int)
        patch = Patch(
            int(low[0]),
            int(low[1]),
            int(high[0]),
            int(high[1]),
            (int(colour[0]), int(colour[1]), int(colour[2])),
        )
        if hidden_by([*patches, patch], pixels).mean() <= share + TOLERANCE:
            patches.append(patch)
    return tuple(patches)


def hidden_by(patches: list[Patch] | tuple[Patch, ...], pixels: Array) -> NDArray[np.bool_]:
    """Which pixels (..., 2) lie under a patch (...,)."""
    hidden = np.zeros(pixels.shape[:-1], dtype=bool)
    x, y = pixels[..., 0], pixels[..., 1]
    for patch in patches:
        hidden |= (x >= patch.left) & (x <= patch.right) & (y >= patch.top) & (y <= patch.bottom)
    return hidden


def paste(view: View, patches: tuple[Patch, ...]) -> View:
    """The view with the patches over its image."""
    if not patches:
        return view
    image = view.image.copy()
    for patch in patches:
        rows = slice(max(patch.top, 0), max(patch.bottom + 1, 0))
        columns = slice(max(patch.left, 0), max(patch.right + 1, 0))
        image[rows, columns] = patch.colour
    return View(image, view.camera, view.stamp)
