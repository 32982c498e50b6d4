"""Images that were taken at the same time."""

import math
from collections.abc import Sequence

from sim2real.cameras.camera import Camera, Frame


def synchronised(
    cameras: Sequence[Camera], since: float, tolerance: float
) -> tuple[Frame, ...] | None:
    """The newest set of one frame per camera that were taken at the same time.

    Args:
        cameras: at least one; their rates may differ.
        since: only frames with a stamp after this count, monotonic [s]; the oldest stamp of the
            last set that was used makes each set a new one in every view.
        tolerance: by which the set's stamps may differ [s].

    Returns:
        The frames in the cameras' order, or None while there is no such set. Of the sets that
        the newest frame of the slowest camera can make, it is the one of closest stamps.

    Raises:
        DeviceError: if a camera has been silent for its timeout.
    """
    buffers = [camera.frames(since) for camera in cameras]
    if not buffers:
        raise ValueError("cameras: expected at least one")
    for camera, buffer in zip(cameras, buffers, strict=True):
        if not buffer:
            camera.latest()  # raises where nothing new means that nothing comes any more
    return newest_match(buffers, tolerance)


def newest_match(buffers: Sequence[Sequence[Frame]], tolerance: float) -> tuple[Frame, ...] | None:
    """`synchronised` on buffers (oldest first, one per camera) that were already taken."""
    if not all(buffers):
        return None
    at = [len(buffer) - 1 for buffer in buffers]
    best, best_spread, slowest = None, math.inf, -1
    while True:
        stamps = [buffer[i].stamp for buffer, i in zip(buffers, at, strict=True)]
        spread = max(stamps) - min(stamps)
        # Only an older frame of the latest camera can bring the set closer together.
        latest = stamps.index(max(stamps))
        if spread <= tolerance and spread < best_spread:
            if best is None:
                slowest = stamps.index(min(stamps))
            best = tuple(buffer[i] for buffer, i in zip(buffers, at, strict=True))
            best_spread = spread
        elif best is not None:
            return best
        if at[latest] == 0 or latest == slowest:
            return best
        at[latest] -= 1
