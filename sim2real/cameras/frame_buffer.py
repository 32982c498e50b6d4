"""The newest images of a stream, shared between the thread that reads and those that ask."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from operator import sub
from statistics import median

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DeviceError
from sim2real.cameras.camera import CameraStatistics, Frame

BUFFERED = 1.0  # [s]
MAX_BUFFERED = 128  # frames; a file read at full speed must not fill the memory
FRAMES_FOR_RATE = 6  # buffered frames from which gaps are judged


class FrameBuffer:
    """The frames of about the last second, written by one thread and read by any.

    Args:
        name: of the camera, for messages.
        timeout: age of the newest frame from which ``latest`` refuses it [s].
        clock: monotonic [s].
    """

    def __init__(
        self,
        name: str,
        *,
        timeout: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self.timeout = timeout
        self._clock = clock
        self._frames: deque[Frame] = deque()
        self._n_frames = self._n_dropped = self._n_reopened = 0
        self._gap_counts = False
        self._failure = ""
        self._changed = threading.Condition()

    def add(self, image: NDArray[np.uint8], stamp: float, arrival: float) -> None:
        """Appends a frame; one that is not newer than the last one is a repetition, ignored."""
        with self._changed:
            if self._frames:
                gap = stamp - self._frames[-1].stamp
                if gap <= 0.0:
                    return
                if self._gap_counts:
                    self._n_dropped += self._missing_in(gap)
            self._frames.append(Frame(image, stamp, arrival, self._n_frames))
            self._n_frames += 1
            self._gap_counts = True
            self._failure = ""
            while len(self._frames) > MAX_BUFFERED or (
                len(self._frames) > 1 and self._frames[1].arrival <= arrival - BUFFERED
            ):
                self._frames.popleft()
            self._changed.notify_all()

    def _missing_in(self, gap: float) -> int:
        """How many frames a gap [s] between stamps has swallowed, by the others' median gap."""
        if len(self._frames) < FRAMES_FOR_RATE:
            return 0
        stamps = [frame.stamp for frame in self._frames]
        return max(round(gap / median(map(sub, stamps[1:], stamps))) - 1, 0)

    def damaged(self) -> None:
        """Counts an image that could not be read."""
        with self._changed:
            self._n_dropped += 1
            self._gap_counts = False  # the gap that it leaves is this very image

    def lost(self, reason: str) -> None:
        """The stream has broken off; ``reason`` joins the message of the next stale read."""
        with self._changed:
            self._failure = reason
            self._gap_counts = False
            self._changed.notify_all()

    def reopened(self) -> None:
        """Counts a stream that came back."""
        with self._changed:
            self._n_reopened += 1

    def wait(self, n_frames: int, seconds: float) -> bool:
        """Waits until ``n_frames`` have come in all; returns early when the stream is lost."""
        with self._changed:
            self._changed.wait_for(lambda: self._n_frames >= n_frames or self._failure, seconds)
            return self._n_frames >= n_frames

    @property
    def n_frames(self) -> int:
        return self._n_frames

    @property
    def failure(self) -> str:
        """Why the stream is broken now; empty while it runs."""
        return self._failure

    def latest(self) -> Frame:
        """The newest frame.

        Raises:
            DeviceError: if it is older than the timeout, or there is none.
        """
        with self._changed:
            because = f": {self._failure}" if self._failure else ""
            if not self._frames:
                raise DeviceError(f"camera {self.name!r}: no frame yet{because}")
            age = self._clock() - self._frames[-1].arrival
            if age > self.timeout:
                raise DeviceError(
                    f"camera {self.name!r}: no new frame for {age:.2f} s"
                    f" (limit {self.timeout:g} s){because}"
                )
            return self._frames[-1]

    def frames(self, since: float) -> list[Frame]:
        """The frames with a stamp after ``since`` [s], oldest first."""
        with self._changed:
            return [frame for frame in self._frames if frame.stamp > since]

    def statistics(self) -> CameraStatistics:
        with self._changed:
            frames = list(self._frames)
            counts = self._n_frames, self._n_dropped, self._n_reopened
        delay = math.nan
        if frames:
            delay = sum(frame.arrival - frame.stamp for frame in frames) / len(frames)
        span = frames[-1].stamp - frames[0].stamp if len(frames) > 1 else 0.0
        return CameraStatistics(*counts, (len(frames) - 1) / span if span else math.nan, delay)
