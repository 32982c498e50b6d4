"""Draws centerlines into a view's image."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array

# RGB. Told apart also by colour-blind eyes, and from most cables.
SEEN = (0, 205, 255)
HIDDEN = (255, 140, 0)
TRUE = (20, 170, 60)
GOAL = (190, 60, 220)

_SHIFT = 4  # OpenCV draws with 1/16 pixel


def draw_centerline(
    image: NDArray[np.uint8],
    camera: CameraModel,
    centerline: Array,
    colour: tuple[int, int, int],
    *,
    thickness: float = 2.0,
    visible: NDArray[np.bool_] | None = None,
    hidden_colour: tuple[int, int, int] = HIDDEN,
) -> None:
    """Draws a centerline (n, 3) [m] into ``image``, antialiased, in place.

    Args:
        image: (height, width, 3) uint8 RGB of ``camera``.
        colour: RGB; of the seen part if ``visible`` (n,) is given, else of all of it.
        thickness: [pixels] in a 1080-line image; thinner in smaller ones.
        visible: an element is drawn as hidden unless both its nodes are visible.
    """
    pixels = camera.project(centerline)
    width = max(1, round(thickness * camera.height / 1080))
    limit = 4.0 * max(camera.width, camera.height)
    drawable = (np.abs(np.nan_to_num(pixels, nan=2.0 * limit)) < limit).min(axis=1).tolist()
    fixed = np.round(np.nan_to_num(pixels).clip(-limit, limit) * 2**_SHIFT).astype(np.int32)
    seen = [True] * len(pixels) if visible is None else np.asarray(visible, dtype=bool).tolist()
    for wanted, shade in ((False, hidden_colour), (True, colour)):
        for i in range(len(pixels) - 1):
            if drawable[i] and drawable[i + 1] and (seen[i] and seen[i + 1]) == wanted:
                ends = (fixed[i].tolist(), fixed[i + 1].tolist())
                cv2.line(image, *ends, shade, width, cv2.LINE_AA, _SHIFT)


def draw_legend(
    image: NDArray[np.uint8], entries: Sequence[tuple[str, tuple[int, int, int] | None]]
) -> None:
    """Writes coloured samples with their meaning into the upper left corner, in place; a text
    without a colour starts at the margin."""
    scale = max(image.shape[0] / 1080, 0.34)
    line = round(34 * scale)
    font = (cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale)
    widest = max((cv2.getTextSize(text, *font, 1)[0][0] for text, _ in entries), default=0)
    height, width = (len(entries) * line + line // 2, widest + 3 * line)
    corner = image[: min(height, image.shape[0]), : min(width, image.shape[1])]
    corner[:] = (0.35 * corner + 0.65 * 20).astype(np.uint8)
    for row, (text, colour) in enumerate(entries):
        y = round((row + 0.75) * line)
        start, end = (line // 2, y), (line * 3 // 2, y)
        if colour is not None:
            cv2.line(image, start, end, colour, max(2, round(4 * scale)), cv2.LINE_AA)
        origin = (line // 2 if colour is None else 2 * line, y + round(9 * scale))
        cv2.putText(image, text, origin, *font, (240, 240, 240), max(1, round(scale)), cv2.LINE_AA)


def draw_overlay(
    view: View,
    estimate: Array | None = None,
    *,
    visible: NDArray[np.bool_] | None = None,
    truth: Array | None = None,
    goal: Array | None = None,
    caption: str = "",
) -> NDArray[np.uint8]:
    """A copy of the view's image with tracked, true and goal centerlines and a legend.

    Args:
        estimate, truth, goal: (n, 3) centerlines in world [m], each drawn if given.
        visible: (n,) which nodes of the estimate were seen in this view.
        caption: first line of the legend, e.g. the view and the time.
    """
    image = view.image.copy()
    entries: list[tuple[str, tuple[int, int, int] | None]] = []
    if caption:
        entries.append((caption, None))
    if goal is not None:
        draw_centerline(image, view.camera, goal, GOAL, thickness=3.0)
        entries.append(("goal", GOAL))
    if estimate is not None:
        draw_centerline(image, view.camera, estimate, SEEN, thickness=5.0, visible=visible)
        entries.append(("tracked, seen" if visible is not None else "tracked", SEEN))
        if visible is not None:
            entries.append(("tracked, hidden", HIDDEN))
    if truth is not None:
        draw_centerline(image, view.camera, truth, TRUE, thickness=1.5)
        entries.append(("true", TRUE))
    draw_legend(image, entries)
    return image
