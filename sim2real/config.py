"""The cell file: what stands in a real (or emulated) cell and how it may move.

One TOML file, units in the field names. Loading checks everything and names what is wrong;
``update_cell_file`` changes single values and keeps the rest of the file, comments included.
"""

import math
import tomllib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from control.safety import SafetyLimits
from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from dlo_gym.rod.properties import RodProperties
from dlo_gym.scene.arms import SIDES, DualArm

SCHEMA = "dlo-cell/1"
TEMPLATES = Path(__file__).parent / "cells"

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(gt=0, le=1)]
Vector = tuple[float, float, float]
Side = Literal["left", "right"]


class CellFileError(DloError, ValueError):
    """A cell file is missing, is not TOML or holds a wrong value; names file and field."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RodSection(_Section):
    """The cable: what a ruler and a scale tell of it."""

    length_m: Positive
    radius_m: Positive
    youngs_modulus_pa: Positive = 1e6
    density_kg_m3: Positive = 1e3

    @property
    def properties(self) -> RodProperties:
        return RodProperties(
            self.length_m, self.radius_m, self.youngs_modulus_pa, self.density_kg_m3
        )


class ArmSection(_Section):
    """One arm; rotations are rotation vectors as the teach pendant shows them."""

    driver: Literal["ur5e", "simulated"] = "ur5e"
    address: str
    base_position_m: Vector
    base_rotation_rad: Vector
    tcp_position_m: Vector = (0.0, 0.0, 0.163)
    tcp_rotation_rad: Vector = (0.0, 0.0, 0.0)
    home_rad: tuple[float, float, float, float, float, float]
    payload_kg: Annotated[float, Field(ge=0, le=5)] = 0.9
    payload_centre_m: Vector = (0.0, 0.0, 0.06)
    gripper: Literal["robotiq", "none"] = "none"
    gripper_port: Annotated[int, Field(gt=0, lt=65536)] = 63352
    unlock_protective_stop: bool = False

    @property
    def T_world_base(self) -> Array:
        return pose(exp_so3(self.base_rotation_rad), self.base_position_m)

    @property
    def T_flange_tcp(self) -> Array:
        return pose(exp_so3(self.tcp_rotation_rad), self.tcp_position_m)


class CameraSection(_Section):
    """One fixed camera: the device, and the ``CameraModel`` it has."""

    driver: Literal["mjpeg", "opencv", "oak"]
    device: str | int
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    intrinsics_px: tuple[Positive, Positive, float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_m: Vector
    rotation_rad: Vector
    rate_hz: Positive | None = None
    latency_s: Annotated[float, Field(ge=0, lt=1)] = 0.0
    stamps: Literal["auto", "header", "arrival"] = "auto"
    timeout_s: Positive = 1.0

    def model(self, name: str) -> CameraModel:
        fx, fy, cx, cy = self.intrinsics_px
        return CameraModel(
            name,
            self.width_px,
            self.height_px,
            np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            pose(exp_so3(self.rotation_rad), self.position_m),
            np.array(self.distortion),
        )


class PlaneSection(_Section):
    """A safety plane; the grippers stay on the side the normal points to."""

    point_m: Vector
    normal: Vector


class LimitsSection(_Section):
    """What the safety gate and the monitor enforce; see docs/control.md for each."""

    workspace_m: tuple[Vector, Vector] = ((-0.4, -0.25, 0.22), (0.4, 0.25, 0.55))
    planes: tuple[PlaneSection, ...] = ()
    max_translation_step_m: Positive = 0.0174
    max_rotation_step_rad: Positive = 0.112
    max_speed_m_s: Positive = 0.25
    max_rotation_speed_rad_s: Positive = 1.5
    max_acceleration_m_s2: Positive = 4.0
    max_rotation_acceleration_rad_s2: Positive = 20.0
    max_joint_speed_rad_s: Positive = 1.5
    max_joint_acceleration_rad_s2: Positive = 25.0
    min_gripper_distance_m: Positive = 0.05
    max_stretch: Share = 0.975
    min_arm_clearance_m: Annotated[float, Field(ge=0)] = 0.02
    min_wrist_angle_rad: Annotated[float, Field(ge=0)] = 0.1
    max_force_n: Positive = 40.0
    max_torque_nm: Positive = 8.0
    max_tension_n: Positive = 20.0
    max_deviation_m: Positive = 0.05
    max_rotation_deviation_rad: Positive = 0.4
    max_pose_age_s: Positive = 0.1
    max_image_age_s: Positive = 0.5
    # Between two targets the streamed motion may be this much faster than the commands' average.
    measured_tolerance: Annotated[float, Field(ge=0)] = 0.5


class ServoSection(_Section):
    """How targets are streamed to the arms."""

    mode: Literal["servol", "servoj"] = "servol"
    frequency_hz: Annotated[float, Field(ge=100, le=500)] = 500.0
    lookahead_s: Annotated[float, Field(ge=0.03, le=0.2)] = 0.05
    gain: Annotated[float, Field(ge=100, le=2000)] = 500.0
    approach_joint_speed_rad_s: Positive = 0.3


class ControlSection(_Section):
    """Which controller steers, and how often."""

    controller: Literal["mpc", "rl"] = "mpc"
    model: Literal["surrogate", "rod"] = "surrogate"
    policy: str | None = None
    period_s: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    max_translation_step_m: Positive = 0.01
    max_rotation_step_rad: Positive = math.radians(4.5)
    success_threshold_m: Positive = 0.005


class TrackerSection(_Section):
    """How the tracker knows the cable's motion, and when it gives up."""

    predictor: Literal["rod", "network"] = "rod"
    triangulation: Literal["curve", "paper"] = "curve"
    n_nodes: Annotated[int, Field(ge=5, le=401)] = 51
    lost_after_s: Positive = 3.0


class CalibrationSection(_Section):
    """What ``dlo robot calibrate`` measured, and of which numbers."""

    date: str
    hash: str
    residual_px: float
    residual_mm: float
    residual_deg: float
    verdict: str


class CellConfig(_Section):
    """A whole cell.

    Raises:
        CellFileError: from ``load``, with one line per wrong field.
    """

    file_schema: Literal["dlo-cell/1"] = Field(alias="schema")
    name: str
    rod: RodSection
    arms: dict[Side, ArmSection]
    cameras: dict[str, CameraSection]
    limits: LimitsSection = LimitsSection()
    servo: ServoSection = ServoSection()
    control: ControlSection = ControlSection()
    tracker: TrackerSection = TrackerSection()
    calibration: CalibrationSection | None = None
    truth_url: str | None = None

    @model_validator(mode="after")
    def _check_parts(self) -> "CellConfig":
        missing = [side for side in SIDES if side not in self.arms]
        if missing:
            raise ValueError(f"arms: expected left and right, {' and '.join(missing)} missing")
        if not self.cameras:
            raise ValueError("cameras: expected at least one")
        addresses = {arm.address for arm in self.arms.values()}
        if len(addresses) < 2 and all(arm.driver == "ur5e" for arm in self.arms.values()):
            raise ValueError(
                f"arms: expected two addresses, got {', '.join(addresses)} for both; the"
                " controllers' ports are fixed"
            )
        # Each builds an object that checks its own values.
        _ = self.rod.properties, self.dual_arm, self.camera_models, self.safety_limits
        return self

    @classmethod
    def load(cls, path: str | Path) -> "CellConfig":
        """Reads and checks a cell file."""
        return _validated(Path(path), _read(Path(path)))

    @cached_property
    def dual_arm(self) -> DualArm:
        arms = [self.arms[side] for side in SIDES]  # type: ignore[index]
        return DualArm(
            np.stack([arm.T_world_base for arm in arms]),
            np.array([arm.home_rad for arm in arms]),
            np.stack([arm.T_flange_tcp for arm in arms]),
        )

    @cached_property
    def camera_models(self) -> tuple[CameraModel, ...]:
        return tuple(camera.model(name) for name, camera in self.cameras.items())

    @cached_property
    def safety_limits(self) -> SafetyLimits:
        """The limits as the gate and the monitor take them."""
        limits = self.limits
        return SafetyLimits(
            max_translation_step=limits.max_translation_step_m,
            max_rotation_step=limits.max_rotation_step_rad,
            max_speed=limits.max_speed_m_s,
            max_rotation_speed=limits.max_rotation_speed_rad_s,
            control_period=self.control.period_s,
            rod_length=self.rod.length_m,
            overstretch_margin=1.0 - limits.max_stretch,
            min_gripper_distance=limits.min_gripper_distance_m,
            workspace=limits.workspace_m,
            planes=tuple((plane.point_m, plane.normal) for plane in limits.planes),
            max_acceleration=limits.max_acceleration_m_s2,
            max_rotation_acceleration=limits.max_rotation_acceleration_rad_s2,
            max_joint_speed=limits.max_joint_speed_rad_s,
            max_joint_acceleration=limits.max_joint_acceleration_rad_s2,
            min_arm_clearance=limits.min_arm_clearance_m,
            min_wrist_angle=limits.min_wrist_angle_rad,
            max_force=limits.max_force_n,
            max_torque=limits.max_torque_nm,
            max_tension=limits.max_tension_n,
            max_deviation=limits.max_deviation_m,
            max_rotation_deviation=limits.max_rotation_deviation_rad,
            max_pose_age=limits.max_pose_age_s,
            max_image_age=limits.max_image_age_s,
            measured_tolerance=limits.measured_tolerance,
        )


def update_cell_file(path: str | Path, changes: Mapping[str, Any]) -> CellConfig:
    """Changes single values of a cell file, keeping its comments and layout.

    Args:
        path: of the file.
        changes: new values by dotted key, for example ``"cameras.side.position_m"``; sections
            that do not exist are made.

    Raises:
        CellFileError: if the file with the changes would not be valid; it is left as it was.
    """
    path = Path(path)
    document = tomlkit.parse(_text(path))
    for key, value in changes.items():
        *sections, last = key.split(".")
        table: Any = document
        for section in sections:
            if section not in table:
                table[section] = tomlkit.table()
            table = table[section]
        table[last] = value
    config = _validated(path, document.unwrap())
    with written_aside(path, CellFileError) as part:
        part.write_text(tomlkit.dumps(document))
    return config


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CellFileError(
            f"{path}: cannot be read as a cell file: {reason}; `dlo robot init` writes one"
        ) from error


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(_text(path))
    except tomllib.TOMLDecodeError as error:
        raise CellFileError(f"{path}: is not TOML: {error}") from error


def _validated(path: Path, values: dict[str, Any]) -> CellConfig:
    try:
        return CellConfig.model_validate(values)
    except ValidationError as error:
        lines = [
            f"{'.'.join(map(str, one['loc'])) or 'cell'}: {_message(one)}"
            for one in error.errors(include_url=False)
        ]
        raise CellFileError(f"{path}:\n  " + "\n  ".join(lines)) from error


def _message(error: Any) -> str:
    text = error["msg"].removeprefix("Value error, ")
    value = error["input"]
    scalar = isinstance(value, str | int | float | bool | list | tuple)
    return f"{text}, got {value!r}" if scalar and error["type"] != "missing" else text
