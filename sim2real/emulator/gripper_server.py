"""Port 63352: a Robotiq gripper behind its URCap's socket.

``SET POS 128 SPE 255 FOR 10 GTO 1`` is answered by ``ack``, ``GET POS`` by ``POS 3``; the replies
end with nothing, as the URCap's do. Variables: ACT activate, GTO go, ATR automatic release, POS
position 0 open to 255 closed, SPE speed, FOR force; read only: STA 0 reset, 1 activating, 3 active;
OBJ 0 moving, 1 and 2 stopped by an object while opening and closing, 3 at the requested position;
PRE the requested position; FLT fault. (Robotiq, 2F-85 instruction manual, "Control".)
"""

import time
from collections.abc import Callable
from typing import Any

from sim2real.emulator.connections import LineConnection, Listener

GRIPPER_PORT = 63352
ACTIVATION_TIME = 1.0  # s, a full closing and opening
SLOWEST, FASTEST = 60.0, 450.0  # positions per second: 20 and 150 mm/s of 85 mm in 255 steps
_WRITABLE = ("ACT", "GTO", "ATR", "POS", "SPE", "FOR")
_NOT_ACTIVE = 5  # FLT: the action waits for the activation


class Gripper:
    """A two-finger gripper.

    Args:
        clock: monotonic time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._time = clock()
        self._set: dict[str, int] = dict.fromkeys(_WRITABLE, 0)
        self._position = 0.0
        self._target = 0
        self._active_at: float | None = None
        self._object: int | None = None
        self._object_state = 3

    @property
    def status(self) -> int:
        """STA."""
        if self._active_at is None:
            return 0
        return 3 if self._clock() >= self._active_at else 1

    def set_object(self, width: int | None) -> None:
        """The position at which closing fingers meet something; None when nothing is there."""
        self._advance()
        self._object = width

    def state(self) -> dict[str, Any]:
        """What the gripper is and does."""
        self._advance()
        return {
            "position": self._position,
            "target": self._target,
            "status": self.status,
            "object": self._object_state,
            "object_width": self._object,
        }

    def reply(self, line: str) -> str:
        """The answer to one line: ``ack``, ``NAME value``, or ``?`` if it cannot be understood."""
        self._advance()
        words = line.split()
        if len(words) == 2 and words[0] == "GET":
            values = {
                **self._set,
                "STA": self.status,
                "OBJ": self._object_state,
                "PRE": self._target,
                "FLT": self._fault(),
                "POS": round(self._position),
            }
            return f"{words[1]} {values[words[1]]}" if words[1] in values else "?"
        if len(words) >= 3 and len(words) % 2 and words[0] == "SET":
            return self._assign(dict(zip(words[1::2], words[2::2], strict=True)))
        return "?"

    def _assign(self, assignments: dict[str, str]) -> str:
        for name, value in assignments.items():
            digits = value.isascii() and value.isdigit() and len(value) <= 3
            if name not in _WRITABLE or not digits or int(value) > 255:
                return "?"
        self._set.update((name, int(value)) for name, value in assignments.items())
        if self._set["ACT"] == 0:
            self._active_at = None
        elif self._active_at is None:
            self._active_at = self._clock() + ACTIVATION_TIME
            self._position, self._target = 0.0, 0
            return "ack"
        moving = "POS" in assignments or "GTO" in assignments
        if moving and self.status == 3 and self._set["GTO"] == 1:
            self._target = self._set["POS"]
            self._object_state = 0
            self._step(0.0)
        return "ack"

    def _fault(self) -> int:
        return _NOT_ACTIVE if self._set["GTO"] == 1 and self.status == 1 else 0

    def _advance(self) -> None:
        now = self._clock()
        duration, self._time = now - self._time, now
        self._step(duration)

    def _step(self, duration: float) -> None:
        """Move the fingers for ``duration`` [s]."""
        if self.status != 3 or self._set["GTO"] != 1:
            return
        way = (SLOWEST + (FASTEST - SLOWEST) * self._set["SPE"] / 255) * duration
        start, end = self._position, float(self._target)
        met = self._object is not None and start <= self._object < end
        if met:
            end = float(self._object or 0)
        self._position = min(start + way, end) if end > start else max(start - way, end)
        if self._position != end:
            self._object_state = 0
        else:
            self._object_state = 2 if met else 3


class GripperServer:
    """The port of the gripper's URCap."""

    def __init__(self, address: str) -> None:
        self.gripper = Gripper()
        self.listener = Listener(
            address, GRIPPER_PORT, lambda port: _GripperConnection(port, self.gripper)
        )


class _GripperConnection(LineConnection):
    ending = b""

    def __init__(self, listener: Listener, gripper: Gripper) -> None:
        super().__init__(listener)
        self._gripper = gripper

    def answer(self, line: str) -> str | None:
        return self._gripper.reply(line) if line else None
