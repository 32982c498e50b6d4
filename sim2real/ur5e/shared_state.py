"""The memory that an arm's parent and child process share: readings, command, signs of life.

No NumPy here, the child starts faster without. One writer per field. A record that must be read
whole carries a sequence number, odd while it is being written; the reader tries again until the
number is even and the same before and after (sequence lock). Single numbers are written through
memoryviews, in one store each; ``struct`` would show zeros in between.
"""

import mmap
import os
import struct
import time
from typing import NamedTuple

RING_SLOTS = 4096  # readings kept: 8 s at 500 Hz, 32 s at 125 Hz
READING_FIELDS = 40  # doubles per slot: the slot's number, then a RawReading, then padding
TEXT_BYTES = 480

IDLE, SERVOING, MOVING, LISTENING, HALTED, STARTING = range(6)

_COMMAND = struct.Struct("<2q8d")
_STATUS = struct.Struct(f"<4q7dq{TEXT_BYTES}s")
_READING = struct.Struct("<35d")

# In words of 8 bytes; each group on cache lines of its own.
_PROGRESS, _PROGRESS_TIME, _HEARTBEAT, _STOP_ASKED, _STOP_DONE, _HEAD = range(6)
_COMMAND_AT = 8
_STATUS_AT = 24
_RING_AT = 128
SIZE = 8 * (_RING_AT + RING_SLOTS * READING_FIELDS)


class RawReading(NamedTuple):
    """What the child read, as it came."""

    stamp: float  # monotonic [s]
    arrival: float  # monotonic [s]
    robot_time: float  # [s]
    joint_angles: tuple[float, ...]  # 6 [rad]
    joint_velocities: tuple[float, ...]  # 6 [rad/s]
    tcp_pose: tuple[float, ...]  # 6, UR pose vector [m, rad]
    tcp_speed: tuple[float, ...]  # 6 [m/s, rad/s]
    wrench: tuple[float, ...]  # 6 [N, N m]
    safety_bits: int
    running: bool


class Command(NamedTuple):
    """The newest target."""

    number: int
    stops: int  # how many stops were asked for before it; a later one revokes it
    duration: float  # [s]
    target: tuple[float, ...]  # 7 for a pose, 6 for joint angles


class Status(NamedTuple):
    """What the child does and, where it halted, why."""

    state: int
    accepted: int  # number of the newest command it took
    is_safety: bool  # a stop of the robot's safety system rather than a fault of the link
    setpoint: tuple[float, ...]  # 7 (pose) or 6 (joints) last sent; empty before the first
    text: str  # phase while starting, reason when halted


class SharedState:
    """Typed access to the shared memory.

    Args:
        file_descriptor: of a file of ``SIZE`` bytes, such as ``create`` makes.
    """

    def __init__(self, file_descriptor: int) -> None:
        self._memory = memoryview(mmap.mmap(file_descriptor, SIZE))
        self._integers, self._floats = self._memory.cast("q"), self._memory.cast("d")

    @staticmethod
    def create() -> int:
        """File descriptor of anonymous memory, zeroed, gone with its last user."""
        file_descriptor = os.memfd_create("arm")
        os.ftruncate(file_descriptor, SIZE)
        return file_descriptor

    def beat(self, now: float) -> None:
        """The parent lives (parent)."""
        self._floats[_HEARTBEAT] = now

    @property
    def heartbeat(self) -> float:
        return self._floats[_HEARTBEAT]

    def progress(self, cycle: int, now: float) -> None:
        """The loop came round (child)."""
        self._integers[_PROGRESS] = cycle
        self._floats[_PROGRESS_TIME] = now

    @property
    def cycles(self) -> int:
        return self._integers[_PROGRESS]

    @property
    def progress_time(self) -> float:
        return self._floats[_PROGRESS_TIME]

    def ask_stop(self) -> int:
        """Ask for a stop (parent); returns the request's number."""
        number = self.stops_asked + 1
        self._integers[_STOP_ASKED] = number
        return number

    @property
    def stops_asked(self) -> int:
        return self._integers[_STOP_ASKED]

    def acknowledge_stop(self, number: int) -> None:
        """The arm stands (child)."""
        self._integers[_STOP_DONE] = number

    @property
    def stops_done(self) -> int:
        return self._integers[_STOP_DONE]

    def send(self, target: tuple[float, ...], duration: float) -> int:
        """Replace the target (parent); returns the command's number."""
        number = self._integers[_COMMAND_AT] + 2
        self._integers[_COMMAND_AT] = number - 1
        values = (duration, *target, *([0.0] * (7 - len(target))))
        _COMMAND.pack_into(
            self._memory, 8 * _COMMAND_AT + 8, self.stops_asked, len(target), *values
        )
        self._integers[_COMMAND_AT] = number
        return number

    def command(self, after: int) -> Command | None:
        """The target, if it is newer than number ``after`` and completely written (child)."""
        number = self._integers[_COMMAND_AT]
        if number == after or number % 2:
            return None
        fields = _COMMAND.unpack_from(self._memory, 8 * _COMMAND_AT + 8)
        stops, size, duration, *values = fields
        if self._integers[_COMMAND_AT] != number:
            return None
        return Command(number, stops, duration, tuple(values[:size]))

    def publish_status(self, status: Status) -> None:
        """Replace the status (child)."""
        number = self._integers[_STATUS_AT]
        self._integers[_STATUS_AT] = number + 1
        setpoint = status.setpoint
        text = status.text.encode()[:TEXT_BYTES]
        _STATUS.pack_into(
            self._memory,
            8 * _STATUS_AT + 8,
            status.state,
            status.accepted,
            int(status.is_safety),
            len(setpoint),
            *setpoint,
            *([0.0] * (7 - len(setpoint))),
            len(text),
            text,
        )
        self._integers[_STATUS_AT] = number + 2

    def status(self) -> Status:
        """The newest status (parent)."""
        tries = 0
        while True:
            number = self._integers[_STATUS_AT]
            fields = _STATUS.unpack_from(self._memory, 8 * _STATUS_AT + 8)
            tries += 1
            # A writer that died inside leaves an odd number; this is all there will ever be.
            if (number % 2 == 0 and number == self._integers[_STATUS_AT]) or tries > 100:
                break
            if tries > 20:
                time.sleep(1e-4)
        state, accepted, is_safety, size, *values, text_size, text = fields
        setpoint = tuple(values[:size])
        return Status(
            state, accepted, bool(is_safety), setpoint, text[:text_size].decode(errors="replace")
        )

    def publish_reading(self, reading: RawReading) -> None:
        """Append to the ring (child)."""
        number = self._integers[_HEAD] + 1
        at = _RING_AT + (number % RING_SLOTS) * READING_FIELDS
        self._floats[at] = -1.0
        _READING.pack_into(
            self._memory,
            8 * at + 8,
            reading.stamp,
            reading.arrival,
            reading.robot_time,
            *reading.joint_angles,
            *reading.joint_velocities,
            *reading.tcp_pose,
            *reading.tcp_speed,
            *reading.wrench,
            reading.safety_bits,
            reading.running,
        )
        self._floats[at] = float(number)
        self._integers[_HEAD] = number

    @property
    def readings_published(self) -> int:
        return self._integers[_HEAD]

    def newest_readings(self, count: int) -> list[RawReading]:
        """Up to ``count`` readings, oldest first; those overwritten meanwhile are left out."""
        head = self.readings_published
        readings = []
        for number in range(max(1, head - min(count, RING_SLOTS - 64) + 1), head + 1):
            at = _RING_AT + (number % RING_SLOTS) * READING_FIELDS
            v = _READING.unpack_from(self._memory, 8 * at + 8)
            if self._floats[at] == number:
                vectors = v[3:9], v[9:15], v[15:21], v[21:27], v[27:33]
                readings.append(RawReading(v[0], v[1], v[2], *vectors, int(v[33]), v[34] > 0))
        return readings
