"""How one UR5e is reached and driven."""

from dataclasses import dataclass, field
from math import isfinite
from typing import Literal

import numpy as np

from dlo_gym.geometry.se3 import Array, check_single_pose
from dlo_gym.scene.arms import T_FLANGE_TCP
from sim2real.ur5e.setpoint import SetpointLimits

_RANGES = {
    "frequency_hz": (50.0, 500.0),
    "reading_hz": (50.0, 500.0),
    "lookahead_time": (0.03, 0.2),
    "gain": (100.0, 2000.0),
    "payload_mass": (0.0, 5.0),
    "stale_after": (0.01, 1.0),
    "heartbeat_timeout": (0.05, 2.0),
    "connect_timeout": (0.5, 30.0),
    "watchdog_hz": (2.0, 100.0),
    "unlock_timeout": (0.0, 30.0),
    "max_speed": (1e-3, 2.0),
    "max_rotation_speed": (1e-3, 6.0),
    "max_acceleration": (1e-2, 50.0),
    "max_rotation_acceleration": (1e-2, 300.0),
    "max_joint_speed": (1e-3, 3.1416),
    "max_joint_acceleration": (1e-2, 60.0),
    "max_step": (1e-4, 0.5),
    "max_rotation_step": (1e-3, 3.0),
    "stop_deceleration": (0.5, 15.0),
    "joint_stop_deceleration": (0.5, 40.0),
}


@dataclass(frozen=True, eq=False)
class UR5eSettings:
    """Everything ``UR5eArm`` needs to know.

    Attributes:
        address: host name or IP of the controller; its ports are fixed.
        frequency_hz: of setpoints [1/s].
        reading_hz: of readings [1/s]; 500 costs a tenth of a processor core per connection.
        servo: "servol" sends TCP poses and the controller solves the inverse kinematics; "servoj"
            solves it here once per target and moves straight in joint angles in between.
        lookahead_time: by which the controller smooths setpoints, 0.03 to 0.2 [s].
        gain: of the controller's position loop, 100 to 2000 [-].
        T_flange_tcp: (4, 4) tool centre point, set on the controller when connecting for control.
        payload_mass: gripper and rod [kg].
        payload_centre_of_mass: (3,) in the flange frame [m].
        stale_after: without news from the robot for this long, the link counts as broken [s].
        heartbeat_timeout: without a sign of life from the controlling process for this long, the
            arm is stopped [s].
        connect_timeout: for the whole connection [s].
        watchdog_hz: the controller ends the program when it hears from its client less often.
        unlock_protective_stop: whether ``recover`` may release a protective stop by itself.
        unlock_timeout: how long ``recover`` asks for it; a controller refuses for 5 s [s].
        max_speed, max_rotation_speed: of the TCP's setpoints [m/s], [rad/s].
        max_acceleration, max_rotation_acceleration: likewise [m/s^2], [rad/s^2].
        max_joint_speed, max_joint_acceleration: in mode "servoj" [rad/s], [rad/s^2]; the speed is
            also the most that a target may ask of a joint on average in mode "servol".
        max_step, max_rotation_step: a target farther than this from the present setpoint is
            refused [m], [rad].
        stop_deceleration: of the TCP when the arm is stopped while streaming [m/s^2].
        joint_stop_deceleration: when stopped within ``move_to`` [rad/s^2].

    Raises:
        ValueError: naming the field, its range and what came.
    """

    address: str
    frequency_hz: float = 500.0
    reading_hz: float = 125.0
    servo: Literal["servol", "servoj"] = "servol"
    lookahead_time: float = 0.1
    gain: float = 300.0
    T_flange_tcp: Array = field(default_factory=T_FLANGE_TCP.copy)
    payload_mass: float = 0.9
    payload_centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.06)
    stale_after: float = 0.1
    heartbeat_timeout: float = 0.3
    connect_timeout: float = 3.0
    watchdog_hz: float = 10.0
    unlock_protective_stop: bool = False
    unlock_timeout: float = 6.0
    max_speed: float = 0.25
    max_rotation_speed: float = 1.5
    max_acceleration: float = 5.0
    max_rotation_acceleration: float = 30.0
    max_joint_speed: float = 1.5
    max_joint_acceleration: float = 30.0
    max_step: float = 0.05
    max_rotation_step: float = 0.4
    stop_deceleration: float = 5.0
    joint_stop_deceleration: float = 4.0

    def __post_init__(self) -> None:
        if not self.address:
            raise ValueError("address: expected the controller's host name or IP, got nothing")
        if self.servo not in ("servol", "servoj"):
            raise ValueError(f"servo: expected 'servol' or 'servoj', got {self.servo!r}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (isfinite(value) and low <= value <= high):
                raise ValueError(f"{name}: expected {low:g} to {high:g}, got {value}")
        object.__setattr__(
            self, "T_flange_tcp", check_single_pose(self.T_flange_tcp, "T_flange_tcp")
        )
        centre = np.asarray(self.payload_centre_of_mass, dtype=np.float64)
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise ValueError(
                "payload_centre_of_mass: expected 3 finite numbers,"
                f" got {self.payload_centre_of_mass}"
            )
        object.__setattr__(self, "payload_centre_of_mass", tuple(centre.tolist()))

    @property
    def setpoint_limits(self) -> SetpointLimits:
        """Bounds of the interpolation between targets."""
        return SetpointLimits(
            period=1.0 / self.frequency_hz,
            max_speed=self.max_speed,
            max_rotation_speed=self.max_rotation_speed,
            max_acceleration=self.max_acceleration,
            max_rotation_acceleration=self.max_rotation_acceleration,
            max_joint_speed=self.max_joint_speed,
            max_joint_acceleration=self.max_joint_acceleration,
        )
