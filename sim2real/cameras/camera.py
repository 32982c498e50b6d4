"""What every camera offers, and how one is described."""

import math
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel

Driver = Literal["opencv", "mjpeg", "oak"]
StampSource = Literal["auto", "header", "arrival"]

DRIVERS: tuple[Driver, ...] = ("opencv", "mjpeg", "oak")
STAMP_SOURCES: tuple[StampSource, ...] = ("auto", "header", "arrival")


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and when it was taken.

    Attributes:
        image: (height, width, 3) uint8 RGB; shared by all who ask, so copy before writing.
        stamp: capture time, monotonic [s].
        arrival: when the image was here, decoded, monotonic [s].
        index: counts this camera's frames since it was opened.
    """

    image: NDArray[np.uint8]
    stamp: float
    arrival: float
    index: int


class CameraStatistics(NamedTuple):
    """How a stream has been since it was opened.

    Attributes:
        n_frames: that arrived.
        n_dropped: that were damaged, or lost as far as gaps between stamps tell; outages left out.
        n_reopened: times the stream was lost and came back.
        rate_hz: mean over the frames now buffered [1/s]; NaN with fewer than two.
        delay: mean of arrival minus stamp over the frames now buffered [s]; NaN without one.
    """

    n_frames: int
    n_dropped: int
    n_reopened: int
    rate_hz: float
    delay: float


class Camera(Protocol):
    """A camera that streams; a context manager that opens and closes it.

    Attributes:
        model: its size, intrinsics and place.
        latency: from capture to arrival [s], where the source does not tell the capture time.
    """

    model: CameraModel
    latency: float

    def open(self) -> None:
        """Starts the capture thread and waits for the first frame; opening twice does no harm.

        Raises:
            DeviceError: naming the camera and the cause, if no frame has come in time.
        """
        ...

    def latest(self) -> Frame:
        """The newest frame.

        Raises:
            DeviceError: naming the camera and the seconds, if none has come for its timeout.
        """
        ...

    def frames(self, since: float) -> list[Frame]:
        """The buffered frames, of at least the last second, with a stamp after ``since`` [s].

        Oldest first; empty, not an error, while the stream is silent.

        Raises:
            DeviceError: if the camera is not open.
        """
        ...

    def close(self) -> None:
        """Ends the capture; never raises, never hangs, closing twice does no harm."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


@dataclass(frozen=True)
class CameraSettings:
    """How a camera of the cell is reached.

    Attributes:
        driver: "opencv", "mjpeg" or "oak".
        device: index, ``/dev/video0``, file, RTSP URL or GStreamer pipeline of "opencv"; URL of
            "mjpeg"; device id or IP address of "oak", empty for the only one connected.
        latency: from capture to arrival [s]; used where stamps are by arrival.
        rate_hz: asked for where the driver can ask [1/s]; None takes what comes.
        stamps: "header" trusts the capture time that the source tells (HTTP header, V4L2 driver,
            OAK clock) and refuses a source that tells none; "arrival" takes the arrival minus
            the latency; "auto" is "header" for mjpeg, oak and V4L2 devices, else "arrival".
        timeout: silence after which the camera counts as gone [s].

    Raises:
        ValueError: naming the field.
    """

    driver: Driver
    device: str | int = ""
    latency: float = 0.0
    rate_hz: float | None = None
    stamps: StampSource = "auto"
    timeout: float = 0.5

    def __post_init__(self) -> None:
        for name, choices in (("driver", DRIVERS), ("stamps", STAMP_SOURCES)):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if not 0.0 <= self.latency < 5.0:
            raise ValueError(f"latency: expected 0 <= latency < 5 s, got {self.latency}")
        if self.rate_hz is not None and not 0.0 < self.rate_hz <= 1000.0:
            raise ValueError(f"rate_hz: expected 0 < rate <= 1000 Hz, got {self.rate_hz}")
        if not 0.0 < self.timeout < math.inf:
            raise ValueError(f"timeout: expected a positive time [s], got {self.timeout}")
