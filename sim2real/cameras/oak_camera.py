"""The OAK-1, by Luxonis' depthai 3."""

from datetime import timedelta
from importlib import import_module
from typing import Any

import cv2

from dlo_gym.exceptions import DeviceError, MissingExtra
from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import CameraSettings
from sim2real.cameras.capture import Shot, StreamCamera


class OakCamera(StreamCamera):
    """The colour camera of an OAK-1.

    Its frames carry the middle of their exposure, which depthai gives on the host's monotonic
    clock. The sensor's image is cropped to the model's aspect ratio, then scaled to its size:
    calibrate at the size that is used. Written against depthai 3.12 and never run on a device.

    Args:
        settings: ``device`` is a device id or IP address, empty for the only one connected.
        model: the camera's size, intrinsics and place.

    Raises:
        MissingExtra: if depthai is not installed.
    """

    # The device boots its firmware first, and depthai searches for it for ten seconds.
    open_timeout = 20.0

    def __init__(self, settings: CameraSettings, model: CameraModel) -> None:
        try:
            self._depthai: Any = import_module("depthai")
        except ImportError:
            raise MissingExtra("depthai", "oak") from None
        super().__init__(
            model,
            latency=settings.latency,
            timeout=settings.timeout,
            rate_hz=settings.rate_hz,
        )
        self.device = str(settings.device)
        self._by_clock = settings.stamps != "arrival"

    def _connect(self) -> "_OakSource":
        dai = self._depthai
        device = dai.Device(dai.DeviceInfo(self.device)) if self.device else dai.Device()
        try:
            pipeline = dai.Pipeline(device)
            camera = pipeline.create(dai.node.Camera).build()
            output = camera.requestOutput((self.model.width, self.model.height), fps=self.rate_hz)
            queue = output.createOutputQueue(maxSize=2, blocking=False)
            pipeline.start()
        except Exception:
            device.close()
            raise
        exposure = dai.CameraExposureOffset.MIDDLE if self._by_clock else None
        return _OakSource(pipeline, device, queue, exposure, max(2 * self.timeout, 1.0))


class _OakSource:
    """One running pipeline; any object with a queue's ``get`` can stand for it."""

    def __init__(
        self, pipeline: Any, device: Any, queue: Any, exposure: Any, silence: float
    ) -> None:
        self._pipeline = pipeline
        self._device = device
        self._queue = queue
        self._exposure = exposure
        self._silence = timedelta(seconds=silence)

    def read(self) -> Shot:
        packet = self._queue.get(self._silence)
        if packet is None:
            raise DeviceError(f"silent for {self._silence.total_seconds():g} s")
        return shot_of_packet(packet, self._exposure)

    def interrupt(self) -> None:
        self._queue.close()

    def close(self) -> None:
        self._pipeline.stop()
        self._device.close()


def shot_of_packet(packet: Any, exposure: Any = None) -> Shot:
    """RGB image and capture time of a depthai ``ImgFrame``.

    Args:
        packet: whose ``getCvFrame`` gives BGR and whose ``getTimestamp`` is on the host's
            monotonic clock.
        exposure: the point of the exposure to tell, a ``CameraExposureOffset``; None tells no
            time.
    """
    image = cv2.cvtColor(packet.getCvFrame(), cv2.COLOR_BGR2RGB)
    stamp = None if exposure is None else packet.getTimestamp(exposure).total_seconds()
    return Shot(image, stamp)  # type: ignore[arg-type]  # OpenCV's stubs know no dtype
