"""The newest pictures of one camera between who draws and who serves them, faults included."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple


class Picture(NamedTuple):
    """A JPEG file, the time it shows (monotonic [s]), and its number."""

    jpeg: bytes
    stamp: float
    number: int


class CameraFeed:
    """The newest pictures of one camera, with the faults that cameras have.

    Args:
        latency: from ``publish`` to the clients [s].
    """

    def __init__(self, latency: float = 0.0) -> None:
        self._clients = 0
        self._latency = latency
        self._pictures: deque[tuple[float, Picture]] = deque()  # with the time they are due
        self._changed = threading.Condition()
        self._frozen_until = self._dropped_until = -float("inf")
        self._drops = 0
        self._published = 0
        self._closed = False

    def publish(self, jpeg: bytes, stamp: float) -> None:
        """Offers a picture of the time ``stamp``; frozen or dropped cameras lose it."""
        with self._changed:
            now = time.monotonic()
            self._published += 1
            if now < max(self._frozen_until, self._dropped_until):
                return
            picture = Picture(jpeg, stamp, self._published)
            self._pictures.append((now + self._latency, picture))
            while len(self._pictures) > 1 and self._pictures[1][0] <= now:
                self._pictures.popleft()
            self._changed.notify_all()

    def newer(self, number: int, timeout: float) -> Picture | None:
        """The newest picture due, if it is newer than ``number``; waits up to ``timeout`` [s].

        Raises:
            ConnectionError: when the camera is dropped or the server closes.
        """
        deadline = time.monotonic() + timeout
        with self._changed:
            drops = self._drops
            while True:
                now = time.monotonic()
                if self._closed or self._drops != drops or now < self._dropped_until:
                    raise ConnectionError("the camera is gone")
                due = [picture for when, picture in self._pictures if when <= now]
                if due and due[-1].number > number:
                    return due[-1]
                if now >= deadline:
                    return None
                coming = (when for when, picture in self._pictures if picture.number > number)
                self._changed.wait(max(min([deadline, *coming]) - now, 1e-4))

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Counts a client for as long as the block lasts."""
        with self._changed:
            self._clients += 1
        try:
            yield
        finally:
            with self._changed:
                self._clients -= 1

    @property
    def dropped(self) -> bool:
        return time.monotonic() < self._dropped_until

    def freeze(self, seconds: float) -> None:
        """No new pictures for a while; streams stay open and silent."""
        with self._changed:
            self._frozen_until = time.monotonic() + seconds

    def drop(self, seconds: float) -> None:
        """Ends all streams and refuses new ones for a while."""
        with self._changed:
            self._dropped_until = time.monotonic() + seconds
            self._drops += 1
            self._pictures.clear()
            self._changed.notify_all()

    def delay(self, seconds: float) -> None:
        """Sets the latency from now on."""
        with self._changed:
            self._latency = seconds

    def clear(self) -> None:
        """Ends freezing and dropping; the latency stays."""
        with self._changed:
            self._frozen_until = self._dropped_until = -float("inf")

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def status(self) -> dict[str, Any]:
        """What it is doing, for people and tests."""
        with self._changed:
            now = time.monotonic()
            return {
                "clients": self._clients,
                "published": self._published,
                "latency_s": self._latency,
                "frozen_s": max(self._frozen_until - now, 0.0),
                "dropped_s": max(self._dropped_until - now, 0.0),
            }
