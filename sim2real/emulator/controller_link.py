"""The world's end of its links to one emulated controller: joint angles in, wrench out."""

import json
import logging
import socket
import time
from typing import Any

import numpy as np

from dlo_gym.geometry.se3 import Array
from sim2real.emulator.loopback import CONTROL_PORT, LARGEST_REPLY, json_object
from sim2real.emulator.rtde_reader import JointSample, RtdeReader

SILENT = 0.1  # RTDE's silence after which the control port is asked where the arm is [s]
_RETRY = 0.5

_log = logging.getLogger(__name__)


class ControllerLink:
    """One emulated controller, as the world's physics is coupled to it.

    Joint angles come over RTDE. While its stream is frozen or cut on purpose, the arm itself may go
    on, so the world then asks the emulator's control port, which has no faults. Where that is gone
    too there is no controller, and the arm stands still.

    Args:
        address: of the controller.
        control_port: where the emulator takes the wrench.
    """

    def __init__(self, address: str, control_port: int = CONTROL_PORT) -> None:
        self.address = address
        self._reader = RtdeReader(address)
        self._control = _JsonLines(address, control_port)
        self._asked_at: float | None = None

    @property
    def newest(self) -> JointSample | None:
        """The newest joint angles known."""
        return self._reader.history.newest

    def joint_angles(self, stamp: float) -> Array:
        """(6,) [rad] at ``stamp``, held beyond what is known.

        Raises:
            ValueError: if nothing is known yet.
        """
        return self._reader.history.at(stamp)

    def silence(self) -> float:
        """Age of what is known [s]; infinite if nothing is."""
        newest = self.newest
        return np.inf if newest is None else time.monotonic() - newest.stamp

    def exchange(self, wrench: Array | None) -> None:
        """Tells the controller what the world exerts on its gripper; never waits, never raises.

        Args:
            wrench: (6,) at the TCP, base axes [N], [N m].
        """
        for reply in self._control.replies():
            self._take(reply)
        if wrench is not None:
            self._control.send({"set": "wrench", "value": np.round(wrench, 6).tolist()})
        if self.silence() > SILENT and (
            self._asked_at is None or time.monotonic() - self._asked_at > _RETRY
        ):
            self._asked_at = time.monotonic()
            self._control.send({"get": "state"})

    def _take(self, reply: dict[str, Any]) -> None:
        if "joints" not in reply or self._asked_at is None:
            return
        joint_angles = np.asarray(reply["joints"], dtype=np.float64)
        if joint_angles.shape == (6,) and np.isfinite(joint_angles).all():
            self._reader.history.add(self._asked_at, joint_angles)
        self._asked_at = None

    @property
    def status(self) -> dict[str, Any]:
        """For people and tests."""
        silence = self.silence()
        return {
            "address": self.address,
            "connected": self._reader.connected,
            "connections": self._reader.connections,
            "control_port": self._control.connected,
            "silent_s": round(silence, 3) if np.isfinite(silence) else None,
        }

    def close(self) -> None:
        self._reader.close()
        self._control.close()


class _JsonLines:
    """A connection that sends and takes JSON objects, a line each, without ever waiting."""

    def __init__(self, address: str, port: int) -> None:
        self._where = (address, port)
        self._socket: socket.socket | None = None
        self._received = b""
        self._retry_at = -np.inf

    @property
    def connected(self) -> bool:
        return self._socket is not None

    def send(self, value: dict[str, Any]) -> None:
        """Sends, or drops what cannot be sent at once."""
        if self._socket is None and time.monotonic() >= self._retry_at:
            self._retry_at = time.monotonic() + _RETRY
            self._connect()
        if self._socket is None:
            return
        line = json.dumps(value).encode() + b"\n"
        try:
            if self._socket.send(line) != len(line):
                raise ConnectionError("the controller does not read its control port")
        except OSError as error:
            self._lose(error)

    def replies(self) -> list[dict[str, Any]]:
        """What has come in since."""
        if self._socket is None:
            return []
        try:
            while chunk := self._socket.recv(LARGEST_REPLY):
                self._received += chunk
                if len(self._received) > 16 * LARGEST_REPLY:
                    raise ConnectionError("endless reply")
            raise ConnectionError("the controller closed its control port")
        except BlockingIOError:
            pass
        except OSError as error:
            self._lose(error)
        *lines, self._received = self._received.split(b"\n")
        return [reply for line in lines if (reply := json_object(line)) is not None]

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._received = b""

    def _connect(self) -> None:
        try:
            # On loopback a connection is made or refused at once.
            connection = socket.create_connection(self._where, timeout=0.1)
        except OSError:
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._socket = connection

    def _lose(self, error: OSError) -> None:
        _log.info("control port %s:%d: %s", *self._where, error)
        self.close()
        self._retry_at = time.monotonic() + _RETRY
