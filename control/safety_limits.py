"""The limits that commands and measurements are held to, and what it is to break one."""

from dataclasses import dataclass
from math import inf, isfinite, isnan, pi, sqrt

import numpy as np

from dlo_gym.exceptions import SafetyStop
from dlo_gym.geometry.se3 import Array

Point = tuple[float, float, float]

POSITIVE = (
    "max_translation_step", "max_rotation_step", "max_speed", "max_rotation_speed",
    "control_period", "rod_length", "max_deviation", "max_rotation_deviation",
    "max_pose_age", "max_image_age",
)  # fmt: skip
POSITIVE_OR_INFINITE = (
    "max_acceleration", "max_rotation_acceleration", "max_joint_speed", "max_joint_acceleration",
    "max_force", "max_torque", "max_tension",
)  # fmt: skip


@dataclass(frozen=True)
class Violation:
    """One limit that a command or a measurement breaks.

    Attributes:
        limit: its name, e.g. ``"workspace"``.
        what: that breaks it, e.g. ``"left clamp's z"``.
        value: of that, in ``unit``; NaN where the limit has no number.
        bound: of the limit, in ``unit``.
        unit: ``"m"``, ``"N"``...
        at_least: whether ``bound`` is the smallest value allowed, not the largest.
    """

    limit: str
    what: str
    value: float = float("nan")
    bound: float = float("nan")
    unit: str = ""
    at_least: bool = False

    def __str__(self) -> str:
        if isnan(self.bound):
            return f"{self.limit}: {self.what}"
        # As many digits as it takes to tell the value from the bound.
        digits = next(
            (n for n in range(4, 10) if f"{self.value:.{n}g}" != f"{self.bound:.{n}g}"), 10
        )
        side = "at least" if self.at_least else "at most"
        return (
            f"{self.limit}: {self.what} {self.value:.{digits}g} {self.unit},"
            f" {side} {self.bound:.{digits}g} {self.unit}"
        )

    def stop(self, advice: str = "") -> SafetyStop:
        """The exception that says so."""
        text = f"{self}; {advice}" if advice else str(self)
        return SafetyStop(text, limit=self.limit, value=self.value, bound=self.bound)


@dataclass(frozen=True)
class SafetyLimits:
    """What a command may do to each gripper and arm, and what may be measured meanwhile.

    Steps, speeds and accelerations of grippers are Euclidean norms per gripper. The default steps
    are the diagonals of an action box of 10 mm per axis and 4.5 degrees about each of d1 and d2.
    Infinity switches a limit off where it is the default.

    Attributes:
        max_translation_step: of one command [m].
        max_rotation_step: of one command [rad].
        max_speed: of a gripper [m/s]; 0.25 m/s is the reduced speed beside people (ISO 10218-1).
        max_rotation_speed: of a gripper [rad/s].
        max_acceleration: change of a gripper's commanded velocity from one period to the next, per
            period [m/s^2]. Slowing down is never limited, so that a stop always passes.
        max_rotation_acceleration: the same of its angular velocity [rad/s^2].
        control_period: time between two commands [s]; with the speeds it limits the step too.
        rod_length: rest length of the rod [m].
        overstretch_margin: the clamps stay within ``(1 - margin) * rod_length`` of each other [-].
        min_gripper_distance: between the clamps' origins [m].
        workspace: lower and upper corner (3,) of the box the clamps' origins stay in, world [m].
        planes: (point (3,), normal (3,)) of planes, world [m]; the clamps' origins stay on the
            normal's side, as with a robot's own safety planes.
        max_deviation, max_rotation_deviation: of the poses a command starts from, from the last
            command sent [m], [rad]; beyond it the arms are not where they were sent and the gate
            stops.
        max_joint_speed: of every joint [rad/s]; the UR5e's own is pi.
        max_joint_acceleration: of every joint [rad/s^2], as ``max_acceleration``.
        min_arm_clearance: between the arms, to the table and of an arm to itself, between the
            capsules of ``dlo_gym.scene.arms`` [m].
        min_wrist_angle: between the axes of an arm's fourth and sixth joint [rad]. Where they fall
            together the wrist is singular: these joints race, and the robot stops by itself. Nor
            does a step lead through to the other side. 0 for no limit.
        max_force: that the world may exert on a gripper, beyond the tare [N].
        max_torque: the same about the TCP [N m].
        max_tension: of that force along the line between the clamps, in either direction [N]:
            overstretch, felt.
        max_pose_age: since an arm was where its newest reading says [s].
        max_image_age: since a camera's newest image was captured [s].
        measured_tolerance: how far measured speeds and accelerations may exceed the commands'
            bounds, for noise and the servo's overshoot [-].

    Raises:
        ValueError: naming the field.
    """

    max_translation_step: float = 0.01 * sqrt(3.0)
    max_rotation_step: float = 4.5 * pi / 180.0 * sqrt(2.0)
    max_speed: float = 0.25
    max_rotation_speed: float = 1.5
    control_period: float = 0.1
    rod_length: float = 0.5
    overstretch_margin: float = 0.02
    min_gripper_distance: float = 0.05
    workspace: tuple[Point, Point] = ((-0.6, -0.5, 0.05), (0.6, 0.5, 0.9))
    max_deviation: float = 0.05
    max_rotation_deviation: float = 0.4
    planes: tuple[tuple[Point, Point], ...] = ()
    max_acceleration: float = inf
    max_rotation_acceleration: float = inf
    max_joint_speed: float = pi
    max_joint_acceleration: float = inf
    min_arm_clearance: float = 0.01
    min_wrist_angle: float = 0.0
    max_force: float = 50.0
    max_torque: float = 5.0
    max_tension: float = 20.0
    max_pose_age: float = 0.1
    max_image_age: float = 0.5
    measured_tolerance: float = 0.1

    def __post_init__(self) -> None:
        for name in POSITIVE:
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive number, got {value}")
        for name in POSITIVE_OR_INFINITE:
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"{name}: expected a positive number, inf for no limit,"
                    f" got {getattr(self, name)}"
                )
        for name in ("min_arm_clearance", "min_wrist_angle", "measured_tolerance"):
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected zero or a positive number, got {value}")
        if self.max_rotation_step > pi / 2:
            raise ValueError(
                f"max_rotation_step: expected at most pi/2 rad, got {self.max_rotation_step}"
            )
        if not 0.0 <= self.overstretch_margin < 1.0:
            raise ValueError(
                f"overstretch_margin: expected 0 <= margin < 1, got {self.overstretch_margin}"
            )
        if not 0.0 <= self.min_gripper_distance < self.max_gripper_distance:
            raise ValueError(
                "min_gripper_distance: expected between 0 and the largest distance"
                f" {self.max_gripper_distance:.4g} m, got {self.min_gripper_distance}"
            )
        box = np.asarray(self.workspace, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise ValueError(
                f"workspace: expected a lower corner below an upper corner, got {self.workspace}"
            )
        for plane in self.planes:
            numbers = np.asarray(plane, dtype=np.float64)
            if numbers.shape != (2, 3) or not np.isfinite(numbers).all() or not numbers[1].any():
                raise ValueError(
                    f"planes: expected pairs of a point (3,) and a normal (3,) that is not zero,"
                    f" got {plane}"
                )

    @property
    def max_gripper_distance(self) -> float:
        """The largest distance between the clamps' origins [m]."""
        return (1.0 - self.overstretch_margin) * self.rod_length

    @property
    def translation_step(self) -> float:
        """The largest translation in one period, by step and by speed [m]."""
        return min(self.max_translation_step, self.max_speed * self.control_period)

    @property
    def rotation_step(self) -> float:
        """The largest rotation in one period, by step and by speed [rad]."""
        return min(self.max_rotation_step, self.max_rotation_speed * self.control_period)

    @property
    def plane_points(self) -> Array:
        """(n_planes, 3) a point of each plane [m]."""
        return np.array([point for point, _ in self.planes], dtype=np.float64).reshape(-1, 3)

    @property
    def plane_normals(self) -> Array:
        """(n_planes, 3) unit normals, towards the side where the clamps stay."""
        normals = np.array([normal for _, normal in self.planes], dtype=np.float64).reshape(-1, 3)
        # Divided by the largest component first: the norm of a tiny or huge normal is no number.
        normals = normals / np.abs(normals).max(axis=1, keepdims=True, initial=1e-320)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)
