"""What ``dlo robot check`` looks at: one function per part of a cell, one row per finding."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError, DloError, MissingExtra
from dlo_gym.geometry.se3 import Array, inverse
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.scene.arms import SIDES
from dlo_gym.scene.ur5e import JOINT_LIMIT
from sim2real.calibration.cell_file import changed_since_calibration
from sim2real.cameras.camera import Camera, Frame
from sim2real.cell import CellSample
from sim2real.config import CellConfig
from sim2real.goals import SAMPLED, make_goal
from sim2real.gripper import RobotiqGripper
from sim2real.loop import TrackedCable
from sim2real.ur5e.dashboard import ask
from sim2real.ur5e.kinematics import tcp_poses

Verdict = Literal["ok", "warning", "failed"]

DASHBOARD_QUESTIONS = (
    "get robot model", "is in remote control", "robotmode", "safetystatus", "PolyscopeVersion",
)  # fmt: skip
TOOL_TOLERANCE = (0.005, 0.02)  # of the TCP: an arm's own calibration; another tool [m], [rad]
JOINT_MARGIN = 0.2  # to the joint limits [rad]
SLOW = 0.8  # of the rate that was asked for
SEEN = 0.5  # share of the cable's nodes that each camera should see
UNLIKE = 0.1  # of the cable's length, between tracked and expected shape


class Row(NamedTuple):
    """One finding.

    Attributes:
        check: what was looked at.
        verdict: "warning" does not keep a cell from running.
        found: what was found.
        advice: what to do about it; empty if nothing.
    """

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


def _row(check: str, good: bool, found: str, advice: str, *, otherwise: Verdict = "failed") -> Row:
    return Row(check, "ok", found) if good else Row(check, otherwise, found, advice)


def check_dashboard(side: str, address: str) -> Iterator[Row]:
    """What a UR controller says of itself."""
    arm = f"{side} arm"
    try:
        model, remote, mode, safety, version = ask(address, DASHBOARD_QUESTIONS, timeout=1.0)
    except OSError as error:
        yield Row(
            f"{arm}: dashboard",
            "failed",
            f"no answer from {address}: {error}",
            "switch the controller on; check address, cable and that its dashboard server is on",
        )
        return
    yield Row(f"{arm}: dashboard", "ok", f"answers at {address}")
    yield _row(f"{arm}: model", "UR5" in model, model, "this package knows the UR5e alone")
    yield _row(
        f"{arm}: remote control",
        remote.lower() == "true",
        remote,
        "switch the pendant to remote control",
        otherwise="failed" if remote.lower() == "false" else "warning",
    )
    power, state = mode.rpartition(":")[2].strip(), safety.rpartition(":")[2].strip()
    yield _row(f"{arm}: power", power == "RUNNING", power, "power it on and release the brakes")
    yield _row(
        f"{arm}: safety",
        state in ("NORMAL", "REDUCED"),
        state,
        "find the cause, release the stop on the pendant",
    )
    yield _row(
        f"{arm}: PolyScope",
        version.upper().startswith("URSOFTWARE 5."),
        version,
        "tested with PolyScope 5 alone",
        otherwise="warning",
    )


def check_readings(
    config: CellConfig, side: str, readings: Sequence[ArmReading], seconds: float
) -> Iterator[Row]:
    """What an arm told within ``seconds``."""
    arm, section, limits = f"{side} arm", config.arms[side], config.limits  # type: ignore[index]
    if len(readings) < 2:
        yield Row(
            f"{arm}: readings",
            "failed",
            f"{len(readings)} in {seconds:g} s",
            "is the RTDE interface on and the network free?",
        )
        return
    newest = readings[-1]
    stamps = np.array([reading.stamp for reading in readings])
    rate, gap = (len(stamps) - 1) / (stamps[-1] - stamps[0]), float(np.diff(stamps).max())
    expected = config.servo.frequency_hz if section.driver == "ur5e" else 125.0
    found = f"{rate:.0f} Hz of {expected:.0f}, largest gap {1e3 * gap:.0f} ms"
    wired = "connect the controller by cable to a network of its own, leave the computer idle"
    if gap > limits.max_pose_age_s:
        advice = f"a gap may last {1e3 * limits.max_pose_age_s:.0f} ms; {wired}"
        yield Row(f"{arm}: readings", "failed", found, advice)
    else:
        slow = rate < SLOW * expected
        yield _row(f"{arm}: readings", not slow, found, wired, otherwise="warning")
    yield _tool(arm, newest, section.T_flange_tcp)
    joint = int(np.argmax(np.abs(newest.joint_angles)))
    yield _row(
        f"{arm}: joint angles",
        abs(newest.joint_angles[joint]) < JOINT_LIMIT - JOINT_MARGIN,
        f"at most {np.degrees(abs(newest.joint_angles[joint])):.0f} deg (joint {joint + 1})",
        f"turn joint {joint + 1} back by a whole turn",
    )
    force, torque = np.linalg.norm(newest.wrench.reshape(2, 3), axis=1)
    yield _row(
        f"{arm}: wrench",
        bool(force <= limits.max_force_n and torque <= limits.max_torque_nm),
        f"{force:.1f} N of {limits.max_force_n:g}, {torque:.2f} N m of {limits.max_torque_nm:g}",
        "set the payload, let the cable hang loose, zero the force sensor on the pendant",
    )


def _tool(arm: str, reading: ArmReading, T_flange_tcp: Array) -> Row:
    """The tool set on the controller against the cell file's."""
    T_flange = tcp_poses(reading.joint_angles, np.eye(4))
    ours = T_flange @ T_flange_tcp
    away = float(np.linalg.norm(ours[:3, 3] - reading.T_base_tcp[:3, 3]))
    turn = ours[:3, :3].T @ reading.T_base_tcp[:3, :3]
    angle = float(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    told = (inverse(T_flange) @ reading.T_base_tcp)[:3, 3]
    found = f"{np.round(1e3 * told, 1).tolist()} mm on the controller, {1e3 * away:.1f} mm away"
    return _row(
        f"{arm}: TCP",
        away <= TOOL_TOLERANCE[0] and angle <= TOOL_TOLERANCE[1],
        found,
        "a run sets the cell file's; measure which is right, set it in both places",
        otherwise="warning",
    )


def check_gripper(config: CellConfig, side: str) -> Iterator[Row]:
    """A gripper's answers; the fingers stay as they are."""
    section = config.arms[side]  # type: ignore[index]
    if section.gripper == "none":
        return
    name = f"{side} gripper"
    try:
        with RobotiqGripper(section.address, section.gripper_port, name=side) as gripper:
            opening, holds = gripper.position(), gripper.holds_object()
    except DeviceError as error:
        yield Row(name, "failed", str(error), "is its URCap installed, the gripper powered?")
        return
    yield _row(
        name,
        holds,
        f"open by {100 * opening:.0f} %, holds {'something' if holds else 'nothing'}",
        "close it on the cable",
        otherwise="warning",
    )


def check_clamps(config: CellConfig, joint_angles: Array) -> Iterator[Row]:
    """Where both grippers are, by joint angles (2, 6) [rad], against the limits."""
    limits = config.safety_limits
    boundary = config.dual_arm.forward_kinematics(joint_angles)
    low, high = np.asarray(limits.workspace)
    for side, clamp in zip(SIDES, (boundary.left, boundary.right), strict=True):
        assert clamp is not None
        point = clamp[:3, 3]
        behind = [
            index
            for index, (at, normal) in enumerate(limits.planes)
            if (point - np.asarray(at)) @ np.asarray(normal) < 0.0
        ]
        inside = bool((point >= low).all() and (point <= high).all())
        where = f"at {np.round(point, 3).tolist()} m"
        yield _row(
            f"{side} clamp: workspace",
            inside and not behind,
            where + (f", behind plane {behind}" if behind else ""),
            f"bring it by hand into limits.workspace_m {low.tolist()} to {high.tolist()}",
        )
    distance = boundary.distance
    yield _row(
        "gripper distance",
        limits.min_gripper_distance <= distance <= limits.max_gripper_distance,
        f"{distance:.3f} m for a cable of {limits.rod_length:g} m",
        f"bring them to {limits.min_gripper_distance:g} to {limits.max_gripper_distance:.3f} m;"
        " are rod.length_m and the bases' poses right?",
    )
    clearance = config.dual_arm.clearance(joint_angles).minimum
    yield _row(
        "arm clearance",
        clearance >= limits.min_arm_clearance,
        f"{1e3 * clearance:.0f} mm, at least {1e3 * limits.min_arm_clearance:.0f}",
        "move the arms apart by hand",
    )


def check_goal(config: CellConfig, boundary: BoundaryPoses) -> Iterator[Row]:
    """Whether a goal can be sampled from where the arms are."""
    try:
        make_goal(SAMPLED, config, boundary)
    except (ValueError, DloError) as error:
        advice = "bring the grippers to the middle of the workspace, as the home pose has them"
        yield Row("goal reach", "failed", str(error), advice)
    else:
        yield Row("goal reach", "ok", "a sampled goal can be reached from here")


def check_frames(config: CellConfig, name: str, frames: Sequence[Frame]) -> Iterator[Row]:
    """What a camera gave."""
    camera, section = f"camera {name}", config.cameras[name]
    if len(frames) < 2:
        advice = "look at cable, power and bandwidth; is another program using it?"
        yield Row(f"{camera}: images", "failed", f"{len(frames)} images came", advice)
        return
    height, width = frames[-1].image.shape[:2]
    yield _row(
        f"{camera}: size",
        (width, height) == (section.width_px, section.height_px),
        f"{width}x{height}",
        f"the file says {section.width_px}x{section.height_px}: set width_px, height_px and"
        " calibrate again",
    )
    rate = (len(frames) - 1) / max(frames[-1].stamp - frames[0].stamp, 1e-9)
    delay = float(np.median([frame.arrival - frame.stamp for frame in frames]))
    wanted = "" if section.rate_hz is None else f" of {section.rate_hz:g}"
    yield _row(
        f"{camera}: rate",
        section.rate_hz is None or rate >= SLOW * section.rate_hz,
        f"{rate:.1f} Hz{wanted}",
        "shorter exposure, smaller images or another USB port",
        otherwise="warning",
    )
    allowed = config.limits.max_image_age_s - config.control.period_s
    yield _row(
        f"{camera}: delay",
        delay < allowed,
        f"{1e3 * delay:.0f} ms, at most {1e3 * allowed:.0f}",
        "smaller images, a faster link, or a larger limits.max_image_age_s",
    )


def check_sight(config: CellConfig, samples: Sequence[CellSample]) -> Iterator[Row]:
    """Whether every camera sees the cable where the arms say that it is."""
    cable, last = TrackedCable(config), samples[-1]
    rod = CosseratRod(config.rod.properties, config.tracker.n_nodes - 1)
    try:
        expected = rod.settle(last.boundary).positions
        estimates = [cable.follow(one.views, one.boundary, one.stamp) for one in samples[-2:]]
    except (DloError, ValueError) as error:
        yield Row("cable in the images", "failed", str(error), "can any camera see the cable?")
        return
    estimate = estimates[-1]
    for view, visible in zip(last.views, estimate.visible, strict=True):
        camera = view.camera
        framed = float(camera.sees(camera.project(expected)).mean())
        share = float(visible.mean())
        yield _row(
            f"camera {camera.name}: cable",
            share >= SEEN,
            f"sees {100 * share:.0f} % of it, {100 * framed:.0f} % lie in the image",
            "light and focus it, take away what hides it; if the image shows the cable, calibrate",
        )
    away = float(np.linalg.norm(estimate.centerline - expected, axis=1).mean())
    yield _row(
        "cable's shape",
        away <= UNLIKE * config.rod.length_m,
        f"{1e3 * away:.1f} mm from the expected one",
        "calibrate, and check rod.length_m, density and stiffness",
        otherwise="warning",
    )


def check_calibration(config: CellConfig) -> Iterator[Row]:
    """Whether the cameras and bases are calibrated, and by the numbers now in the file."""
    found = config.calibration
    if found is None:
        advice = "run  dlo robot calibrate"
        yield Row("calibration", "warning", "the cell file tells of none", advice)
        return
    changed = changed_since_calibration(config)
    yield _row(
        "calibration",
        not changed,
        f"{found.date}, {found.residual_px:.2f} px, {found.residual_mm:.1f} mm, {found.verdict}"
        + ("; numbers were changed since" if changed else ""),
        "calibrate again, or run  dlo robot verify-calibration",
    )


def open_camera(name: str, camera: Camera) -> Row:
    """Opens a camera."""
    try:
        camera.open()
    except (DeviceError, MissingExtra) as error:
        advice = "check its device, cable and power in the cell file"
        return Row(f"camera {name}: opens", "failed", str(error), advice)
    return Row(f"camera {name}: opens", "ok", "images come")


def frames_meanwhile(cameras: Mapping[str, Camera], since: float) -> dict[str, list[Frame]]:
    """The buffered frames of each camera with a stamp after ``since`` [s]; none of a silent one."""
    frames: dict[str, list[Frame]] = {}
    for name, camera in cameras.items():
        try:
            frames[name] = camera.frames(since)
        except DeviceError:
            frames[name] = []
    return frames
