"""The thread that reads a camera, whatever happens to the stream."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import CameraStatistics, Frame
from sim2real.cameras.frame_buffer import FrameBuffer

MAX_AGE = 5.0  # no stamp that a source tells is believed to be older on arrival [s]
CLOCK_TOLERANCE = 0.05  # by which such a stamp may lie in the future, between machines [s]
JOIN_TIMEOUT = 1.0  # what close() grants a hanging read [s]
_FIRST_RETRY, _LAST_RETRY = 0.1, 2.0  # [s]


class EndOfStreamError(Exception):
    """The source has come to its end; opening it again makes no sense."""


class DamagedImageError(Exception):
    """One image was unreadable; the next may be good."""


class Shot(NamedTuple):
    """What a source gives: an RGB image (height, width, 3) and its capture time [s] if told."""

    image: NDArray[np.uint8]
    stamp: float | None


class Source(Protocol):
    """One connection to a device, used by one thread."""

    def read(self) -> Shot:
        """Waits for the next image; any error but `DamagedImageError` ends the connection."""
        ...

    def interrupt(self) -> None:
        """Called by another thread: ends a pending ``read``, where the device allows it."""
        ...

    def close(self) -> None: ...


class StreamCamera(ABC):
    """A `Camera` over any source of images: captures in a thread, reopens a lost stream.

    While the stream is lost its frames simply grow old. The thread is a daemon and ``close``
    waits for it only so long: a device whose driver hangs cannot hang the program.

    Args:
        model: whose size every image must have.
        latency: from capture to arrival [s].
        timeout: silence after which ``latest`` refuses [s].
        rate_hz: nominal rate; None if unknown.
    """

    open_timeout = 3.0  # [s]

    def __init__(
        self,
        model: CameraModel,
        *,
        latency: float = 0.0,
        timeout: float = 0.5,
        rate_hz: float | None = None,
    ) -> None:
        self.model = model
        self.latency = latency
        self.timeout = timeout
        self.rate_hz = rate_hz
        self._capture: _Capture | None = None

    @abstractmethod
    def _connect(self) -> Source:
        """Opens the device; runs in the capture thread."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def open(self) -> None:
        """Starts the capture thread and waits for the first frame; opening twice does no harm.

        Raises:
            DeviceError: naming the camera and the cause, if no frame has come in time.
        """
        if self._capture is not None:
            return
        buffer = FrameBuffer(self.model.name, timeout=self.timeout)
        capture = _Capture(self._connect, buffer, self.model, self.latency)
        capture.start()
        if not self._first_frame(buffer):
            capture.stop()
            reason = buffer.failure or f"no frame within {self.open_timeout:g} s"
            raise DeviceError(f"camera {self.model.name!r} cannot be opened: {reason}")
        self._capture = capture

    def _first_frame(self, buffer: FrameBuffer) -> bool:
        return buffer.wait(1, self.open_timeout)

    def latest(self) -> Frame:
        """The newest frame.

        Raises:
            DeviceError: if it is older than the timeout, or the camera is not open.
        """
        return self._buffer().latest()

    def frames(self, since: float) -> list[Frame]:
        """The buffered frames with a stamp after ``since`` [s], oldest first.

        Raises:
            DeviceError: if the camera is not open.
        """
        return self._buffer().frames(since)

    def statistics(self) -> CameraStatistics:
        """How the stream has been since it was opened.

        Raises:
            DeviceError: if the camera is not open.
        """
        return self._buffer().statistics()

    def close(self) -> None:
        """Ends the capture; never raises, returns within about a second, twice does no harm."""
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.stop()

    def _buffer(self) -> FrameBuffer:
        if self._capture is None:
            raise DeviceError(f"camera {self.model.name!r} is not open")
        return self._capture.buffer


class _Capture:
    """One thread from ``open`` to ``close``; a later ``open`` never meets an earlier one's."""

    def __init__(
        self,
        connect: Callable[[], Source],
        buffer: FrameBuffer,
        model: CameraModel,
        latency: float,
    ) -> None:
        self.buffer = buffer
        self._connect = connect
        self._model = model
        self._latency = latency
        self._stopping = threading.Event()
        self._source: Source | None = None
        self._thread = threading.Thread(target=self._run, name=f"camera-{model.name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        source = self._source
        if source is not None:
            source.interrupt()
        self._thread.join(JOIN_TIMEOUT)

    def _run(self) -> None:
        retry = _FIRST_RETRY
        while not self._stopping.is_set():
            n_before = self.buffer.n_frames
            try:
                self._stream()
                return
            except EndOfStreamError as error:
                self.buffer.lost(str(error))
                return
            except Exception as error:  # a thread that dies in silence is the worst of all
                self.buffer.lost(str(error) or type(error).__name__)
            if self.buffer.n_frames == 0:
                return  # `open` reports it; who wants to try again opens again
            retry = _FIRST_RETRY if self.buffer.n_frames > n_before else min(2 * retry, _LAST_RETRY)
            self._stopping.wait(retry)

    def _stream(self) -> None:
        """Reads one connection until it breaks (raises) or the capture is stopped."""
        self._source = source = self._connect()
        try:
            first = True
            while not self._stopping.is_set():
                try:
                    shot = source.read()
                except DamagedImageError:
                    self.buffer.damaged()
                    continue
                arrival = time.monotonic()
                check_size(shot.image, self._model)
                if first and self.buffer.n_frames:
                    self.buffer.reopened()
                first = False
                stamp = arrival - self._latency if shot.stamp is None else shot.stamp
                self.buffer.add(shot.image, stamp, arrival)
        finally:
            self._source = None
            source.close()


def check_size(image: NDArray[np.uint8], model: CameraModel) -> None:
    """Refuses an image of another size than the camera's model.

    Raises:
        DeviceError: saying both.
    """
    height, width = image.shape[:2]
    if (width, height) != (model.width, model.height):
        raise DeviceError(
            f"expected images of {model.width}x{model.height} pixels as in the camera's"
            f" intrinsics, got {width}x{height}; change the device's mode or calibrate at this"
            " size"
        )


def plausible_stamp(stamp: float, arrival: float) -> bool:
    """Whether ``stamp`` [s] can be the monotonic capture time of what arrived at ``arrival``."""
    return -CLOCK_TOLERANCE <= arrival - stamp <= MAX_AGE
