"""The emulated controller itself: power, safety, program and arm, advanced tick by tick.

It knows nothing of sockets. The servers write into it between two ticks and send what it holds
after one. Numbers and names of modes are those of Universal Robots' RTDE and dashboard guides.
"""

import logging
import math
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from sim2real.emulator import kinematics
from sim2real.emulator.fields import Inputs, OutputImage
from sim2real.emulator.kinematics import Array
from sim2real.emulator.modes import RobotMode, Runtime, Safety
from sim2real.emulator.motion import (
    JOINT_LIMIT,
    TICK,
    Mode,
    Motion,
    MotionFault,
    MotionLimits,
    PausedMotion,
)
from sim2real.emulator.power import Power
from sim2real.emulator.report import Flags, Report

_log = logging.getLogger(__name__)

_HISTORY = 500  # ticks of joint angles kept for get_actual_joint_positions_history


class Program(Protocol):
    """What runs on the controller: one ``step`` per tick while it plays."""

    name: str

    def step(self) -> bool:
        """Does a cycle's work; whether the program goes on."""
        ...


@dataclass
class Watchdog:
    """Stops the program when an input register is not written often enough."""

    register: str
    period: float  # s
    last: float  # monotonic, s


@dataclass(frozen=True)
class ControllerOptions:
    """How the robot is set up.

    Attributes:
        limits: of its motion.
        unlock_delay: a protective stop cannot be unlocked sooner than this [s]; 5 on the robot.
        power_delay: how long power on and brake release take [s] each.
        force_limit: a larger force at the TCP [N] is a protective stop; 150 by factory preset.
        remote: whether the robot is in remote control.
        polyscope: version of the controller's software.
        serial_number: digits, as clients expect.
    """

    limits: MotionLimits = field(default_factory=MotionLimits)
    unlock_delay: float = 5.0
    power_delay: float = 0.3
    force_limit: float = 150.0
    remote: bool = True
    polyscope: tuple[int, int, int, int] = (5, 12, 0, 1101319)
    serial_number: str = "20225500001"


class Controller:
    """One robot.

    Args:
        joint_angles: (6,) at the start [rad].
        tcp: (6,) pose vector of the tool centre point on the flange.
        options: see there.

    Attributes:
        motion: the arm.
        inputs: what clients write.
        power: of the arm.
        wrench: (6,) that the world exerts at the TCP, base axes [N], [N m].
        popups, log: texts the robot shows and has logged, newest last.
    """

    def __init__(
        self, joint_angles: Array, tcp: Array, options: ControllerOptions | None = None
    ) -> None:
        self.options = options or ControllerOptions()
        self.motion = Motion(joint_angles, kinematics.transform(tcp), self.options.limits)
        self.inputs = Inputs()
        self.power = Power(self.options.power_delay)
        self.tcp = np.array(tcp, dtype=np.float64)
        self.wrench = np.zeros(6)
        self.wrench_zero = np.zeros(6)
        self.payload = 0.0
        self.payload_cog = np.zeros(3)
        self.safety = Safety.NORMAL
        self.runtime = Runtime.STOPPED
        self.remote = self.options.remote
        self.unlock_delay = self.options.unlock_delay
        self.stop_reason = ""
        self.program: Program | None = None
        self.watchdog: Watchdog | None = None
        self.popups: deque[str] = deque(maxlen=20)
        self.log: deque[str] = deque(maxlen=200)
        self.digital_outputs = 0
        self.analog_outputs = [0.0, 0.0]
        self.waypoint = np.zeros(6)  # TCP pose vector of the newest move
        self.ticks = 0
        self._stopped_at = -math.inf
        self._paused: PausedMotion | None = None
        self._history: deque[list[float]] = deque(maxlen=_HISTORY)
        self._report = Report()
        self._report.set_tcp(self.tcp)
        self._write_fields()

    @property
    def image(self) -> OutputImage:
        """What clients receive."""
        return self._report.image

    @property
    def robot_mode(self) -> RobotMode:
        return self.power.mode

    @property
    def robot_time(self) -> float:
        """The controller's clock [s]."""
        return self.ticks * TICK

    def history(self, steps: int) -> list[float]:
        """Joint angles [rad] so many ticks ago, as far back as they are kept."""
        if not self._history:
            return self.motion.q.tolist()
        return self._history[-1 - min(max(steps, 0), len(self._history) - 1)]

    def tick(self) -> None:
        """Advance the robot by 2 ms."""
        self.ticks += 1
        now = time.monotonic()
        self.power.tick(now)
        if self.watchdog is not None:
            self._check_watchdog(self.watchdog, now)
        try:
            playing = self.runtime is Runtime.PLAYING
            if self.program is not None and playing and not self.program.step():
                self.stop_program("the program ended")
            self.motion.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))
        if self._write_fields() > self.options.force_limit**2:
            self.protective_stop("the force at the tool is above its limit")

    # Safety

    def protective_stop(self, reason: str) -> None:
        """Stop the arm and pause the program; nothing while it is stopped already."""
        if self.safety is not Safety.NORMAL or not self.power.running:
            return
        self.note(f"protective stop: {reason}")
        self.stop_reason = reason
        self.safety = Safety.PROTECTIVE_STOP
        self._stopped_at = time.monotonic()
        self._pause()

    def unlock(self) -> bool:
        """Release a protective stop; False if it is too young."""
        if self.safety is not Safety.PROTECTIVE_STOP:
            return True
        if time.monotonic() - self._stopped_at < self.unlock_delay:
            return False
        self.safety, self.stop_reason = Safety.NORMAL, ""
        self.note("protective stop released")
        return True

    def emergency_stop(self) -> None:
        """The button is pressed: program ends, the arm brakes, power goes off."""
        if self.safety is Safety.ROBOT_EMERGENCY_STOP:
            return
        self.note("emergency stop")
        self.stop_reason = "emergency stop"
        self.safety = Safety.ROBOT_EMERGENCY_STOP
        self.stop_program("emergency stop")
        self.power.off()

    def release_emergency_stop(self) -> None:
        """The button is pulled out; power stays off until it is asked for."""
        if self.safety is Safety.ROBOT_EMERGENCY_STOP:
            self.safety, self.stop_reason = Safety.NORMAL, ""
            self.note("emergency stop released")

    # Power

    def power_on(self, *, release_brakes: bool = False) -> bool:
        """Power the arm up, to idle or with free brakes; False in an emergency stop."""
        if self.safety is Safety.ROBOT_EMERGENCY_STOP:
            return False
        self.power.on(time.monotonic(), release_brakes=release_brakes)
        return True

    def power_off(self) -> None:
        """Stop everything and take the arm's power."""
        self.stop_program("power off")
        self.motion.hold()
        self.power.off()

    # Programs

    @property
    def ready(self) -> bool:
        """Whether a program could run."""
        return self.power.running and self.safety is Safety.NORMAL

    def start_program(self, program: Program) -> bool:
        """Run a program instead of the present one; False if the robot cannot."""
        if not self.ready:
            self.note(f"program {program.name} rejected: the robot is not ready")
            return False
        if self.runtime is not Runtime.STOPPED:
            self.stop_program("another program starts")
        self.program = program
        self.runtime = Runtime.PLAYING
        self.note(f"program {program.name} starts")
        return True

    def stop_program(self, reason: str) -> None:
        """End the program; the arm decelerates."""
        if self.program is not None and self.runtime is not Runtime.STOPPED:
            self.note(f"program {self.program.name} stopped: {reason}")
        self.runtime = Runtime.STOPPED
        self.program = self.watchdog = self._paused = None
        self.motion.stop(self.options.limits.stop_deceleration)

    def pause_program(self) -> bool:
        """Pause the program where it is; False if none plays."""
        if self.runtime is not Runtime.PLAYING:
            return False
        self._pause()
        return True

    def resume_program(self) -> bool:
        """Go on with a paused program, and with its old motion; False if there is none."""
        if self.runtime is not Runtime.PAUSED or not self.ready:
            return False
        self.runtime = Runtime.PLAYING
        if self.watchdog is not None:
            self.watchdog.last = time.monotonic()
        if self._paused is not None:
            self.motion.resume(self._paused)
            self._paused = None
        return True

    def _pause(self) -> None:
        paused = self.motion.pause()
        if self.runtime is Runtime.PLAYING:
            self.runtime = Runtime.PAUSED
            self._paused = paused

    def set_watchdog(self, register: str, frequency: float) -> None:
        """Stop the program when ``register`` is written less often than ``frequency`` [Hz].

        0 switches the watchdog off.
        """
        if frequency > 0.0 and math.isfinite(frequency):
            self.watchdog = Watchdog(register, 1.0 / frequency, time.monotonic())
        else:
            self.watchdog = None

    def written(self, names: tuple[str, ...]) -> None:
        """A client has written these input fields."""
        if self.watchdog is not None and self.watchdog.register in names:
            self.watchdog.last = time.monotonic()

    def _check_watchdog(self, watchdog: Watchdog, now: float) -> None:
        if self.runtime is Runtime.PLAYING and now - watchdog.last > watchdog.period:
            self.popups.append(f"RTDE watchdog: {watchdog.register} was not updated")
            self.stop_program("RTDE watchdog")

    # Settings

    def set_tcp(self, tcp: Array) -> None:
        """Set the tool centre point, a pose vector (6,) on the flange."""
        self.tcp = np.array(tcp, dtype=np.float64)
        self.motion.T_flange_tcp = kinematics.transform(self.tcp)
        self._report.set_tcp(self.tcp)

    def set_payload(self, mass: float, cog: Array) -> None:
        """Set the payload [kg] and its centre of gravity (3,) [m] on the flange."""
        self.payload, self.payload_cog = mass, np.array(cog, dtype=np.float64)
        self._report.set_payload(mass, self.payload_cog)

    def set_outputs(self, written: dict[str, tuple[float | int, ...]]) -> None:
        """Apply what a client wrote into fields that are no registers."""
        for position, kind in ((0, "standard"), (8, "configurable"), (16, "tool")):
            if f"{kind}_digital_output" in written:
                mask = int(written.get(f"{kind}_digital_output_mask", (255,))[0]) << position
                value = int(written[f"{kind}_digital_output"][0]) << position
                self.digital_outputs = self.digital_outputs & ~mask | value & mask
        if written.get("speed_slider_mask", (0,))[0]:
            fraction = written.get("speed_slider_fraction", (1.0,))[0]
            if math.isfinite(fraction):
                self.motion.speed_slider = min(max(fraction, 0.0), 1.0)
        mask = int(written.get("standard_analog_output_mask", (0,))[0])
        for i in range(2):
            value = written.get(f"standard_analog_output_{i}", (math.nan,))[0]
            if mask >> i & 1 and math.isfinite(value):
                self.analog_outputs[i] = min(max(value, 0.0), 1.0)

    def zero_force(self) -> None:
        """Take the present wrench for zero."""
        self.wrench_zero = self.wrench.copy()

    def note(self, text: str) -> None:
        """Write a line into the robot's log."""
        self.log.append(f"{self.robot_time:.3f} {text}")
        _log.info("%s", text)

    def within_limits(self, joint_angles: Array | None) -> bool:
        """Whether joint angles (6,) [rad] are possible and inside the joints' range."""
        return joint_angles is not None and bool((np.abs(joint_angles) <= JOINT_LIMIT).all())

    def state(self) -> dict[str, Any]:
        """What the robot is and does, in plain types."""
        names = {Safety.ROBOT_EMERGENCY_STOP: "emergency_stop"}
        return {
            "joints": self.motion.q.tolist(),
            "joint_velocities": self.motion.qd.tolist(),
            "target": self.motion.target.tolist(),
            "motion": self.motion.mode.value,
            "tcp_pose": self._report.tcp_pose.tolist(),
            "tcp_speed": self._report.tcp_speed.tolist(),
            "tcp_offset": self.tcp.tolist(),
            "wrench": self.wrench.tolist(),
            "safety": names.get(self.safety, self.safety.name.lower()),
            "stop_reason": self.stop_reason,
            "mode": self.robot_mode.name.lower(),
            "program": self.runtime is Runtime.PLAYING,
            "runtime": self.runtime.name.lower(),
            "remote_control": self.remote,
            "payload": self.payload,
            "digital_outputs": self.digital_outputs,
            "popups": list(self.popups),
            "log": list(self.log)[-20:],
            "robot_time": self.robot_time,
            "stamp": time.monotonic(),
        }

    def _write_fields(self) -> float:
        """Write what clients receive; returns the squared force at the tool [N^2]."""
        self._history.append(self.motion.q.tolist())
        flags = Flags(
            self.power.mode,
            self.safety,
            self.runtime,
            self.digital_outputs,
            (self.analog_outputs[0], self.analog_outputs[1]),
            self.motion.speed_slider,
        )
        return self._report.write(
            self.robot_time, self.motion, self.wrench, self.wrench_zero, flags
        )

    def teleport(self, joint_angles: Array) -> None:
        """Put the arm elsewhere at once, (6,) [rad].

        Raises:
            ValueError: if it moves, is being servoed, or the angles are out of range.
        """
        if self.motion.mode is not Mode.HOLD:
            raise ValueError(f"the arm is not standing: {self.motion.mode.value}")
        if not self.within_limits(joint_angles):
            raise ValueError(f"joints: expected within +-{JOINT_LIMIT:.4g} rad")
        self.motion.teleport(joint_angles)
        self._write_fields()
