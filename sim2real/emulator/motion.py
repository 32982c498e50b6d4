"""How the emulated arm moves: the controller's trajectory generator, one call per tick.

The mechanics are taken as perfect, the joints are where the generator puts them; what is kept is
what a client can notice: the lag of servoj, trapezoids of moves, ramps of speed commands,
decelerations, the speed and acceleration limits, and the reasons a real arm stops by itself.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from sim2real.emulator import kinematics
from sim2real.emulator._kernels_motion import TICK, joint_velocity, largest_gap, ramp, servo
from sim2real.emulator.kinematics import SINGULAR_DETERMINANT, Array
from sim2real.emulator.trapezoid import TrapezoidPath, pose_between, way_length

JOINT_LIMIT = 2.0 * math.pi  # every joint turns +-360 degrees
_ZERO = np.zeros(6)


@dataclass(frozen=True)
class MotionLimits:
    """What the arm can do, and how far a servo command may jump.

    Attributes:
        joint_speed: [rad/s]; the UR5e's 180 degrees per second.
        joint_acceleration: [rad/s^2] of any command; a stop uses what it is asked for.
        servo_lag: time constant of servoj [s], lookahead included; the real one is about 35 ms.
        servo_jump: a servo target farther than this from the joints [rad] is a fault.
        stop_deceleration: of a protective stop or the end of a program [rad/s^2].
    """

    joint_speed: float = math.pi
    joint_acceleration: float = 40.0
    servo_lag: float = 0.035
    servo_jump: float = 0.6
    stop_deceleration: float = 10.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: expected a finite number above 0, got {value}")


class Mode(Enum):
    """What the generator is doing."""

    HOLD = "hold"
    SERVO = "servo"
    SPEED_JOINTS = "speed_joints"
    SPEED_TOOL = "speed_tool"
    MOVE_JOINTS = "move_joints"
    MOVE_TOOL = "move_tool"
    STOP = "stop"


class MotionFault(Exception):
    """The arm cannot do what it was asked to and stops by itself; says why."""


class Motion:
    """Joint angles that follow one command at a time.

    Attributes:
        q, qd, qdd: (6,) joint angles, velocities, accelerations [rad], [rad/s], [rad/s^2].
        target: (6,) the angles the present command leads to [rad].
        T_flange_tcp: (4, 4) the tool centre point.
        mode: what is being done.
    """

    def __init__(self, joint_angles: Array, T_flange_tcp: Array, limits: MotionLimits) -> None:
        self.limits = limits
        self.T_flange_tcp = T_flange_tcp.copy()
        self.q = np.array(joint_angles, dtype=np.float64)
        self.qd = np.zeros(6)
        self.qdd = np.zeros(6)
        self.target = self.q.copy()
        self.mode = Mode.HOLD
        self._before = np.zeros(6)
        self._wanted = np.zeros(6)  # of a speed command: joint or tool velocity
        self._tool_speed = np.zeros(6)  # ramped towards it, base axes
        self._acceleration = 1.0
        self._path: TrapezoidPath | None = None
        self._move: _Move | None = None
        self._stop_by_tool = False
        self._speed_fraction = 1.0
        self.speed_slider = 1.0

    @property
    def standing(self) -> bool:
        """Whether nothing moves and nothing is about to."""
        return self.mode is Mode.HOLD or (self.mode is Mode.SERVO and not self.qd.any())

    def teleport(self, joint_angles: Array) -> None:
        """Put the joints elsewhere (6,) [rad] at once."""
        self.q[:] = self.target[:] = joint_angles
        self.hold()

    def hold(self) -> None:
        """Stand still from this tick on."""
        self.qd[:] = self.qdd[:] = self._before[:] = 0.0
        self._path = self._move = None
        self.mode = Mode.HOLD

    # Commands

    def servo_joints(self, target: Array) -> None:
        """Follow a joint target (6,) [rad] with the servo's lag."""
        _check_within_range(target)
        jump = largest_gap(target, self.q)
        if jump > self.limits.servo_jump:
            raise MotionFault(f"servo target is {jump:.2f} rad away from the joints")
        self.target[:] = target
        self._path = self._move = None
        self.mode = Mode.SERVO

    def servo_tool(self, T_base_tcp: Array) -> None:
        """Follow a TCP pose (4, 4) with the servo's lag."""
        self.servo_joints(self.solve(T_base_tcp, self.q))

    def solve(self, T_base_tcp: Array, near: Array) -> Array:
        """Joint angles (6,) of a TCP pose, by Newton from ``near``; MotionFault without one."""
        q = near.copy()
        determinant = kinematics.inverse_from(T_base_tcp, self.T_flange_tcp, q, 1e-9)
        if determinant < SINGULAR_DETERMINANT:
            raise MotionFault("pose is out of reach or the arm would be singular")
        return q

    def speed_joints(self, velocity: Array, acceleration: float) -> None:
        """Ramp to joint velocities (6,) [rad/s], the leading joint at ``acceleration``."""
        self._start_speed(Mode.SPEED_JOINTS, velocity, acceleration)

    def speed_tool(self, velocity: Array, acceleration: float) -> None:
        """Ramp to a TCP velocity (6,) [m/s, rad/s], base axes, at ``acceleration`` [m/s^2]."""
        if self.mode is not Mode.SPEED_TOOL:
            T, J = np.empty((4, 4)), np.empty((6, 6))
            kinematics.forward_and_jacobian(self.q, self.T_flange_tcp, T, J)
            self._tool_speed[:] = J @ self.qd
        self._start_speed(Mode.SPEED_TOOL, velocity, acceleration)

    def _start_speed(self, mode: Mode, velocity: Array, acceleration: float) -> None:
        if not np.isfinite(velocity).all():
            raise MotionFault("a speed is not a number")
        self._wanted[:] = velocity
        self._acceleration = _positive(acceleration)
        self._path = self._move = None
        self.mode = mode

    def move_joints(self, target: Array, speed: float, acceleration: float) -> None:
        """Go to joint angles (6,) [rad] by a trapezoid of the leading joint, from standstill.

        An arm in motion is stopped first.
        """
        _check_within_range(target)
        self._begin(_Move(Mode.MOVE_JOINTS, target.copy(), speed, acceleration))

    def move_tool(self, T_base_tcp: Array, speed: float, acceleration: float) -> None:
        """Go to a TCP pose (4, 4) in a straight line by a trapezoid, from standstill."""
        self._begin(_Move(Mode.MOVE_TOOL, T_base_tcp.copy(), speed, acceleration))

    def _begin(self, move: "_Move") -> None:
        self._path = None
        if self.qd.any():
            self.stop(self.limits.stop_deceleration)
            self._move = move
            return
        self._move = move
        speed, acceleration = _positive(move.speed), _positive(move.acceleration)
        if move.mode is Mode.MOVE_JOINTS:
            self.target[:] = move.goal
            start, way = self.q.copy(), move.goal - self.q
            length = float(np.abs(way).max())
            speed = min(speed, self.limits.joint_speed)
            acceleration = min(acceleration, self.limits.joint_acceleration)
        else:
            start, way = kinematics.forward(self.q, self.T_flange_tcp), np.empty(6)
            kinematics.pose_difference(start, move.goal, way)
            length = way_length(way)
        self._path = TrapezoidPath(start, way, length, speed, acceleration)
        self.mode = move.mode

    def stop(self, deceleration: float, *, by_tool: bool = False) -> None:
        """Decelerate: the leading joint at [rad/s^2], or the TCP at [m/s^2] if ``by_tool``."""
        self._acceleration = _positive(deceleration)
        self._stop_by_tool = by_tool
        self._path = self._move = None
        self.mode = Mode.STOP if self.qd.any() else Mode.HOLD

    def pause(self) -> "PausedMotion":
        """Decelerate as a protective stop does; what was under way can be resumed."""
        paused = PausedMotion(
            self._move.mode if self._move else self.mode,
            self.target.copy(),
            self._wanted.copy(),
            self._acceleration,
            self._move,
        )
        self.stop(self.limits.stop_deceleration)
        return paused

    def resume(self, paused: "PausedMotion") -> None:
        """Go on with what ``pause`` interrupted, as the real robot does: to the OLD target."""
        if paused.move is not None:
            self._begin(paused.move)
        elif paused.mode is Mode.SERVO:
            self.target[:] = paused.target
            self.mode = Mode.SERVO
        elif paused.mode in (Mode.SPEED_JOINTS, Mode.SPEED_TOOL):
            self._tool_speed[:] = 0.0
            self._start_speed(paused.mode, paused.wanted, paused.acceleration)

    # One tick

    def step(self) -> None:
        """Advance the joints by one tick.

        Raises:
            MotionFault: if the command leads out of the arm's limits; the joints have not moved.
        """
        limits = self.limits
        if self.mode is Mode.HOLD:
            self.qdd[:] = 0.0
            return
        if self.mode is Mode.SERVO:
            servo(
                *(self.q, self.qd, self.qdd, self.target, limits.servo_lag),
                *(limits.joint_speed, limits.joint_acceleration),
            )
            self._check_range()
            return
        self._before[:] = self.qd
        if self.mode is Mode.SPEED_JOINTS:
            wanted = np.clip(self._wanted, -limits.joint_speed, limits.joint_speed)
            bound = min(self._acceleration, limits.joint_acceleration)
            ramp(self.q, self.qd, wanted, bound)
        elif self.mode is Mode.SPEED_TOOL:
            self._step_tool_speed()
        elif self.mode is Mode.STOP:
            self._step_stop()
        else:
            self._step_move()
        np.subtract(self.qd, self._before, out=self.qdd)
        self.qdd /= TICK
        self._check_range()

    def _check_range(self) -> None:
        if largest_gap(self.q, _ZERO) > JOINT_LIMIT:
            self.q[:] -= self.qd * TICK
            raise MotionFault("a joint is at the end of its range")

    def _step_tool_speed(self) -> None:
        gap = self._wanted - self._tool_speed
        length = way_length(gap)
        most = self._acceleration * TICK
        self._tool_speed += gap * min(1.0, most / length) if length > 0.0 else gap
        wanted = np.empty(6)
        determinant = joint_velocity(self.q, self.qd, self.T_flange_tcp, self._tool_speed, wanted)
        if determinant < SINGULAR_DETERMINANT:
            raise MotionFault("the arm is too close to a singularity")
        if np.abs(wanted).max() > self.limits.joint_speed:
            raise MotionFault("a joint would have to turn faster than it can")
        ramp(self.q, self.qd, wanted, self.limits.joint_acceleration)

    def _step_stop(self) -> None:
        speed = float(np.abs(self.qd).max())
        if self._stop_by_tool:
            T, J = np.empty((4, 4)), np.empty((6, 6))
            kinematics.forward_and_jacobian(self.q, self.T_flange_tcp, T, J)
            speed = max(way_length(J @ self.qd), 1e-9)
        lost = self._acceleration * TICK / max(speed, 1e-12)
        hardest = (
            2.0 * self.limits.joint_acceleration * TICK / max(float(np.abs(self.qd).max()), 1e-12)
        )
        self.qd *= max(0.0, 1.0 - min(lost, hardest))
        self.q += self.qd * TICK
        if not self.qd.any():
            self.target[:] = self.q
            self.mode = Mode.HOLD
            if self._move is not None:
                self._begin(self._move)

    def _step_move(self) -> None:
        path = self._path
        assert path is not None
        change = max(-2.0 * TICK, min(2.0 * TICK, self.speed_slider - self._speed_fraction))
        self._speed_fraction += change
        share = path.advance(TICK * self._speed_fraction)
        before = self.q.copy()
        if self.mode is Mode.MOVE_JOINTS:
            self.q[:] = path.start + share * path.way
        else:
            T = pose_between(path.start, path.way, share)
            self.q[:] = self.solve(T, self.q)
        self.qd[:] = (self.q - before) / TICK
        if np.abs(self.qd).max() > self.limits.joint_speed * (1.0 + 1e-9):
            self.q[:], self.qd[:] = before, self._before
            raise MotionFault("a joint would have to turn faster than it can")
        if path.done:
            self.target[:] = self.q
            self._path = self._move = None
            self.qd[:] = 0.0
            self.mode = Mode.HOLD


@dataclass(frozen=True, eq=False)
class _Move:
    """A move that was asked for: the goal is (6,) joint angles or a (4, 4) TCP pose."""

    mode: Mode
    goal: Array
    speed: float
    acceleration: float


@dataclass(frozen=True, eq=False)
class PausedMotion:
    """What a pause interrupted."""

    mode: Mode
    target: Array
    wanted: Array
    acceleration: float
    move: _Move | None


def _positive(value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise MotionFault(f"expected a speed or acceleration above 0, got {value}")
    return float(value)


def _check_within_range(target: Array) -> None:
    if not largest_gap(target, _ZERO) <= JOINT_LIMIT + 1e-9:
        raise MotionFault("a joint target is not a number or outside the joint's range")
