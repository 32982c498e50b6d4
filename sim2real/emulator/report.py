"""What the controller tells its clients every tick: the fields of the output image."""

from typing import NamedTuple

from sim2real.emulator import kinematics
from sim2real.emulator.fields import OutputImage
from sim2real.emulator.kinematics import Array
from sim2real.emulator.modes import (
    JOINT_MODE,
    JOINT_MODE_OFF,
    SAFETY_STATUS_BITS,
    RobotMode,
    Runtime,
    Safety,
)
from sim2real.emulator.motion import Motion

# Fields of floats that change now and then.
_WRITTEN = (
    *("timestamp", "actual_TCP_pose", "actual_TCP_speed", "payload", "payload_cog", "tcp_offset"),
    *("standard_analog_output0", "standard_analog_output1"),
    *("target_speed_fraction", "speed_scaling"),
)


class Flags(NamedTuple):
    """What seldom changes."""

    robot_mode: RobotMode
    safety: Safety
    runtime: Runtime
    digital_outputs: int
    analog_outputs: tuple[float, float]
    speed_slider: float


class Report:
    """The output image and who writes it.

    Attributes:
        image: what clients receive.
    """

    def __init__(self) -> None:
        self.image = OutputImage()
        self._views = {name: self.image.view(name) for name in _WRITTEN}
        self._live = self.image.live()
        self._flags: Flags | None = None
        for name in ("actual_main_voltage", "actual_robot_voltage", "actual_joint_voltage"):
            self.image.view(name)[:] = 48.0
        self.image.view("joint_temperatures")[:] = 28.0
        self.image.view("actual_tool_accelerometer")[2] = 9.81

    @property
    def tcp_pose(self) -> Array:
        """(6,) pose vector, base axes."""
        return self._views["actual_TCP_pose"]

    @property
    def tcp_speed(self) -> Array:
        """(6,) twist, base axes [m/s], [rad/s]."""
        return self._views["actual_TCP_speed"]

    def set_tcp(self, tcp: Array) -> None:
        """Tell another tool centre point, a pose vector (6,) on the flange."""
        self._views["tcp_offset"][:] = tcp

    def set_payload(self, mass: float, cog: Array) -> None:
        """Tell another payload [kg] with its centre of gravity (3,) [m] on the flange."""
        self._views["payload"][0], self._views["payload_cog"][:] = mass, cog

    def write(
        self, robot_time: float, motion: Motion, wrench: Array, wrench_zero: Array, flags: Flags
    ) -> float:
        """Write a tick; returns the squared force at the tool [N^2]."""
        self._views["timestamp"][0] = robot_time
        force_squared = kinematics.report(
            *(motion.q, motion.qd, motion.qdd, motion.T_flange_tcp),
            *(wrench, wrench_zero, self._live),
        )
        if flags != self._flags:
            self._write_flags(flags)
        self.image.renew()
        return force_squared

    def _write_flags(self, flags: Flags) -> None:
        self._flags = flags
        image, views, mode = self.image, self._views, flags.robot_mode
        playing = flags.runtime is Runtime.PLAYING
        views["standard_analog_output0"][0] = flags.analog_outputs[0]
        views["standard_analog_output1"][0] = flags.analog_outputs[1]
        views["target_speed_fraction"][0] = flags.speed_slider
        views["speed_scaling"][0] = flags.speed_slider if playing else 0.0
        image.set_integer("robot_mode", mode)
        image.set_integer("joint_mode", *[JOINT_MODE.get(mode, JOINT_MODE_OFF)] * 6)
        image.set_integer("safety_mode", flags.safety)
        image.set_integer("safety_status", flags.safety)
        image.set_integer("safety_status_bits", SAFETY_STATUS_BITS[flags.safety])
        image.set_integer("runtime_state", flags.runtime)
        powered = mode is not RobotMode.POWER_OFF
        image.set_integer("robot_status_bits", powered | playing << 1)
        image.set_integer("actual_digital_output_bits", flags.digital_outputs)
