"""A camera, stream or video file that OpenCV opens."""

import re
import time
from pathlib import Path
from typing import Literal

import cv2

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import CameraSettings
from sim2real.cameras.capture import EndOfStreamError, Shot, StreamCamera, plausible_stamp

Kind = Literal["v4l2", "gstreamer", "url", "file"]


class OpenCVCamera(StreamCamera):
    """Anything that ``cv2.VideoCapture`` reads.

    The device is an index or ``/dev/videoN`` (V4L2), a GStreamer pipeline (recognised by its
    ``!``; needs an OpenCV built with GStreamer, which the PyPI wheel is not), a URL such as
    ``rtsp://...``, or a video file. Size and rate are asked of V4L2 devices; the size that comes
    must be the model's. V4L2 drivers stamp each buffer on the monotonic clock; the stamps of
    the others are arrival minus latency.

    Args:
        settings: how the device is reached.
        model: the camera's size, intrinsics and place.
        realtime: of a file: play it at its rate, else as fast as it decodes.
        loop: of a file: begin again at its end, else the camera falls silent there.
        fourcc: pixel format asked of a V4L2 device; USB 2 has no room for large raw images.

    Raises:
        ValueError: if stamps "header" are asked of a device that tells none.
    """

    def __init__(
        self,
        settings: CameraSettings,
        model: CameraModel,
        *,
        realtime: bool = True,
        loop: bool = False,
        fourcc: str = "MJPG",
    ) -> None:
        super().__init__(
            model,
            latency=settings.latency,
            timeout=settings.timeout,
            rate_hz=settings.rate_hz,
        )
        self.device = settings.device
        self.kind = device_kind(settings.device)
        self.realtime = realtime
        self.loop = loop
        self.fourcc = fourcc
        if settings.stamps == "header" and self.kind != "v4l2":
            raise ValueError(
                f'stamps: expected "arrival" or "auto" for {settings.device!r}, which tells no'
                ' capture times, got "header"'
            )
        self._by_driver = self.kind == "v4l2" and settings.stamps != "arrival"

    def _connect(self) -> "_OpenCVSource":
        capture = self._open_capture()
        if not capture.isOpened():
            raise DeviceError(f"OpenCV cannot open {self.device!r} ({self.kind})")
        period = None
        if self.kind == "file" and self.realtime:
            period = 1.0 / (capture.get(cv2.CAP_PROP_FPS) or self.rate_hz or 30.0)
        return _OpenCVSource(
            capture,
            by_driver=self._by_driver,
            period=period,
            file=str(self.device) if self.kind == "file" else "",
            loop=self.loop,
        )

    def _open_capture(self) -> cv2.VideoCapture:
        if self.kind == "v4l2":
            return self._open_v4l2()
        device = str(self.device)
        if self.kind == "gstreamer":
            if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
                raise DeviceError("this OpenCV was built without GStreamer")
            return cv2.VideoCapture(device, cv2.CAP_GSTREAMER)
        if self.kind == "url":
            limit = int(1e3 * self.open_timeout)
            options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
            return cv2.VideoCapture(device, cv2.CAP_FFMPEG, options)
        if not Path(device).is_file():
            raise DeviceError(f"there is no file {device!r}")
        return cv2.VideoCapture(device)

    def _open_v4l2(self) -> cv2.VideoCapture:
        device = self.device
        if isinstance(device, str) and device.isdigit():
            device = int(device)
        path = Path(f"/dev/video{device}" if isinstance(device, int) else device)
        if not path.exists():
            raise DeviceError(f"there is no device {path}")
        options = [cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*self.fourcc)]
        options += [cv2.CAP_PROP_FRAME_WIDTH, self.model.width]
        options += [cv2.CAP_PROP_FRAME_HEIGHT, self.model.height]
        capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        # One by one: `open` fails as a whole on a property that a driver only rounds.
        for name, value in zip(options[::2], options[1::2], strict=True):
            capture.set(name, value)
        if self.rate_hz is not None:
            capture.set(cv2.CAP_PROP_FPS, self.rate_hz)
        return capture


class _OpenCVSource:
    """One open ``cv2.VideoCapture``."""

    def __init__(
        self,
        capture: cv2.VideoCapture,
        *,
        by_driver: bool = False,
        period: float | None = None,
        file: str = "",
        loop: bool = False,
    ) -> None:
        self._capture = capture
        self._by_driver = by_driver
        self._period = period
        self._file = file
        self._loop = loop
        self._due = time.monotonic()

    def read(self) -> Shot:
        if self._period is not None:
            time.sleep(max(self._due - time.monotonic(), 0.0))
            self._due = max(self._due + self._period, time.monotonic() - self._period)
        if not self._grab():
            if self._file:
                raise EndOfStreamError(f"{self._file!r} has been played to its end")
            raise DeviceError("the device gives no more images")
        stamp = self._driver_stamp() if self._by_driver else None
        ok, image = self._capture.retrieve()
        if not ok:
            raise DeviceError("the device gave an image that OpenCV cannot convert")
        return Shot(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), stamp)  # type: ignore[arg-type]

    def _grab(self) -> bool:
        if self._capture.grab():
            return True
        if not self._loop:
            return False
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
        return self._capture.grab()

    def _driver_stamp(self) -> float:
        # For V4L2, OpenCV passes on the buffer's timeval.
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        arrival = time.monotonic()
        if not plausible_stamp(stamp, arrival):
            raise DeviceError(
                f"the driver's stamp {stamp:.3f} s is not on the monotonic clock, now"
                f' {arrival:.3f} s; set stamps = "arrival"'
            )
        return min(stamp, arrival)

    def interrupt(self) -> None:
        pass  # a VideoCapture must not be touched while another thread reads it

    def close(self) -> None:
        self._capture.release()


def device_kind(device: str | int) -> Kind:
    """What sort of device ``cv2.VideoCapture`` is to open.

    Raises:
        ValueError: on an empty name or a negative index.
    """
    text = str(device).strip()
    if re.fullmatch(r"\d+|/dev/.+", text):
        return "v4l2"
    if not text or isinstance(device, int):
        raise ValueError(
            "device: expected an index from 0, /dev/videoN, a file, a URL or a GStreamer"
            f" pipeline, got {device!r}"
        )
    if "!" in text:
        return "gstreamer"
    return "url" if re.match(r"[a-z][a-z0-9+.]*://", text) else "file"
