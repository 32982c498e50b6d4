"""Modes of the robot, with the names and numbers of Universal Robots' RTDE guide."""

from enum import IntEnum


class RobotMode(IntEnum):
    """RTDE robot_mode."""

    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Safety(IntEnum):
    """RTDE safety_mode, of which the emulator has these."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


class Runtime(IntEnum):
    """RTDE runtime_state."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


# Bits: 0 normal, 1 reduced, 2 protective, 4 safeguard, 6 robot emergency, 7 any emergency,
# 10 stopped due to safety.
SAFETY_STATUS_BITS = {
    Safety.NORMAL: 1 << 0,
    Safety.REDUCED: 1 << 1,
    Safety.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    Safety.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
JOINT_MODE = {RobotMode.RUNNING: 253, RobotMode.IDLE: 238}
JOINT_MODE_OFF = 239
