"""A cell at work: two arms and cameras as one device, in world coordinates."""

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple, Self

import numpy as np

from control.monitor import ArmReading, SafetyMonitor
from control.safety import SafetyLimits, Violation
from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import View
from dlo_gym.geometry.se3 import Array, inverse
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import SIDES, T_CLAMP_TCP
from dlo_gym.scene.ur5e import link_frames
from sim2real.arm import Arm, SimulatedArm
from sim2real.cameras.camera import Camera, CameraSettings
from sim2real.cameras.drivers import make_camera
from sim2real.cameras.synchronisation import synchronised
from sim2real.config import CellConfig
from sim2real.pose_history import interpolate_poses
from sim2real.ur5e.handle import UR5eArm
from sim2real.ur5e.settings import UR5eSettings

WATCH = 0.04  # between two looks at the arms while waiting [s]
POLL = 0.01  # between two looks for new images [s]
SPACING = 0.8  # of a control period: two commands are at least this far apart
HISTORY = 0.05  # before an image from which arm poses are looked up [s]


class CellSample(NamedTuple):
    """Images taken together, and the clamps at that time.

    Attributes:
        views: one per camera; their stamps are monotonic [s].
        stamp: mean of the views' stamps, monotonic [s].
        boundary: the clamps at ``stamp``, as measured.
    """

    views: tuple[View, ...]
    stamp: float
    boundary: BoundaryPoses


class RobotCell:
    """Two arms that hold a cable in front of fixed cameras.

    A context manager. Leaving it, also through an exception, stops both arms before anything else.

    Args:
        config: of the cell.
        limits: that the monitor watches; the cell file's when omitted.
        arms, cameras: devices by name in place of those the cell file describes.
    """

    def __init__(
        self,
        config: CellConfig,
        *,
        limits: SafetyLimits | None = None,
        arms: Mapping[str, Arm] | None = None,
        cameras: Mapping[str, Camera] | None = None,
    ) -> None:
        self.config = config
        self.monitor = SafetyMonitor(limits or config.safety_limits, config.dual_arm)
        self.arms = dict(arms) if arms else {side: make_arm(config, side) for side in SIDES}
        self.cameras = dict(cameras) if cameras else make_cameras(config)
        self.under_control = False
        self._commanded: BoundaryPoses | None = None
        self._sent = -np.inf
        self._last_stamp = -np.inf
        self._image_stamps: dict[str, float] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Connects cameras and arms to look and listen: no program is started, nothing can move.

        Raises:
            DeviceError: naming the device and the cause; what was open is closed again.
        """
        try:
            for camera in self.cameras.values():
                camera.open()
                self._stack.callback(camera.close)
            self._connect(control=False)
        except BaseException:
            self.close()
            raise

    def engage(self) -> None:
        """Takes control of both arms, which stay where they are; after all that takes long.

        Raises:
            DeviceError: naming the arm and the cause.
            SafetyStop: if an arm is in a stop that a person must release.
        """
        self.under_control = True
        self._connect(control=True)

    def _connect(self, *, control: bool) -> None:
        for arm in self.arms.values():
            self._stack.callback(arm.close)
            arm.connect(control=control)
        self._start_anew()
        self.monitor.tare(self.readings())

    def _start_anew(self) -> None:
        """Forgets commands, images and motions of before."""
        self._commanded = None
        self._image_stamps = {}
        self.monitor.reset()

    def close(self) -> None:
        """Stops both arms and gives everything back; closing twice does no harm."""
        if self.under_control:
            self.halt()
        self._stack.close()
        self.under_control = False

    def readings(self) -> dict[str, ArmReading]:
        """The newest of each arm.

        Raises:
            DeviceError: if an arm is gone or silent.
        """
        return {side: self.arms[side].reading() for side in SIDES}

    @property
    def joint_angles(self) -> Array:
        """(2, 6) newest of both arms [rad]."""
        return np.stack([reading.joint_angles for reading in self.readings().values()])

    @property
    def boundary(self) -> BoundaryPoses:
        """The clamps where they are now, as measured."""
        poses = [self._tcp(side, [reading]) for side, reading in self.readings().items()]
        return self._clamps(np.concatenate(poses))

    @property
    def commanded(self) -> BoundaryPoses:
        """The clamps where the last command sends them; where they are if there is none."""
        return self.boundary if self._commanded is None else self._commanded

    def sample(self) -> CellSample | None:
        """The newest images of all cameras, newer than the last ones; None while there are none.

        Raises:
            DeviceError: if a camera or an arm has gone silent.
        """
        tolerance = 0.6 / min(camera.rate_hz or 30.0 for camera in self.config.cameras.values())
        frames = synchronised(list(self.cameras.values()), self._last_stamp, tolerance)
        if frames is None:
            return None
        stamps = [frame.stamp for frame in frames]
        stamp = float(np.mean(stamps))
        try:
            boundary = self.boundary_at(stamp)
        except ValueError:
            return None  # the arms' poses for these images are not there yet
        self._last_stamp = min(stamps)
        self._image_stamps = dict(zip(self.cameras, stamps, strict=True))
        views = tuple(
            View(frame.image, camera.model, frame.stamp)
            for frame, camera in zip(frames, self.cameras.values(), strict=True)
        )
        return CellSample(views, stamp, boundary)

    def wait_for_sample(self, timeout: float = 3.0, *, watching: bool = True) -> CellSample:
        """The next sample; the arms are watched meanwhile.

        Raises:
            DeviceError: if none comes in time.
            SafetyStop: from ``watch``.
        """
        start = looked = time.monotonic()
        while (sample := self.sample()) is None:
            if time.monotonic() > start + timeout:
                raise DeviceError(
                    f"no images of {', '.join(self.cameras)} that were taken together, with poses"
                    f" of both arms at that time, came within {timeout:g} s: {self._newest_ages()};"
                    " are the cameras' clocks and latencies right?"
                )
            if watching and time.monotonic() > looked + WATCH:
                self.watch()
                looked = time.monotonic()
            time.sleep(POLL)
        return sample

    def _newest_ages(self) -> str:
        """How old the newest image of each camera and the newest pose of each arm are, in words."""
        now = time.monotonic()
        newest = {name: camera.latest().stamp for name, camera in self.cameras.items()}
        newest |= {f"{side} arm": reading.stamp for side, reading in self.readings().items()}
        return ", ".join(f"{name} {now - stamp:.3f} s old" for name, stamp in newest.items())

    def refresh(self) -> CellSample:
        """New images while the arms stand, after a pause that has made the last ones old.

        Raises:
            DeviceError: if none comes in time.
        """
        self.sample()  # what lies in the cameras' buffers is old too
        return self.wait_for_sample(watching=False)

    def boundary_at(self, stamp: float) -> BoundaryPoses:
        """The clamps at a recent time, between the arms' readings.

        Raises:
            ValueError: if no readings around ``stamp`` are known.
        """
        poses = []
        for side in SIDES:
            history = self.arms[side].readings(stamp - HISTORY)
            if len(history) < 2:
                raise ValueError(f"{side} arm: no readings around {stamp:.3f} s are known")
            stamps = [reading.stamp for reading in history]
            poses.append(interpolate_poses(stamps, self._tcp(side, history), stamp))
        return self._clamps(np.stack(poses))

    def watch(self) -> None:
        """Looks at everything a limit is set for.

        Raises:
            SafetyStop: naming the limit, the value and the bound.
            DeviceError: if an arm is gone.
        """
        self.monitor.check(
            time.monotonic(),
            self.readings(),
            self._newest_images(),
            controlling=self.under_control,
        )
        if self._commanded is not None:
            self._check_following(self._commanded)

    def _newest_images(self) -> dict[str, float]:
        """Stamps of the cameras' newest images; a camera is asked when its last used one ages."""
        recent = time.monotonic() - 0.5 * self.monitor.limits.max_image_age
        return {
            name: stamp if stamp > recent else self.cameras[name].latest().stamp
            for name, stamp in self._image_stamps.items()
        }

    def _check_following(self, commanded: BoundaryPoses) -> None:
        """Raises SafetyStop if an arm is not near where it was sent."""
        limits = self.monitor.limits
        away = self.boundary.displacement_to(commanded).vector.reshape(2, 2, 3)
        for side, distances in zip(SIDES, np.linalg.norm(away, axis=2), strict=True):
            for name, value, bound, unit in (
                ("deviation", distances[0], limits.max_deviation, "m"),
                ("rotation deviation", distances[1], limits.max_rotation_deviation, "rad"),
            ):
                if value > bound:
                    what = f"{side} gripper from where it was sent"
                    raise Violation(name, what, float(value), bound, unit).stop()

    def wait_until(self, deadline: float) -> None:
        """Sleeps until ``deadline``, monotonic [s], watching the arms all the while."""
        while True:
            self.watch()
            left = deadline - time.monotonic()
            if left <= 0.0:
                return
            time.sleep(min(left, WATCH))

    def send(self, target: BoundaryPoses, duration: float) -> BoundaryPoses:
        """Streams both arms to ``target`` within ``duration`` [s]; returns what they accepted.

        The safety gate counts a whole control period for every step that it allows. So a command
        that comes early, after one that was late, is held back until its time.

        Raises:
            DeviceError: if an arm is gone or refuses; both have been told to stop then.
            SafetyStop: if an arm is in a protective or emergency stop; likewise.
            UnreachablePose: if an arm cannot reach it; likewise.
        """
        assert target.right is not None
        earliest = self._sent + SPACING * self.config.control.period_s
        if time.monotonic() < earliest:
            self.wait_until(earliest)
        self._sent = time.monotonic()
        accepted = []
        try:
            for index, clamp in enumerate((target.left, target.right)):
                T_base_tcp = inverse(self._bases[index]) @ clamp @ T_CLAMP_TCP[index]
                accepted.append(self.arms[SIDES[index]].servo_to(T_base_tcp, duration))
        except BaseException:
            self.halt()
            raise
        self._commanded = self._clamps(np.stack(accepted))
        return self._commanded

    def halt(self) -> None:
        """Stops both arms now and forgets where they were sent; never raises."""
        for arm in self.arms.values():
            arm.stop()
        self._commanded = None

    def recover(self) -> None:
        """Makes both arms ready again where they are now; no former target is taken up.

        Raises:
            DeviceError: if an arm cannot be reached.
            SafetyStop: if it is still in a stop that a person must release.
        """
        for arm in self.arms.values():
            arm.recover()
        self._start_anew()

    def _tcp(self, side: str, readings: Sequence[ArmReading]) -> Array:
        """TCP poses (n, 4, 4) in the arm's base frame."""
        if self.under_control:
            return np.stack([reading.T_base_tcp for reading in readings])
        # While only listening, another tool may be set on the controller than in the cell file.
        flange = link_frames(np.stack([reading.joint_angles for reading in readings]))[:, 6]
        return flange @ self.config.dual_arm.T_flange_tcp[SIDES.index(side)]

    @property
    def _bases(self) -> Array:
        return self.config.dual_arm.T_world_base

    def _clamps(self, T_base_tcp: Array) -> BoundaryPoses:
        """Of both arms' TCP poses (2, 4, 4)."""
        return BoundaryPoses(*(self._bases @ T_base_tcp @ inverse(T_CLAMP_TCP)))


def make_arm(config: CellConfig, side: str) -> Arm:
    """The arm that the cell file describes, not yet connected."""
    arm, servo, limits = config.arms[side], config.servo, config.limits  # type: ignore[index]
    if arm.driver == "simulated":
        return SimulatedArm(side, arm.home_rad, T_flange_tcp=arm.T_flange_tcp)
    settings = UR5eSettings(
        arm.address,
        frequency_hz=servo.frequency_hz,
        servo=servo.mode,
        lookahead_time=servo.lookahead_s,
        gain=servo.gain,
        T_flange_tcp=arm.T_flange_tcp,
        payload_mass=arm.payload_kg,
        payload_centre_of_mass=arm.payload_centre_m,
        stale_after=limits.max_pose_age_s,
        unlock_protective_stop=arm.unlock_protective_stop,
        max_speed=limits.max_speed_m_s,
        max_rotation_speed=limits.max_rotation_speed_rad_s,
        max_joint_speed=limits.max_joint_speed_rad_s,
        max_step=limits.max_deviation_m,
        max_rotation_step=limits.max_rotation_deviation_rad,
    )
    return UR5eArm(side, settings)


def make_cameras(config: CellConfig) -> dict[str, Camera]:
    """The cameras that the cell file describes, not yet open."""
    return {
        name: make_camera(
            CameraSettings(
                camera.driver,
                camera.device,
                latency=camera.latency_s,
                rate_hz=camera.rate_hz,
                stamps=camera.stamps,
                timeout=camera.timeout_s,
            ),
            camera.model(name),
        )
        for name, camera in config.cameras.items()
    }
