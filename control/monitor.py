"""What the arms and cameras report, held to the limits."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from control.safety_limits import SafetyLimits, Violation
from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.ur5e import JOINT_LIMIT

# Safety modes of a UR controller in which its arm may move.
MOVING_MODES = ("normal", "reduced")
# Accelerations are slopes over this time [s], at least the second if readings come that slowly.
WINDOW, MIN_SPAN = 0.06, 0.03
GAP = 0.3  # a pause of the readings after which no slope reaches across [s]
# The gravest first; what a controller reports of itself is graver than anything of this list.
SEVERITY = (
    "joint angles", "pose age", "program", "clearance", "overstretch", "gripper distance",
    "tension", "force", "torque", "speed", "rotation speed", "joint speed", "acceleration",
    "rotation acceleration", "image age",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ArmReading:
    """What an arm reported.

    Attributes:
        stamp: when it was so, monotonic [s].
        robot_time: the controller's own clock [s].
        joint_angles: (6,) [rad].
        joint_velocities: (6,) [rad/s].
        T_base_tcp: (4, 4) actual pose of the TCP in the arm's base frame.
        tcp_speed: (6,) of the TCP [m/s, rad/s], base axes.
        wrench: (6,) force and torque that the world exerts on the arm at the TCP [N, N m], base
            axes.
        safety: ``"normal"``, ``"reduced"``, ``"protective_stop"``, ``"recovery"``,
            ``"safeguard_stop"``, ``"emergency_stop"``, ``"violation"``, ``"fault"`` or
            ``"disconnected"``.
        running: whether the robot's program plays, so that streamed commands have an effect.
    """

    stamp: float
    robot_time: float
    joint_angles: Array
    joint_velocities: Array
    T_base_tcp: Array
    tcp_speed: Array
    wrench: Array
    safety: str
    running: bool


class SafetyMonitor:
    """Finds what breaks the limits in readings of both arms and in the cameras' stamps.

    Measured speeds and accelerations may exceed the commands' bounds by ``measured_tolerance``.
    Of the margins that commands keep from overstretch and contact, measurements may use up half.
    Whatever is not a number breaks its limit.

    Args:
        limits: to keep.
        arms: where the arms stand; without them no distance, clearance or tension is checked.
    """

    def __init__(self, limits: SafetyLimits, arms: DualArm | None = None) -> None:
        self.limits = limits
        self.arms = arms
        self._tare = {side: np.zeros(6) for side in SIDES}
        self.reset()

    def reset(self) -> None:
        """Forgets former readings, not the tare; after a pause or a reconnection."""
        self._history = {side: _History() for side in SIDES}

    def tare(self, readings: Mapping[str, ArmReading | Sequence[ArmReading]]) -> None:
        """Takes the present wrenches, of one reading or the mean of several, for zero.

        Done at the start pose with the rod held loosely. A gripper's weight that the controller
        does not know of is tared too, as long as the gripper does not tilt.
        """
        for side, reading in readings.items():
            several = [reading] if isinstance(reading, ArmReading) else reading
            self._tare[side] = np.mean([one.wrench for one in several], axis=0)

    def check(
        self,
        now: float,
        readings: Mapping[str, ArmReading],
        image_stamps: Mapping[str, float] | None = None,
        *,
        controlling: bool = True,
    ) -> None:
        """Looks at the newest readings; called at least once in every control period.

        Args:
            now: monotonic [s].
            readings: of ``"left"`` and ``"right"``; one that is missing counts as stale.
            image_stamps: capture stamp of each camera's newest image, monotonic [s]; NaN for a
                camera that has given none.
            controlling: whether the arms are being moved, so that their programs must run.

        Raises:
            SafetyStop: naming the gravest violation, and in its message the others.
        """
        found = self.violations(now, readings, image_stamps, controlling=controlling)
        if found:
            others = "; ".join(map(str, found[1:]))
            raise found[0].stop(f"also {others}" if others else "")

    def violations(
        self,
        now: float,
        readings: Mapping[str, ArmReading],
        image_stamps: Mapping[str, float] | None = None,
        *,
        controlling: bool = True,
    ) -> list[Violation]:
        """All that ``check`` would stop for, the gravest first."""
        found: list[Violation] = []
        for side in SIDES:
            if side not in readings:
                found += _held("pose age", f"{side} arm", inf, self.limits.max_pose_age, "s")
                continue
            reading, history = readings[side], self._history[side]
            history.add(reading)
            found += _of_controller(side, reading, controlling)
            found += self._of_arm(side, reading, history, now)
        if self.arms is not None and all(side in readings for side in SIDES):
            found += self._of_both(self.arms, [readings[side] for side in SIDES])
        for name, stamp in (image_stamps or {}).items():
            age = abs(now - stamp)
            found += _held("image age", f"camera {name}", age, self.limits.max_image_age, "s")
        return sorted(found, key=_severity)

    def _of_arm(
        self, side: str, reading: ArmReading, history: "_History", now: float
    ) -> list[Violation]:
        limits, more = self.limits, 1.0 + self.limits.measured_tolerance
        arm, gripper = f"{side} arm", f"{side} gripper"
        force, torque = _sizes(reading.wrench - self._tare[side])
        speed, turn = _sizes(reading.tcp_speed)
        change, turn_change = _sizes(history.acceleration())
        joints = float(np.abs(reading.joint_velocities).max())
        # Stamps from the future are as wrong as stale ones.
        age, still = abs(now - reading.stamp), reading.stamp - history.moved_on
        return [
            *_held("pose age", arm, age, limits.max_pose_age, "s"),
            *_held("pose age", f"{arm}'s clock stands still", still, limits.max_pose_age, "s"),
            *_held("force", gripper, force, limits.max_force, "N"),
            *_held("torque", gripper, torque, limits.max_torque, "N m"),
            *_held("speed", gripper, speed, more * limits.max_speed, "m/s"),
            *_held("rotation speed", gripper, turn, more * limits.max_rotation_speed, "rad/s"),
            *_held("joint speed", arm, joints, more * limits.max_joint_speed, "rad/s"),
            *_held("acceleration", gripper, change, more * limits.max_acceleration, "m/s^2"),
            *_held(
                "rotation acceleration",
                gripper,
                turn_change,
                more * limits.max_rotation_acceleration,
                "rad/s^2",
            ),
        ]

    def _of_both(self, arms: DualArm, readings: Sequence[ArmReading]) -> list[Violation]:
        limits = self.limits
        joint_angles, tcps = self._at_one_time(arms, readings)
        gap = tcps[1] - tcps[0]
        distance = float(np.linalg.norm(gap))
        longest = limits.rod_length * (1.0 - 0.5 * limits.overstretch_margin)
        shortest = limits.min_gripper_distance * (1.0 - limits.measured_tolerance)
        between = "between the grippers"
        found = _held("overstretch", between, distance, longest, "m")
        found += _held("gripper distance", between, distance, shortest, "m", at_least=True)
        # A taut rod pulls each gripper towards the other.
        towards = gap / max(distance, 1e-9)
        for i, (side, reading) in enumerate(zip(SIDES, readings, strict=True)):
            force = arms.T_world_base[i, :3, :3] @ (reading.wrench - self._tare[side])[:3]
            tension = abs(float(force @ towards))
            found += _held("tension", f"{side} gripper", tension, limits.max_tension, "N")
        if not np.isfinite(joint_angles).all():
            return [*found, Violation("joint angles", "not finite")]
        near = arms.clearance(np.clip(joint_angles, -JOINT_LIMIT, JOINT_LIMIT))
        least = 0.5 * limits.min_arm_clearance
        for what, clearance in (
            ("between the arms", near.between_arms),
            ("arms to the table", near.to_table.min()),
            ("arms to themselves", near.within_arm.min()),
        ):
            found += _held("clearance", what, float(clearance), least, "m", at_least=True)
        return found

    def _at_one_time(self, arms: DualArm, readings: Sequence[ArmReading]) -> tuple[Array, Array]:
        """Joint angles (2, 6) [rad] and TCPs (2, 3), world [m], at the newer reading's stamp."""
        stamps = np.nan_to_num([reading.stamp for reading in readings])
        # What is staler than allowed is reported as such, not carried on.
        ahead = np.minimum(stamps.max() - stamps, self.limits.max_pose_age)
        angles = np.array([reading.joint_angles for reading in readings])
        rates = np.array([reading.joint_velocities for reading in readings])
        tcps = np.array([reading.T_base_tcp[:3, 3] for reading in readings])
        speeds = np.array([reading.tcp_speed[:3] for reading in readings])
        bases = arms.T_world_base
        tcps = bases[:, :3, :3] @ (tcps + ahead[:, None] * speeds)[:, :, None]
        return angles + ahead[:, None] * rates, tcps[:, :, 0] + bases[:, :3, 3]


class _History:
    """An arm's last velocities, and since when its clock has not moved on."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, Array]] = deque()
        self.moved_on = -inf  # stamp of the first reading with the newest robot_time

    def add(self, reading: ArmReading) -> None:
        newest = self._samples[-1][0] if self._samples else -inf
        if reading.robot_time == newest:
            return
        # A clock that went back is a controller that was started anew.
        if reading.robot_time < newest or reading.robot_time > newest + GAP:
            self._samples.clear()
        self.moved_on = reading.stamp
        self._samples.append((reading.robot_time, reading.tcp_speed))
        while len(self._samples) > 2 and self._samples[1][0] < reading.robot_time - WINDOW:
            self._samples.popleft()

    def acceleration(self) -> Array:
        """(6,) slope of the velocities over the window, least squares [m/s^2, rad/s^2].

        Far less noisy than a difference of two samples. Zero while there are too few.
        """
        if len(self._samples) < 2 or self._samples[-1][0] - self._samples[0][0] < MIN_SPAN:
            return np.zeros(6)
        times = np.array([time for time, _ in self._samples])
        velocities = np.array([velocity for _, velocity in self._samples])
        times = times - times.mean()
        return times @ velocities / (times @ times)


def _held(
    limit: str, what: str, value: float, bound: float, unit: str, *, at_least: bool = False
) -> list[Violation]:
    """The violation, if ``value`` is beyond ``bound`` or not a number."""
    good = value >= bound if at_least else value <= bound
    return [] if good else [Violation(limit, what, float(value), float(bound), unit, at_least)]


def _sizes(vector: Array) -> list[float]:
    """Norms of the two halves of a (6,) vector."""
    return np.linalg.norm(vector.reshape(2, 3), axis=1).tolist()


def _of_controller(side: str, reading: ArmReading, controlling: bool) -> Iterator[Violation]:
    if reading.safety not in MOVING_MODES:
        yield Violation(reading.safety.replace("_", " "), f"reported by the {side} arm")
    if controlling and not reading.running:
        yield Violation("program", f"the {side} arm's program does not run")


def _severity(violation: Violation) -> int:
    if violation.limit not in SEVERITY:
        return -2 if violation.limit == "emergency stop" else -1
    return SEVERITY.index(violation.limit)
