"""ur_rtde behind the few calls the child process makes; only that process may import it.

ur_rtde 1.6.5 can crash or hang its process: a dropped or silent link segfaults the control
interface, a controller that never streams hangs the constructors with Python's lock held, commands
block until an answer that may never come. So nothing here is trusted to return; who calls arms a
timer that the kernel enforces.
"""

import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Any

from sim2real.ur5e.robot_clock import RobotClock
from sim2real.ur5e.setpoint import Vector, to_pose_vector
from sim2real.ur5e.shared_state import RawReading

_VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "runtime_state",
    "safety_status_bits",
]
_PLAYING = 2  # runtime_state
_UPLOAD_SCRIPT = 0x01  # FLAG_UPLOAD_SCRIPT


class RtdeClient:
    """One robot, connected to listen or to control.

    Args:
        settings: the child's settings, see ``process``.
        tell_phase: called with the name of each step before it is tried.

    Raises:
        RuntimeError: whatever ur_rtde raises when it cannot connect.
    """

    def __init__(self, settings: dict[str, Any], tell_phase: Callable[[str], None]) -> None:
        from rtde_receive import RTDEReceiveInterface

        self._settings = settings
        self._clock = RobotClock()
        self._robot_time = -inf
        self._control: Any = None
        tell_phase("receive")
        self._receive = RTDEReceiveInterface(
            settings["address"], settings["reading_hz"], _VARIABLES
        )
        if settings["control"]:
            self._connect_for_control(tell_phase)

    def _connect_for_control(self, tell_phase: Callable[[str], None]) -> None:
        from rtde_control import RTDEControlInterface

        settings = self._settings
        tell_phase("control")
        self._control = RTDEControlInterface(
            settings["address"], settings["reading_hz"], _UPLOAD_SCRIPT
        )
        tell_phase("tool")
        accepted = (
            self._control.setTcp(settings["tcp"])
            and self._control.setPayload(settings["payload_mass"], settings["payload_centre"])
            and self._control.setWatchdog(settings["watchdog_hz"])
        )
        if not accepted:
            raise RuntimeError("the robot's program refused tool, payload or watchdog")
        # The TCP pose is the new tool's from the next cycles on.
        time.sleep(0.02)

    @property
    def is_connected(self) -> bool:
        """Whether the sockets are open, as far as ur_rtde noticed."""
        return self._receive.isConnected() and (
            self._control is None or self._control.isConnected()
        )

    def read(self) -> RawReading | None:
        """What the robot reported since the last call; None when nothing new came."""
        receive = self._receive
        robot_time = receive.getTimestamp()
        if robot_time == self._robot_time:
            return None
        while True:
            reading = RawReading(
                stamp=0.0,
                arrival=time.monotonic(),
                robot_time=robot_time,
                joint_angles=tuple(receive.getActualQ()),
                joint_velocities=tuple(receive.getActualQd()),
                tcp_pose=tuple(receive.getActualTCPPose()),
                tcp_speed=tuple(receive.getActualTCPSpeed()),
                wrench=tuple(receive.getActualTCPForce()),
                safety_bits=receive.getSafetyStatusBits(),
                running=receive.getRuntimeState() == _PLAYING,
            )
            # Another package may have come in between; then the values are of two moments.
            robot_time = receive.getTimestamp()
            if robot_time == reading.robot_time:
                break
        self._robot_time = reading.robot_time
        return reading._replace(stamp=self._clock.stamp(reading.robot_time, reading.arrival))

    def servo(self, setpoint: Vector) -> bool:
        """Stream one setpoint: 7 numbers of a TCP pose or 6 joint angles [rad]."""
        settings = self._settings
        period, lookahead, gain = settings["period"], settings["lookahead_time"], settings["gain"]
        if len(setpoint) == 6:
            return self._control.servoJ(list(setpoint), 0.0, 0.0, period, lookahead, gain)
        vector = list(to_pose_vector(setpoint))
        return self._control.servoL(vector, 0.0, 0.0, period, lookahead, gain)

    def start_move(self, joint_angles: Sequence[float], speed: float, acceleration: float) -> bool:
        """Begin a moveJ [rad], [rad/s], [rad/s^2] and return at once."""
        return self._control.moveJ(list(joint_angles), speed, acceleration, True)

    def keep_alive(self) -> None:
        """Tell the controller's watchdog that its client lives."""
        self._control.kickWatchdog()

    def stop_servo(self) -> None:
        """Leave servo mode and decelerate; returns when the arm stands."""
        self._control.servoStop(self._settings["stop_deceleration"])

    def stop_move(self) -> None:
        """End a moveJ and decelerate; returns when the arm stands."""
        self._control.stopJ(self._settings["joint_stop_deceleration"])

    def stop_script(self) -> None:
        """End the robot's program."""
        self._control.stopScript()
