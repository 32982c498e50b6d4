"""Distances between the arms' capsules and obstacles."""

from math import sqrt

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_distance import local_distance, to_local

_SHRINK = (sqrt(5.0) - 1.0) / 2.0  # of the bracket, per golden-section step
_STEPS = 40  # leave 4e-9 of a segment


@njit(cache=True)
def capsule_gaps(axes, radii, obstacles, gaps):
    """Update ``gaps`` (b, m) [m] with the smallest distance of any of n capsules, ``axes``
    (b, n, 2, 3) and ``radii`` (n,), to each of m obstacles; negative where they overlap."""
    ends, point = np.empty((2, 3)), np.empty(3)
    for b in range(len(axes)):
        for m in range(len(obstacles.kinds)):
            smallest = np.inf
            for c in range(len(radii)):
                for end in range(2):
                    to_local(
                        obstacles.rotations[m], obstacles.origins[m], axes[b, c, end], ends[end]
                    )
                gap = _distance_along(
                    obstacles.kinds[m], obstacles.sizes[m], ends, point, smallest + radii[c]
                )
                smallest = min(smallest, gap - radii[c])
            gaps[b, m] = smallest


@njit(cache=True)
def _distance_along(kind, size, ends, point, enough):
    """The smallest signed distance [m] of a segment ``ends`` (2, 3) from an obstacle, in its frame;
    anything above ``enough`` where it is more than that.

    Obstacles are convex, and so is the distance along the segment.
    """
    length = 0.0
    for k in range(3):
        length += (ends[1, k] - ends[0, k]) ** 2
    middle = _distance_at(kind, size, ends, 0.5, point)
    if middle - 0.5 * sqrt(length) > enough:
        return middle
    low, high = 0.0, 1.0
    first, second = 1.0 - _SHRINK, _SHRINK
    at_first = _distance_at(kind, size, ends, first, point)
    at_second = _distance_at(kind, size, ends, second, point)
    for _ in range(_STEPS):
        if at_first < at_second:
            high, second, at_second = second, first, at_first
            first = high - _SHRINK * (high - low)
            at_first = _distance_at(kind, size, ends, first, point)
        else:
            low, first, at_first = first, second, at_second
            second = low + _SHRINK * (high - low)
            at_second = _distance_at(kind, size, ends, second, point)
    return min(
        min(at_first, at_second),
        min(_distance_at(kind, size, ends, 0.0, point), _distance_at(kind, size, ends, 1.0, point)),
    )


@njit(cache=True)
def _distance_at(kind, size, ends, fraction, point):
    for k in range(3):
        point[k] = (1.0 - fraction) * ends[0, k] + fraction * ends[1, k]
    return local_distance(kind, size, point)
