"""Reads an arm's joint angles over RTDE, as the interface's specification has it.

A client of its own: what the world sees of a robot is what any RTDE client sees. (Universal Robots,
"Real-Time Data Exchange (RTDE) Guide", protocol version 2; everything is big-endian.)
"""

import bisect
import logging
import socket
import struct
import threading
import time
from collections import deque
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array

PORT = 30004

_PROTOCOL_VERSION, _OUTPUTS, _START, _DATA = 86, 79, 83, 85  # V O S U
_HEADER = struct.Struct(">HB")
_RECIPE = "timestamp,actual_q"
_RECIPE_TYPES = "DOUBLE,VECTOR6D"
_SAMPLE = struct.Struct(">B7d")
_HANDSHAKE_TIMEOUT = 1.0
_SILENCE = 2.0  # after which a link is given up [s]
_RETRY = 0.2  # between two attempts to connect [s]
_PATIENCE = 3.0  # with a controller that starts or stops, before it is worth a warning [s]
_KEPT = 2.0  # of the joint angles' history [s]
_CLOCK_WINDOW = 5.0
_CLOCK_JUMP = 1.0

_log = logging.getLogger(__name__)


class JointSample(NamedTuple):
    """Joint angles (6,) [rad] and when they were so, monotonic [s]."""

    stamp: float
    joint_angles: Array


class ClockMap:
    """Turns a controller's time into monotonic time by the promptest packages of late.

    Arrivals are late by as much as the network and the scheduler please, never early. So the
    smallest difference between arrival and the controller's clock, over the last 5 to 10 s, tells
    the two clocks apart.
    """

    def __init__(self) -> None:
        self._offset = self._next_offset = np.inf
        self._window_end = -np.inf

    def stamp(self, robot_time: float, arrival: float) -> float:
        """When it was ``robot_time`` [s] there, of a package that came at ``arrival`` [s]."""
        offset = arrival - robot_time
        if not abs(offset - self._offset) < _CLOCK_JUMP:
            self._offset = self._next_offset = offset
            self._window_end = arrival + _CLOCK_WINDOW
        elif arrival > self._window_end:
            self._offset, self._next_offset = min(self._next_offset, offset), offset
            self._window_end = arrival + _CLOCK_WINDOW
        self._offset = min(self._offset, offset)
        self._next_offset = min(self._next_offset, offset)
        return robot_time + self._offset


class JointHistory:
    """The last two seconds of an arm's joint angles; safe to share between threads."""

    def __init__(self) -> None:
        self._samples: deque[JointSample] = deque()
        self._lock = threading.Lock()

    def add(self, stamp: float, joint_angles: Array) -> None:
        """Takes a sample (6,) [rad]; one that is not newer than the newest is dropped."""
        with self._lock:
            if self._samples and stamp <= self._samples[-1].stamp:
                return
            self._samples.append(JointSample(stamp, joint_angles))
            while self._samples[0].stamp < stamp - _KEPT:
                self._samples.popleft()

    @property
    def newest(self) -> JointSample | None:
        with self._lock:
            return self._samples[-1] if self._samples else None

    def at(self, stamp: float) -> Array:
        """Joint angles (6,) [rad] at ``stamp``, interpolated; beyond the ends they are held.

        Raises:
            ValueError: if there is no sample yet.
        """
        with self._lock:
            if not self._samples:
                raise ValueError("the arm has not told its joint angles yet")
            after = bisect.bisect_left(self._samples, stamp, key=lambda sample: sample.stamp)
            if after == 0 or after == len(self._samples):
                return self._samples[min(after, len(self._samples) - 1)].joint_angles
            (t0, q0), (t1, q1) = self._samples[after - 1], self._samples[after]
        return q0 + (stamp - t0) / (t1 - t0) * (q1 - q0)


class RtdeReader:
    """Keeps the joint angles of one controller at hand; reconnects by itself.

    Args:
        address: of the controller.
        port: RTDE's.
        frequency: of the samples [Hz].

    Attributes:
        history: what was read.
        connected: whether samples are coming in.
        connections: how often a stream was started.
    """

    def __init__(self, address: str, port: int = PORT, frequency: float = 125.0) -> None:
        self.address, self.port, self.frequency = address, port, frequency
        self.history = JointHistory()
        self.connected = False
        self.connections = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"rtde {address}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the link; closing twice does no harm."""
        self._closing.set()
        self._thread.join(timeout=_SILENCE + _HANDSHAKE_TIMEOUT)

    def _run(self) -> None:
        where, lost_at, reported = (self.address, self.port), time.monotonic(), False
        while not self._closing.is_set():
            try:
                with socket.create_connection(
                    (self.address, self.port), _HANDSHAKE_TIMEOUT
                ) as link:
                    self._read(link)
            except (OSError, ValueError) as error:
                now = time.monotonic()
                if self.connected:
                    lost_at, reported = now, False
                if now - lost_at > _PATIENCE and not reported:
                    _log.warning("RTDE %s:%d: %s; retrying", *where, error)
                    reported = True
            self.connected = False
            self._closing.wait(_RETRY)

    def _read(self, link: socket.socket) -> None:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        recipe = self._handshake(link)
        self.connections += 1
        clock = ClockMap()
        link.settimeout(0.2)
        received, last = b"", time.monotonic()
        while not self._closing.is_set():
            try:
                chunk = link.recv(65536)
            except TimeoutError:
                if time.monotonic() - last > _SILENCE:
                    raise TimeoutError(f"no data for {_SILENCE:g} s") from None
                continue
            if not chunk:
                raise ConnectionError("the controller closed the link")
            last = time.monotonic()
            packages, received = split_packages(received + chunk)
            for kind, payload in packages:
                if kind == _DATA and len(payload) == _SAMPLE.size and payload[0] == recipe:
                    _, robot_time, *joint_angles = _SAMPLE.unpack(payload)
                    self.connected = True
                    if np.isfinite(joint_angles).all() and np.isfinite(robot_time):
                        stamp = clock.stamp(robot_time, last)
                        self.history.add(stamp, np.array(joint_angles))

    def _handshake(self, link: socket.socket) -> int:
        """Asks for the samples; returns the number of their recipe."""
        if self._ask(link, _PROTOCOL_VERSION, struct.pack(">H", 2)) != b"\x01":
            raise ValueError("the controller does not speak RTDE version 2")
        wanted = struct.pack(">d", self.frequency) + _RECIPE.encode()
        reply = self._ask(link, _OUTPUTS, wanted)
        types = reply[1:].decode("ascii", "replace").rstrip(",\0")
        if not reply or types != _RECIPE_TYPES:
            raise ValueError(f"asked for {_RECIPE}, the controller answered {types!r}")
        if self._ask(link, _START, b"") != b"\x01":
            raise ValueError("the controller does not start its stream")
        return reply[0]

    def _ask(self, link: socket.socket, kind: int, payload: bytes) -> bytes:
        """The payload of the answer of the same kind; others (text messages) are passed over."""
        link.sendall(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
        for _ in range(100):
            size, answered = _HEADER.unpack(_exactly(link, _HEADER.size))
            if size < _HEADER.size:
                raise ValueError(f"package of {size} bytes")
            answer = _exactly(link, size - _HEADER.size)
            if answered == kind:
                return answer
        raise ValueError(f"no answer to {chr(kind)!r} among 100 packages")


def split_packages(received: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Whole packages as (kind, payload), and the bytes that are left over.

    Raises:
        ValueError: on a size below that of the header.
    """
    packages, start = [], 0
    while len(received) - start >= _HEADER.size:
        size, kind = _HEADER.unpack_from(received, start)
        if size < _HEADER.size:
            raise ValueError(f"package of {size} bytes")
        if len(received) - start < size:
            break
        packages.append((kind, received[start + _HEADER.size : start + size]))
        start += size
    return packages, received[start:]


def _exactly(link: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = link.recv(size - len(data))
        if not chunk:
            raise ConnectionError("the controller closed the link")
        data += chunk
    return data
