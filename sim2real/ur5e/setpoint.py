"""Smooth setpoints between control steps: plain Python, tens of microseconds each.

Targets come about ten times a second, the robot wants a setpoint every 2 ms. A *reference* moves
at constant speed from where it is to the newest target and arrives after the asked duration; two
moving averages in a row, of width ``window`` and ``jerk_window``, smooth it (trajectories by
cascaded FIR filters: Biagiotti and Melchiorri 2012). What that buys, for any sequence of targets:

- A steady stream of targets gives a steady speed. A plan that ends at rest at every target, such
  as a quintic, stops and goes instead; one that ends with a guessed velocity overshoots.
- A setpoint is an average of past references, which lie between targets: nothing overshoots.
- Position, velocity and acceleration are continuous, and their bounds hold for every sequence:
  the reference's speed is limited to ``max_speed``, the acceleration to ``2 max_speed / window``.
- A target that stays is reached exactly, ``window + jerk_window`` after the reference; holding the
  reference still is a stop profile of that length. The price is a lag of half of it.

Poses are 7 numbers, x y z [m] and a unit quaternion wxyz. Quaternions are averaged by component
and normalised, within a fraction of a percent of the mean rotation over so short a window.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import acos, atan2, ceil, cos, dist, hypot, isfinite, sin, sqrt
from typing import NamedTuple

Vector = tuple[float, ...]


@dataclass(frozen=True)
class SetpointLimits:
    """Bounds of the setpoints' motion.

    Attributes:
        period: between two setpoints [s].
        max_speed, max_rotation_speed: of the TCP [m/s], [rad/s].
        max_acceleration, max_rotation_acceleration: of the TCP [m/s^2], [rad/s^2].
        max_joint_speed: of each joint, where setpoints are joint angles [rad/s].
        max_joint_acceleration: likewise [rad/s^2].
        jerk_window: over which an acceleration builds up [s].

    Raises:
        ValueError: naming the field.
    """

    period: float = 0.002
    max_speed: float = 0.25
    max_rotation_speed: float = 1.5
    max_acceleration: float = 5.0
    max_rotation_acceleration: float = 30.0
    max_joint_speed: float = 1.5
    max_joint_acceleration: float = 30.0
    jerk_window: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive number, got {value}")

    @property
    def window(self) -> float:
        """Width [s] of the first average: a full reversal stays within the acceleration bounds."""
        return 2.0 * max(
            self.max_speed / self.max_acceleration,
            self.max_rotation_speed / self.max_rotation_acceleration,
        )

    @property
    def joint_window(self) -> float:
        """Width [s] of the first average where setpoints are joint angles."""
        return 2.0 * self.max_joint_speed / self.max_joint_acceleration

    @property
    def lag(self) -> float:
        """By how much [s] a setpoint trails the reference."""
        return 0.5 * (self.window + self.jerk_window)


class MovingAverage:
    """The mean of the last ``width`` vectors pushed; the sum is renewed once per round."""

    def __init__(self, width: int, start: Sequence[float]) -> None:
        self.width = width
        self._ring = [tuple(start)] * width
        self._sum = [width * value for value in start]
        self._next = 0

    def push(self, vector: Vector) -> Vector:
        ring, index = self._ring, self._next
        oldest, ring[index] = ring[index], vector
        self._next = index = index + 1
        if index == len(ring):
            self._next = 0
            self._sum = [sum(column) for column in zip(*ring, strict=True)]
        else:
            self._sum = [
                s + new - old for s, new, old in zip(self._sum, vector, oldest, strict=True)
            ]
        share = 1.0 / len(ring)
        return tuple([s * share for s in self._sum])


class PoseSetpoints:
    """Setpoints of TCP poses; see the module.

    Args:
        start: 7 numbers, where the TCP is and stands still: the first setpoint.
        limits: of the motion.
    """

    def __init__(self, start: Sequence[float], limits: SetpointLimits) -> None:
        self._limits = limits
        self._reference = self._from = self._to = self._setpoint = _check(start, 7, "start")
        self._ticks = self._tick = 0
        ticks = limits.window / limits.period
        self._smooth = MovingAverage(max(1, ceil(ticks - 1e-9)), start)
        self._round = MovingAverage(max(1, ceil(limits.jerk_window / limits.period - 1e-9)), start)

    @property
    def setpoint(self) -> Vector:
        """The newest setpoint, 7 numbers."""
        return self._setpoint

    @property
    def ticks_left(self) -> int:
        """Steps until it stands, if no other target comes."""
        return self._ticks - self._tick + self._smooth.width + self._round.width

    def move_to(self, target: Sequence[float], duration: float) -> None:
        """Head for ``target`` (7 numbers), to arrive in ``duration`` [s] or as limits allow."""
        limits = self._limits
        target = _check(target, 7, "target")
        if not (isfinite(duration) and duration > 0):
            raise ValueError(f"duration: expected a positive number of seconds, got {duration}")
        start = self._reference
        if sum(a * b for a, b in zip(start[3:], target[3:], strict=True)) < 0:
            target = (*target[:3], *(-value for value in target[3:]))
        needed = max(
            duration,
            dist(start[:3], target[:3]) / limits.max_speed,
            2.0 * _half_angle(start, target) / limits.max_rotation_speed,
        )
        self._from, self._to = start, target
        self._tick, self._ticks = 0, max(1, ceil(needed / limits.period - 1e-9))

    def stop(self) -> None:
        """Come to rest within ``window + jerk_window``; what was asked before is forgotten."""
        self._ticks = self._tick = 0
        self._from = self._to = self._reference

    def step(self) -> Vector:
        """The next setpoint, one period later: 7 numbers."""
        if self._tick < self._ticks:
            self._tick += 1
            self._reference = _between(self._from, self._to, self._tick / self._ticks)
        x, y, z, *q = self._round.push(self._smooth.push(self._reference))
        scale = 1.0 / sqrt(sum([value * value for value in q]))
        self._setpoint = (x, y, z, q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)
        return self._setpoint


class JointSetpoints:
    """Setpoints of joint angles; the counterpart of ``PoseSetpoints``.

    Args:
        start: 6 joint angles [rad] at which the arm stands still: the first setpoint.
        limits: of the motion.
    """

    def __init__(self, start: Sequence[float], limits: SetpointLimits) -> None:
        self._limits = limits
        self._reference = self._from = self._to = self._setpoint = _check(start, 6, "start")
        self._ticks = self._tick = 0
        ticks = limits.joint_window / limits.period
        self._smooth = MovingAverage(max(1, ceil(ticks - 1e-9)), start)
        self._round = MovingAverage(max(1, ceil(limits.jerk_window / limits.period - 1e-9)), start)

    @property
    def setpoint(self) -> Vector:
        """The newest setpoint, 6 joint angles [rad]."""
        return self._setpoint

    def move_to(self, target: Sequence[float], duration: float) -> None:
        """Head for 6 joint angles [rad], to arrive in ``duration`` [s] or as limits allow."""
        target = _check(target, 6, "target")
        if not (isfinite(duration) and duration > 0):
            raise ValueError(f"duration: expected a positive number of seconds, got {duration}")
        way = max(abs(b - a) for a, b in zip(self._reference, target, strict=True))
        needed = max(duration, way / self._limits.max_joint_speed)
        self._from, self._to = self._reference, target
        self._tick, self._ticks = 0, max(1, ceil(needed / self._limits.period - 1e-9))

    def stop(self) -> None:
        """Come to rest within ``joint_window + jerk_window``."""
        self._ticks = self._tick = 0
        self._from = self._to = self._reference

    def step(self) -> Vector:
        """The next setpoint, one period later: 6 joint angles [rad]."""
        if self._tick < self._ticks:
            self._tick += 1
            share = self._tick / self._ticks
            self._reference = tuple(
                [a + share * (b - a) for a, b in zip(self._from, self._to, strict=True)]
            )
        self._setpoint = self._round.push(self._smooth.push(self._reference))
        return self._setpoint


class Distance(NamedTuple):
    """Between two poses."""

    translation: float  # [m]
    rotation: float  # [rad]


def pose_distance(a: Sequence[float], b: Sequence[float]) -> Distance:
    """How far apart two poses of 7 numbers are."""
    return Distance(dist(a[:3], b[:3]), 2.0 * _half_angle(a, b))


def from_pose_vector(vector: Sequence[float]) -> Vector:
    """7 numbers of a UR pose vector, x y z [m] and a rotation vector [rad]."""
    x, y, z, rx, ry, rz = vector
    angle = hypot(rx, ry, rz)
    scale = sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    return (x, y, z, cos(0.5 * angle), scale * rx, scale * ry, scale * rz)


def to_pose_vector(pose: Sequence[float]) -> Vector:
    """The UR pose vector, x y z [m] and a rotation vector of at most pi [rad], of 7 numbers."""
    x, y, z, w, i, j, k = pose
    sine = hypot(i, j, k)
    if w < 0.0:
        w, i, j, k = -w, -i, -j, -k
    scale = 2.0 * atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return (x, y, z, scale * i, scale * j, scale * k)


def _check(vector: Sequence[float], size: int, name: str) -> Vector:
    values = tuple(float(value) for value in vector)
    if len(values) != size or not all(map(isfinite, values)):
        raise ValueError(f"{name}: expected {size} finite numbers, got {values}")
    return values


def _half_angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Half the angle [rad] between two orientations, by the chord, exact for small angles."""
    plus = dist(a[3:], b[3:])
    minus = hypot(*[x + y for x, y in zip(a[3:], b[3:], strict=True)])
    return 2.0 * atan2(min(plus, minus), max(plus, minus))


def _between(a: Vector, b: Vector, share: float) -> Vector:
    """The pose at ``share`` of the way: a straight line and a turn at constant rate (slerp)."""
    if share >= 1.0:
        return b
    rest = 1.0 - share
    cosine = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6]
    wa, wb = rest, share
    if cosine < 1.0 - 1e-9:
        angle = acos(cosine)
        sine = sin(angle)
        wa, wb = sin(rest * angle) / sine, sin(share * angle) / sine
    position = [rest * x + share * y for x, y in zip(a[:3], b[:3], strict=True)]
    q = [wa * x + wb * y for x, y in zip(a[3:], b[3:], strict=True)]
    scale = 1.0 / sqrt(sum([value * value for value in q]))
    return (*position, q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)
