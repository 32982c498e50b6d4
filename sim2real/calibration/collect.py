"""Taking calibration samples: the arm goes to a pose and stands still, each camera takes a view."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.se3 import Array, log_so3
from sim2real.arm import Arm
from sim2real.calibration.plan import PlannedPose
from sim2real.calibration.samples import SampleFolder
from sim2real.cameras.camera import Camera, Frame

_POLL = 0.02


class Stillness(NamedTuple):
    """When an arm counts as standing still.

    Attributes:
        seconds: for which it must have been.
        joint_speed: that is none [rad/s].
        drift_m, drift_rad: by which the tool may move meanwhile.
        timeout: after which waiting is given up [s].
    """

    seconds: float = 0.5
    joint_speed: float = 2e-3
    drift_m: float = 5e-5
    drift_rad: float = 1e-4
    timeout: float = 10.0


def collect(
    folder: SampleFolder,
    arm: Arm,
    cameras: Mapping[str, Camera],
    plan: Sequence[PlannedPose],
    *,
    joint_speed: float = 0.3,
    still: Stillness | None = None,
    on_sample: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Visits planned poses and appends a sample at each; those the folder has are left out.

    Args:
        folder: to append to; a collection that was cut off goes on where it ended.
        arm: connected for control; its name is the side.
        cameras: open, by name.
        plan: from ``plan_poses``; must be the same when going on.
        joint_speed: of the moves [rad/s].
        still: when the arm counts as standing still.
        on_sample: called with how many poses are done and how many there are.

    Returns:
        How many samples were added.

    Raises:
        DeviceError: if a device fails, or the arm does not come to rest; the samples so far stay.
    """
    still = Stillness() if still is None else still
    done = visited(folder, arm.name)
    added = 0
    for k, planned in enumerate(plan):
        if k not in done:
            arm.move_to(planned.joint_angles, joint_speed)
            reading = wait_until_still(arm, still)
            _take(folder, arm, cameras, reading, still, planned=k)
            added += 1
        on_sample(k + 1, len(plan))
    return added


def visited(folder: SampleFolder, side: str) -> set[int]:
    """Which stops of one arm's plan the folder has a sample of."""
    return {e["planned"] for e in folder.entries if e["side"] == side and "planned" in e}


def collect_by_hand(
    folder: SampleFolder,
    arm: Arm,
    cameras: Mapping[str, Camera],
    n: int,
    *,
    still: Stillness | None = None,
    apart_m: float = 0.02,
    apart_rad: float = 0.1,
    patience: float = 120.0,
    on_sample: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Takes a sample whenever somebody has moved the arm to a new pose and it has come to rest.

    Moves nothing: the arm is guided by hand (freedrive) or from the pendant.

    Args:
        folder: to append to.
        arm: connected, control is not needed.
        cameras: open, by name.
        n: samples of this arm wanted in the folder.
        still: when the arm counts as standing still; one second when omitted.
        apart_m, apart_rad: by one of which a new pose differs from each former one.
        patience: without a new pose, after which the rest is left [s].
        on_sample: called with how many samples are there and how many are wanted.

    Returns:
        How many samples were added.
    """
    still = Stillness(seconds=1.0) if still is None else still
    poses = [np.array(e["T_base_tcp"]) for e in folder.entries if e["side"] == arm.name]
    added, waiting_since = 0, time.monotonic()
    while len(poses) < n and time.monotonic() - waiting_since < patience:
        try:
            reading = wait_until_still(arm, still._replace(timeout=still.seconds + 1.0))
        except _NotStill:
            continue
        if any(_near(reading.T_base_tcp, former, apart_m, apart_rad) for former in poses):
            time.sleep(_POLL)
            continue
        try:
            _take(folder, arm, cameras, reading, still)
        except _NotStill:
            continue
        poses.append(reading.T_base_tcp)
        added, waiting_since = added + 1, time.monotonic()
        on_sample(len(poses), n)
    return added


class _NotStill(DeviceError):
    """The arm moved on."""


def wait_until_still(arm: Arm, still: Stillness) -> ArmReading:
    """The reading after which the arm has not moved for ``still.seconds``.

    Raises:
        DeviceError: if it does not come to rest in ``still.timeout``, or the link is gone.
    """
    begin = time.monotonic()
    first = arm.reading()
    while True:
        reading = arm.reading()
        moving = np.abs(reading.joint_velocities).max() > still.joint_speed
        if moving or not _near(
            reading.T_base_tcp, first.T_base_tcp, still.drift_m, still.drift_rad
        ):
            first = reading
        elif reading.stamp - first.stamp >= still.seconds:
            return reading
        if time.monotonic() - begin > still.timeout:
            raise _NotStill(f"{arm.name} arm: did not come to rest within {still.timeout:g} s")
        time.sleep(_POLL)


def _take(
    folder: SampleFolder,
    arm: Arm,
    cameras: Mapping[str, Camera],
    reading: ArmReading,
    still: Stillness,
    **details: Any,
) -> None:
    frames = {name: _frame_after(camera, reading.stamp) for name, camera in cameras.items()}
    after = arm.reading()
    if not _near(after.T_base_tcp, reading.T_base_tcp, 2 * still.drift_m, 2 * still.drift_rad):
        raise _NotStill(f"{arm.name} arm: moved while the cameras took their views")
    folder.append(
        arm.name,
        reading.T_base_tcp,
        {name: frame.image for name, frame in frames.items()},
        stamp=reading.stamp,
        joint_angles=reading.joint_angles.tolist(),
        **details,
    )


def _frame_after(camera: Camera, stamp: float, timeout: float = 3.0) -> Frame:
    """The first frame that was taken wholly after ``stamp`` [s], an exposure being a frame long."""
    begin = time.monotonic()
    while time.monotonic() - begin < timeout:
        frames = camera.frames(stamp)
        if len(frames) >= 2:
            return frames[-1]
        camera.latest()  # raises where the stream is dead
        time.sleep(_POLL)
    raise DeviceError(
        f"camera {camera.model.name!r}: no new image within {timeout:g} s of the arm's rest"
    )


def _near(first: Array, second: Array, metres: float, radians: float) -> bool:
    shift = np.linalg.norm(first[:3, 3] - second[:3, 3])
    turn = np.linalg.norm(log_so3(first[:3, :3].T @ second[:3, :3]))
    return bool(shift < metres and turn < radians)
