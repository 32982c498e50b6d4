"""What the rest of the program asks of an arm, and an arm without hardware."""

import bisect
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError, SafetyStop, UnreachablePose
from dlo_gym.geometry.se3 import Array, check_single_pose, log_so3
from dlo_gym.scene.arms import T_FLANGE_TCP
from sim2real.ur5e.kinematics import (
    nearest_joint_angles,
    pose_matrix,
    pose_numbers,
    tcp_poses,
)
from sim2real.ur5e.setpoint import PoseSetpoints, SetpointLimits, pose_distance

STOPS = ("protective_stop", "safeguard_stop", "emergency_stop", "violation", "fault")
MOVE_ACCELERATION = 1.0  # of move_to [rad/s^2]
HISTORY = 4.0  # [s] of readings kept


@runtime_checkable
class Arm(Protocol):
    """One arm of the cell; poses are of the TCP in the arm's own base frame.

    A context manager that closes itself. ``stop`` and ``reading`` may be called from any thread.
    """

    name: str

    def connect(self, *, control: bool) -> None:
        """Connect; without ``control`` only listen: upload nothing, move nothing.

        Raises:
            DeviceError: saying what is wrong and what to do.
            SafetyStop: for control, when the robot is in a stop.
        """
        ...

    def reading(self) -> ArmReading:
        """The newest reading; ``DeviceError`` when the link is gone or stale."""
        ...

    def readings(self, since: float) -> list[ArmReading]:
        """Readings with ``stamp > since`` (monotonic [s]), oldest first; at least 2 s are kept."""
        ...

    def servo_to(self, T_base_tcp: ArrayLike, duration: float) -> Array:
        """Stream smoothly to a pose (4, 4) within ``duration`` [s]; replaces the former target.

        Returns the pose really accepted.

        Raises:
            ValueError: on an argument that is no pose or duration.
            UnreachablePose: when the arm cannot reach it.
            DeviceError: when not connected for control, the link is lost, or the step too large.
            SafetyStop: when the robot is in a stop.
        """
        ...

    def move_to(self, target: ArrayLike, speed: float) -> None:
        """Move in joint space to a pose (4, 4) or joint angles (6,) [rad]; blocks.

        ``speed`` is that of the joint that turns most [rad/s]. Raises as ``servo_to`` does, and
        ``DeviceError`` when the move is broken off.
        """
        ...

    def stop(self) -> None:
        """Decelerate and hold, now; never raises, may be repeated."""
        ...

    def recover(self) -> None:
        """After a stop or a fault: be ready again, at rest in the present pose.

        Raises:
            DeviceError, SafetyStop: when a person has to do something first; says what.
        """
        ...

    def close(self) -> None:
        """Stop and disconnect; may be repeated."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class SimulatedArm:
    """A UR5e's kinematics with a servo lag, in this process: no sockets, no dynamics, no contact.

    Interpolation, checks and stops are those of ``UR5eArm``. It advances when it is called, up to
    the clock's time. Its joints follow the setpoints' inverse kinematics with a first-order lag;
    a stop within ``move_to`` and one of the safety system hold it at once.

    Args:
        name: "left" or "right".
        joint_angles: (6,) where it stands first [rad].
        T_flange_tcp: (4, 4) tool centre point.
        limits: of the setpoints.
        servo_lag: time constant of the joints behind their setpoints [s].
        max_step: a target farther than this from the present setpoint is refused [m].
        max_rotation_step: likewise [rad].
        unlock_protective_stop: whether ``recover`` releases a protective stop by itself.
        clock: the time [s]; tests pass their own.
        sleep: waits [s], for ``move_to``.

    Raises:
        ValueError: on joint angles or a tool that are none.
    """

    def __init__(
        self,
        name: str,
        joint_angles: ArrayLike,
        *,
        T_flange_tcp: ArrayLike = T_FLANGE_TCP,
        limits: SetpointLimits | None = None,
        servo_lag: float = 0.035,
        max_step: float = 0.05,
        max_rotation_step: float = 0.4,
        unlock_protective_stop: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.name = name
        self._T_flange_tcp = check_single_pose(T_flange_tcp, "T_flange_tcp")
        self._joints = _check_joints(joint_angles, "joint_angles")
        self._limits = limits or SetpointLimits()
        self._servo_lag = servo_lag
        self._max_step, self._max_rotation_step = max_step, max_rotation_step
        self._unlock = unlock_protective_stop
        self._clock, self._sleep = clock, sleep
        self._connected = self._control = False
        self._safety, self._halted = "normal", ""
        self._wrench = np.zeros(6)
        self._setpoints: PoseSetpoints | None = None
        self._move: _JointMove | None = None
        self._now = clock()
        self._history: deque[ArmReading] = deque()

    def connect(self, *, control: bool) -> None:
        """Connect; see ``Arm``."""
        self._advance()
        self._require_no_stop(control)
        self._connected, self._control, self._halted = True, control, ""
        self._restate()

    def reading(self) -> ArmReading:
        """The newest reading, of now."""
        self._require_connection()
        self._advance()
        return self._history[-1]

    def readings(self, since: float) -> list[ArmReading]:
        """Readings with ``stamp > since`` [s], oldest first, 125 a second."""
        self._require_connection()
        self._advance()
        stamps = [reading.stamp for reading in self._history]
        return list(self._history)[bisect.bisect_right(stamps, since) :]

    def servo_to(self, T_base_tcp: ArrayLike, duration: float) -> Array:
        """Stream to a pose; see ``Arm``."""
        target = check_single_pose(T_base_tcp, "T_base_tcp")
        if not (math.isfinite(duration) and duration > 0):
            raise ValueError(f"duration: expected a positive number of seconds, got {duration}")
        self._require_control()
        numbers = pose_numbers(target)
        if self._setpoints is None:
            start = pose_numbers(tcp_poses(self._joints, self._T_flange_tcp))
        else:
            start = self._setpoints.setpoint
        step = pose_distance(start, numbers)
        self._check_step(step.translation, self._max_step, "m")
        self._check_step(step.rotation, self._max_rotation_step, "rad")
        nearest_joint_angles(target, self._T_flange_tcp, self._joints, self.name)
        self._move = None
        if self._setpoints is None:
            self._setpoints = PoseSetpoints(start, self._limits)
        self._setpoints.move_to(numbers, duration)
        return target

    def _check_step(self, value: float, bound: float, unit: str) -> None:
        if value > bound:
            raise DeviceError(
                f"{self.name} arm: the target is {value:.4g} {unit} from the present setpoint,"
                f" at most {bound:.4g} {unit} is allowed; nothing was sent"
            )

    def move_to(self, target: ArrayLike, speed: float) -> None:
        """Move in joint space; see ``Arm``."""
        self._require_control()
        if not (math.isfinite(speed) and speed > 0):
            raise ValueError(f"speed: expected a positive joint speed [rad/s], got {speed}")
        target = np.asarray(target, dtype=np.float64)
        if target.shape == (4, 4):
            pose = check_single_pose(target, "target")
            target = nearest_joint_angles(pose, self._T_flange_tcp, self._joints, self.name)
        goal = _check_joints(target, "target")
        self._setpoints = None
        self._move = move = _JointMove(self._joints.copy(), goal, speed, self._now)
        while self._move is move and self._now < move.end:
            self._sleep(min(0.02, move.end - self._now))
            self._advance()
        if self._move is not move:
            raise DeviceError(f"{self.name} arm: the move was broken off: {self._why_stopped()}")
        self._move = None

    def stop(self) -> None:
        """Decelerate and hold; see ``Arm``."""
        self._advance()
        self._come_to_rest()

    def recover(self) -> None:
        """Ready again in the present pose; see ``Arm``."""
        self._advance()
        if self._safety == "protective_stop" and self._unlock:
            self._safety = "normal"
        self._setpoints, self._move = None, None
        self.connect(control=self._control)

    def close(self) -> None:
        """Stop and disconnect."""
        self.stop()
        self._connected = self._control = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def set_safety(self, safety: str) -> None:
        """Put the robot into a state of its safety system, such as "protective_stop"; a test's."""
        if safety not in ("normal", "reduced", *STOPS):
            raise ValueError(f"safety: expected normal, reduced or one of {STOPS}, got {safety!r}")
        self._advance()
        self._safety = safety
        if safety in STOPS:
            # The brakes need no profile: the joints stand at once.
            self._setpoints, self._move = None, None
            self._halted = f"the robot is in {safety.replace('_', ' ')}"
        self._restate()

    def set_wrench(self, wrench: ArrayLike) -> None:
        """What the world exerts at the TCP (6,), base axes [N, N m]; a simulated rod's."""
        self._advance()
        self._wrench = np.asarray(wrench, dtype=np.float64).reshape(6).copy()
        self._restate()

    def _restate(self) -> None:
        """Let the newest reading say what was just set from outside."""
        self._history[-1] = replace(
            self._history[-1],
            wrench=self._wrench.copy(),
            safety=self._safety,
            running=self._running,
        )

    @property
    def _running(self) -> bool:
        return self._control and not self._halted

    def _come_to_rest(self) -> None:
        if self._setpoints is not None:
            self._setpoints.stop()
        self._move = None

    def _why_stopped(self) -> str:
        return self._halted or "stop() was called"

    def _require_connection(self) -> None:
        if not self._connected:
            raise DeviceError(f"{self.name} arm is not connected; call connect() first")

    def _require_control(self) -> None:
        self._require_connection()
        self._advance()
        if not self._control:
            raise DeviceError(
                f"{self.name} arm only listens; connect(control=True) before it can move"
            )
        self._require_no_stop(True)
        if self._halted:
            raise SafetyStop(
                f"{self.name} arm was halted: {self._halted}; call recover()", limit="robot safety"
            )

    def _require_no_stop(self, control: bool) -> None:
        if control and self._safety in STOPS:
            raise SafetyStop(
                f"{self.name} arm is in {self._safety.replace('_', ' ')}: find the cause, release"
                " it, then call recover()",
                limit="robot safety",
            )

    def _advance(self) -> None:
        """Bring joints and history up to the clock's time."""
        now, period = self._clock(), self._limits.period
        if not self._history:
            self._record(now, self._joints, np.zeros(6))
        ticks = int((now - self._now) / period + 1e-6)
        # A history of so long is all that is kept; before it the arm just stands where it would.
        skipped = max(0, ticks - round(HISTORY / period))
        stride = max(1, round(0.008 / period))
        start = self._now + skipped * period
        self._now += ticks * period
        wanted = self._wanted_joints(ticks, skipped, stride)
        decay = 1.0 - math.exp(-stride * period / self._servo_lag)
        for row, joints in enumerate(wanted, start=1):
            before = self._joints
            self._joints = joints if self._move else before + decay * (joints - before)
            velocity = (self._joints - before) / (stride * period)
            self._record(start + row * stride * period, self._joints, velocity)
        # What is left of a stride is taken up by the next call.
        self._now -= ((ticks - skipped) % stride) * period
        while self._history[0].stamp < self._now - HISTORY:
            self._history.popleft()

    def _wanted_joints(self, ticks: int, skipped: int, stride: int) -> Sequence[Array]:
        """Joint angles that the servo heads for, one row per whole stride of ``ticks``."""
        rows = (ticks - skipped) // stride
        if self._move is not None:
            start = self._now - (ticks - skipped) * self._limits.period
            times = start + np.arange(1, rows + 1) * stride * self._limits.period
            return [self._move.at(t) for t in times]
        if self._setpoints is None:
            return [self._joints] * rows
        wanted, guess = [], self._joints
        for _ in range(min(skipped, self._setpoints.ticks_left)):
            self._setpoints.step()
        for _ in range(rows):
            for _ in range(stride):
                self._setpoints.step()
            pose = pose_matrix(self._setpoints.setpoint)
            try:
                guess = nearest_joint_angles(pose, self._T_flange_tcp, guess, self.name)
            except UnreachablePose as error:  # between two poses that can be reached
                self._setpoints, self._halted = None, str(error)
                return [*wanted, *[guess] * (rows - len(wanted))]
            wanted.append(guess)
        return wanted

    def _record(self, stamp: float, joints: Array, velocity: Array) -> None:
        T = tcp_poses(joints, self._T_flange_tcp)
        speed = np.zeros(6)
        if self._history:
            last = self._history[-1]
            span = max(stamp - last.stamp, 1e-9)
            speed[:3] = (T[:3, 3] - last.T_base_tcp[:3, 3]) / span
            speed[3:] = log_so3(T[:3, :3] @ last.T_base_tcp[:3, :3].T) / span
        self._history.append(
            ArmReading(
                stamp=stamp,
                robot_time=stamp,
                joint_angles=joints.copy(),
                joint_velocities=velocity,
                T_base_tcp=T,
                tcp_speed=speed,
                wrench=self._wrench.copy(),
                safety=self._safety,
                running=self._running,
            )
        )


class _JointMove:
    """A trapezoid of speed from ``start`` to ``goal`` (6,) [rad], all joints in step."""

    def __init__(self, start: Array, goal: Array, speed: float, now: float) -> None:
        self._start, self._way, self._since = start, goal - start, now
        distance = float(np.abs(self._way).max())
        self._speed = min(speed, math.sqrt(distance * MOVE_ACCELERATION))
        self._distance = distance
        ramp = self._speed / MOVE_ACCELERATION
        self._ramp = ramp
        self._duration = distance / self._speed + ramp if distance > 0 else 0.0
        self.end = now + self._duration

    def at(self, now: float) -> Array:
        """Joint angles (6,) [rad] at a time [s]."""
        t = min(max(now - self._since, 0.0), self._duration)
        if self._distance == 0.0:
            return self._start.copy()
        rest = self._duration - t
        if t < self._ramp:
            gone = 0.5 * MOVE_ACCELERATION * t**2
        elif rest < self._ramp:
            gone = self._distance - 0.5 * MOVE_ACCELERATION * rest**2
        else:
            gone = self._speed * (t - 0.5 * self._ramp)
        return self._start + (gone / self._distance) * self._way


def _check_joints(joint_angles: ArrayLike, name: str) -> Array:
    joints = np.asarray(joint_angles, dtype=np.float64)
    if joints.shape != (6,) or not (np.abs(joints) <= 2.0 * np.pi).all():
        raise ValueError(
            f"{name}: expected 6 joint angles within +-2 pi rad, got {joints.tolist()}"
        )
    return joints.copy()
