"""The handle of a real UR5e: what the rest of the program calls."""

import contextlib
import math
import time
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError, SafetyStop
from dlo_gym.geometry.se3 import Array, check_single_pose
from sim2real.ur5e import shared_state
from sim2real.ur5e.child import StreamingProcess
from sim2real.ur5e.dashboard import Dashboard, stop_program, unlock_protective_stop
from sim2real.ur5e.kinematics import (
    nearest_joint_angles,
    pose_matrix,
    pose_numbers,
    pose_vector_matrices,
    tcp_poses,
)
from sim2real.ur5e.process import safety_name
from sim2real.ur5e.setpoint import pose_distance
from sim2real.ur5e.settings import UR5eSettings
from sim2real.ur5e.shared_state import RawReading

MOVE_ACCELERATION = 1.0  # of move_to [rad/s^2]
MAX_TOOL_DIFFERENCE = 0.02  # [m] between the controller's TCP and our own kinematics


class UR5eArm:
    """One UR5e behind ur_rtde in a process of its own; see ``sim2real.arm.Arm`` for the calls.

    ``stop`` and ``reading`` may be called from any thread, the rest from one. Stamps of readings
    are the controller's own times on this machine's clock (``RobotClock``); they lie before the
    arrival by the shortest transport delay at most. Once a fault or a stop of the safety system
    has halted the arm, ``servo_to`` and ``move_to`` raise until ``recover``. A plain ``stop``
    doesn't latch: the next target starts from where the arm stands.

    Args:
        name: "left" or "right"; it appears in every message.
        settings: where the controller is and how the arm may move.
    """

    def __init__(self, name: str, settings: UR5eSettings) -> None:
        self.name, self.settings = name, settings
        self._child: StreamingProcess | None = None
        self._control = False
        self._moves = 0

    def connect(self, *, control: bool) -> None:
        """Connect; with ``control`` upload the program, set tool, payload and watchdog.

        Nothing moves. Without ``control`` nothing is written to the robot either, and the TCP of
        the readings is the one set on the controller.

        Raises:
            DeviceError: naming what is wrong and what to do.
            SafetyStop: for control, when the robot is in a stop.
        """
        self.close()
        self._control = control
        if control:
            self._check_ready()
        self._child = StreamingProcess(self.name, self.settings, control=control)
        try:
            if control:
                self._check_tool()
        except BaseException:
            self.close()
            raise

    def _check_ready(self) -> None:
        """Ask the dashboard whether the robot can be moved at all; ur_rtde would only hang."""
        where = f"{self.name} arm at {self.settings.address}"
        try:
            with Dashboard(self.settings.address) as dashboard:
                safety = dashboard.ask("safetystatus").rpartition(":")[2].strip().upper()
                mode = dashboard.ask("robotmode").rpartition(":")[2].strip().upper()
                remote = dashboard.ask("is in remote control").strip().lower()
        except OSError as error:
            raise DeviceError(
                f"{where}: its dashboard server does not answer ({error}); check the address, the"
                " cable and that the controller is on"
            ) from None
        if safety not in ("NORMAL", "REDUCED"):
            raise SafetyStop(
                f"{where} is in {safety.lower().replace('_', ' ')}: find the cause, release it on"
                " the pendant, then call recover()",
                limit="robot safety",
            )
        if mode != "RUNNING":
            raise DeviceError(
                f"{where} is in mode {mode}: power it on and release the brakes on the pendant"
            )
        if remote == "false":
            raise DeviceError(f"{where} is in local control: switch the pendant to remote control")

    def _check_tool(self) -> None:
        difference = self.tool_difference()
        if difference > MAX_TOOL_DIFFERENCE:
            raise DeviceError(
                f"{self.name} arm: the controller reports its TCP {difference * 1e3:.0f} mm from"
                f" where a UR5e with this tool has it (allowed {MAX_TOOL_DIFFERENCE * 1e3:.0f});"
                " wrong robot model or address?"
            )

    def tool_difference(self) -> float:
        """Distance [m] between the TCP reported and the one of our kinematics and tool.

        Some millimetres are the arm's own calibration; more is another tool on the controller.
        """
        reading = self.reading()
        ours = tcp_poses(reading.joint_angles, self.settings.T_flange_tcp)
        return float(np.linalg.norm(ours[:3, 3] - reading.T_base_tcp[:3, 3]))

    @property
    def client_pid(self) -> int | None:
        """Process id of the streaming client; None when not connected."""
        return None if self._child is None else self._child.pid

    def reading(self) -> ArmReading:
        """The newest reading.

        Raises:
            DeviceError: when not connected, or the link is gone or stale.
        """
        child = self._connected()
        newest = child.memory.newest_readings(4)
        age = time.monotonic() - newest[-1].arrival if newest else math.inf
        if age > self.settings.stale_after:
            trouble = child.trouble()
            raise DeviceError(
                trouble
                or f"{self.name} arm at {self.settings.address}: the controller sent no data for"
                f" {age:.2f} s (allowed {self.settings.stale_after:g} s); call recover()"
            )
        return _arm_readings(newest[-1:])[0]

    def readings(self, since: float) -> list[ArmReading]:
        """The history with ``stamp > since`` (monotonic [s]), oldest first.

        The last 4000 readings are kept: 32 s at 125 Hz, 8 s at 500 Hz.

        Also after the link broke.

        Raises:
            DeviceError: when not connected.
        """
        child = self._connected()
        wanted = (time.monotonic() - since + 0.1) * self.settings.reading_hz * 1.2
        count = int(min(max(wanted, 4.0), shared_state.RING_SLOTS))
        return _arm_readings(
            [raw for raw in child.memory.newest_readings(count) if raw.stamp > since]
        )

    def servo_to(self, T_base_tcp: ArrayLike, duration: float) -> Array:
        """Stream smoothly towards a TCP pose (4, 4), reached by the reference in ``duration`` [s].

        The setpoints trail the reference by ``settings.setpoint_limits.lag``. For an even speed
        pass the control period or a little more as duration. Returns the pose accepted.

        Raises:
            ValueError: on an argument that is no pose or duration.
            UnreachablePose: when the arm cannot reach it; nothing is sent.
            DeviceError: when not connected for control, the link is broken, or the target is too
                far from the present setpoint.
            SafetyStop: when the robot is in a stop.
        """
        target = check_single_pose(T_base_tcp, "T_base_tcp")
        if not (math.isfinite(duration) and duration > 0):
            raise ValueError(f"duration: expected a positive number of seconds, got {duration}")
        child = self._controllable()
        reading = self.reading()
        self._check_running(reading)
        numbers = pose_numbers(target)
        self._check_step(numbers, child, reading)
        joints = self._joint_angles_for(target, reading.joint_angles)
        self._check_joint_step(joints - reading.joint_angles, duration)
        is_servoj = self.settings.servo == "servoj"
        child.memory.send(tuple(joints.tolist()) if is_servoj else numbers, duration)
        return target

    def move_to(self, target: ArrayLike, speed: float) -> None:
        """Move in joint space (moveJ) to a TCP pose (4, 4) or joint angles (6,) [rad]; blocks.

        Args:
            target: where to.
            speed: of the joint that turns most, up to ``settings.max_joint_speed`` [rad/s].

        Raises:
            ValueError: on a target or speed out of range.
            UnreachablePose: when the arm cannot reach it.
            DeviceError: when the arm does not arrive, says why; also after ``stop``.
            SafetyStop: when the robot is in a stop.
        """
        child = self._controllable()
        if not 0 < speed <= self.settings.max_joint_speed:
            raise ValueError(
                f"speed: expected up to {self.settings.max_joint_speed:g} rad/s, got {speed}"
            )
        reading = self.reading()
        self._check_running(reading)
        joints = self._move_target(target, reading.joint_angles)
        way = float(np.abs(joints - reading.joint_angles).max())
        deadline = time.monotonic() + 2.0 * (way / speed + speed / MOVE_ACCELERATION) + 3.0
        self._moves += 1
        stops = child.memory.stops_asked
        child.request(
            do="move",
            number=self._moves,
            joints=joints.tolist(),
            speed=speed,
            acceleration=MOVE_ACCELERATION,
            stops=stops,
        )
        try:
            self._await_move(child, deadline)
        except BaseException:
            self.stop()
            raise

    def _move_target(self, target: ArrayLike, joint_angles: Array) -> Array:
        target = np.asarray(target, dtype=np.float64)
        if target.shape == (4, 4):
            return self._joint_angles_for(check_single_pose(target, "target"), joint_angles)
        if target.shape != (6,) or not (np.abs(target) <= 2.0 * np.pi).all():
            raise ValueError(
                "target: expected a pose (4, 4) or 6 joint angles within +-2 pi rad, got"
                f" {target.tolist() if target.size < 20 else target.shape}"
            )
        return target

    def _await_move(self, child: StreamingProcess, deadline: float) -> None:
        while True:
            reply = child.await_reply(min(deadline, time.monotonic() + 0.2))
            if reply is not None and reply.get("move") == self._moves:
                break
            trouble = child.trouble()
            if trouble and reply is None:
                raise DeviceError(trouble)
            if time.monotonic() > deadline:
                raise DeviceError(f"{self.name} arm: the move did not end in time")
        if not reply["done"]:
            self._controllable()
            raise DeviceError(f"{self.name} arm: the move was broken off: {reply['why']}")

    def _joint_angles_for(self, T_base_tcp: Array, joint_angles: Array) -> Array:
        return nearest_joint_angles(T_base_tcp, self.settings.T_flange_tcp, joint_angles, self.name)

    def _check_running(self, reading: ArmReading) -> None:
        if reading.safety not in ("normal", "reduced"):
            raise SafetyStop(
                f"{self.name} arm is in {reading.safety.replace('_', ' ')}; call recover() when"
                " its cause is gone",
                limit="robot safety",
            )

    def _check_step(
        self, target: tuple[float, ...], child: StreamingProcess, reading: ArmReading
    ) -> None:
        setpoint = child.status().setpoint
        if len(setpoint) == 6:
            setpoint = pose_numbers(tcp_poses(setpoint, self.settings.T_flange_tcp))
        elif not setpoint:
            setpoint = pose_numbers(reading.T_base_tcp)
        step = pose_distance(setpoint, target)
        for value, bound, unit in (
            (step.translation, self.settings.max_step, "m"),
            (step.rotation, self.settings.max_rotation_step, "rad"),
        ):
            if value > bound:
                raise DeviceError(
                    f"{self.name} arm: the target is {value:.4g} {unit} from the present setpoint,"
                    f" at most {bound:.4g} {unit} is allowed; nothing was sent"
                )

    def _check_joint_step(self, step: Array, duration: float) -> None:
        """A small step that asks for much joint motion is near a singularity."""
        joint = int(np.argmax(np.abs(step)))
        # The present joints trail the target by the smoothing and the robot's own lag.
        allowed = self.settings.max_joint_speed * (
            duration + 2.0 * self.settings.setpoint_limits.lag + self.settings.lookahead_time
        )
        if abs(step[joint]) > allowed:
            raise DeviceError(
                f"{self.name} arm: the target asks {abs(step[joint]):.3g} rad of joint {joint + 1}"
                f" within {duration:.3g} s, at most {allowed:.3g} rad is allowed (singularity"
                " near?); nothing was sent"
            )

    def stop(self) -> None:
        """Decelerate and hold, now; returns at once, never raises, may be called at any time.

        If the streaming client is dead or does not answer within 0.25 s, the robot's program is
        ended through the dashboard.
        """
        with contextlib.suppress(Exception):
            if self._child is not None and self._control:
                self._child.ask_stop()

    def recover(self) -> None:
        """Restart the client from the present pose after a stop or a fault; forgets all targets.

        Ends the robot's program first, so that nothing can continue the old motion.

        Raises:
            SafetyStop: when a stop has to be released by a person.
            DeviceError: when the robot cannot be reached or is not ready.
        """
        control = self._control
        if self._child is not None:
            self._child.kill()
            self._child = None
        if control:
            stop_program(self.settings.address)
            if self.settings.unlock_protective_stop:
                self._unlock()
        self.connect(control=control)

    def _unlock(self) -> None:
        address = self.settings.address
        try:
            with Dashboard(address) as dashboard:
                safety = dashboard.ask("safetystatus").upper()
            if "PROTECTIVE_STOP" not in safety:
                return
            reply = unlock_protective_stop(address, self.settings.unlock_timeout)
        except OSError:
            return  # connect says what is wrong
        if "releasing" not in reply.lower():
            raise SafetyStop(
                f"{self.name} arm: the protective stop was not released: {reply}",
                limit="robot safety",
            )
        deadline = time.monotonic() + 2.0
        with contextlib.suppress(OSError), Dashboard(address) as dashboard:
            while time.monotonic() < deadline:
                if "PROTECTIVE_STOP" not in dashboard.ask("safetystatus").upper():
                    return
                time.sleep(0.05)

    def close(self) -> None:
        """Stop the arm, end its program and the client process; may be called twice."""
        child, self._child = self._child, None
        if child is not None:
            child.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def setpoint(self) -> Array | None:
        """The TCP pose (4, 4) sent last, in the base frame; None while nothing is streamed."""
        numbers = self._connected().status().setpoint
        if not numbers:
            return None
        if len(numbers) == 6:
            return tcp_poses(numbers, self.settings.T_flange_tcp)
        return pose_matrix(numbers)

    def _connected(self) -> StreamingProcess:
        if self._child is None:
            raise DeviceError(f"{self.name} arm is not connected; call connect() first")
        return self._child

    def _controllable(self) -> StreamingProcess:
        child = self._connected()
        if not self._control:
            raise DeviceError(
                f"{self.name} arm only listens; connect(control=True) before it can move"
            )
        trouble = child.trouble()
        if trouble:
            if child.status().is_safety:
                raise SafetyStop(trouble, limit="robot safety")
            raise DeviceError(trouble)
        return child


def _arm_readings(raws: list[RawReading]) -> list[ArmReading]:
    if not raws:
        return []
    poses = pose_vector_matrices([raw.tcp_pose for raw in raws])
    return [
        ArmReading(
            stamp=raw.stamp,
            robot_time=raw.robot_time,
            joint_angles=np.array(raw.joint_angles),
            joint_velocities=np.array(raw.joint_velocities),
            T_base_tcp=T_base_tcp,
            tcp_speed=np.array(raw.tcp_speed),
            wrench=np.array(raw.wrench),
            safety=safety_name(raw.safety_bits),
            running=raw.running,
        )
        for raw, T_base_tcp in zip(raws, poses, strict=True)
    ]
