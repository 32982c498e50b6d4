"""Moves of the emulated arm: a way passed with a trapezoid of speed."""

import math

import numpy as np

from sim2real.emulator import kinematics
from sim2real.emulator.kinematics import Array

# A turn of the tool counts as this much way [m/rad], in moves that turn more than they shift.
TURN_LENGTH = 0.25


class TrapezoidPath:
    """A way of ``length`` passed in a trapezoid (or triangle) of speed."""

    def __init__(
        self, start: Array, way: Array, length: float, speed: float, acceleration: float
    ) -> None:
        self.start, self.way = start, way
        self._length = length
        self._peak = min(speed, math.sqrt(length * acceleration))
        self._acceleration = acceleration
        self._ramp = self._peak / acceleration
        self._duration = self._ramp + length / self._peak if length > 0.0 else 0.0
        self._time = 0.0

    @property
    def done(self) -> bool:
        return self._time >= self._duration

    def advance(self, duration: float) -> float:
        """The share 0..1 of the way that is behind after ``duration`` [s] more."""
        self._time = min(self._time + duration, self._duration)
        if self.done:
            return 1.0
        left = self._duration - self._time
        if self._time < self._ramp:
            way = 0.5 * self._acceleration * self._time**2
        elif left < self._ramp:
            way = self._length - 0.5 * self._acceleration * left**2
        else:
            way = self._peak * (self._time - 0.5 * self._ramp)
        return way / self._length


def pose_between(start: Array, way: Array, share: float) -> Array:
    """The pose (4, 4) at ``share`` of the shift and turn ``way`` (6,) from ``start``."""
    turn = kinematics.transform(np.concatenate([np.zeros(3), share * way[3:]]))
    T = start.copy()
    T[:3, :3] = turn[:3, :3] @ start[:3, :3]
    T[:3, 3] += share * way[:3]
    return T


def way_length(way: Array) -> float:
    """Length [m] of a shift and turn (6,), whichever is longer."""
    x, y, z, rx, ry, rz = way.tolist()
    return max(
        math.sqrt(x * x + y * y + z * z), TURN_LENGTH * math.sqrt(rx * rx + ry * ry + rz * rz)
    )
