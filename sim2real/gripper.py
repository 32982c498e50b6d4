"""Grippers: the Robotiq two-finger ones behind a UR's gripper socket, and a simulated one."""

import re
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from dlo_gym.exceptions import DeviceError

CLOSED = 255  # of the registers POS and PRE; 0 is open
ACTIVE = 3  # of STA
STOPPED_BY_OBJECT = 2  # of OBJ, while closing
FAULTS = {
    5: "an action was asked for before the activation had ended",
    7: "the activation bit must be set before an action",
    8: "too hot; let it cool down",
    9: "no communication for at least one second",
    10: "supply voltage too low",
    11: "automatic release is under way",
    12: "internal fault",
    13: "activation failed; look for what is in the fingers' way",
    14: "overcurrent",
    15: "automatic release has ended; activate again",
}
_POLL = 0.02  # [s]
_MAX_REPLY = 256  # bytes


class Gripper(Protocol):
    """A parallel gripper; a context manager that connects and disconnects, and moves nothing.

    Openings run from 0, closed, to 1, open.
    """

    name: str

    def connect(self) -> None:
        """Opens the link; connecting twice does no harm.

        Raises:
            DeviceError: if the gripper does not answer.
        """
        ...

    def activate(self) -> None:
        """Makes the gripper ready; one that is ready does not move.

        Raises:
            DeviceError: if it is not ready in time; names the fault.
        """
        ...

    def open(self) -> None:
        """Opens fully and waits; see ``move``."""
        ...

    def close_fingers(self) -> None:
        """Closes until the fingers meet or hold something, and waits; see ``move``."""
        ...

    def move(self, opening: float) -> float:
        """Moves the fingers and waits until they stand.

        Args:
            opening: from 0, closed, to 1, open.

        Returns:
            The opening really sent.

        Raises:
            DeviceError: if the gripper is not active, faults, or does not come to rest in time.
            ValueError: on an opening outside 0 to 1.
        """
        ...

    def position(self) -> float:
        """The present opening, from 0 to 1.

        Raises:
            DeviceError: if the gripper does not answer.
        """
        ...

    def holds_object(self) -> bool:
        """Whether the fingers were stopped by something while closing.

        Raises:
            DeviceError: if the gripper does not answer or has a fault.
        """
        ...

    def disconnect(self) -> None:
        """Ends the link; the fingers stay as they are. Never raises, twice does no harm."""
        ...


class _Connected:
    """The context manager of both grippers."""

    def connect(self) -> None:
        raise NotImplementedError

    def disconnect(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.disconnect()


class RobotiqGripper(_Connected):
    """A Robotiq 2F-85, 2F-140 or Hand-E, through the socket of its URCap on the robot.

    A link that breaks is opened again once per request; absolute commands may be repeated.
    Usable from several threads.

    Args:
        address: of the robot's controller.
        port: of the URCap's socket.
        name: for messages.
        speed: from 0, slowest, to 1.
        force: from 0, weakest, to 1; a cable needs little.
        timeout: of one reply [s].
        motion_timeout: of a move or an activation [s].

    Raises:
        ValueError: on a speed or force outside 0 to 1.
    """

    def __init__(
        self,
        address: str,
        port: int = 63352,
        *,
        name: str = "gripper",
        speed: float = 1.0,
        force: float = 0.04,
        timeout: float = 0.8,
        motion_timeout: float = 10.0,
    ) -> None:
        self.name = name
        self.address, self.port = address, port
        self.timeout, self.motion_timeout = timeout, motion_timeout
        self._speed = round(CLOSED * _check_fraction(speed, "speed"))
        self._force = round(CLOSED * _check_fraction(force, "force"))
        self._socket: socket.socket | None = None
        self._lock = threading.RLock()

    def connect(self) -> None:
        """Opens the link and reads the status once; connecting twice does no harm.

        Raises:
            DeviceError: if the gripper does not answer.
        """
        with self._lock:
            if self._socket is None:
                self._open_socket()
                try:
                    self._get("STA")
                except DeviceError:
                    self.disconnect()
                    raise

    def disconnect(self) -> None:
        """Ends the link; never raises, twice does no harm."""
        with self._lock:
            link, self._socket = self._socket, None
            if link is not None:
                link.close()

    def activate(self) -> None:
        """Makes the gripper ready; clears faults; one that is ready does not move.

        A gripper that was not ready opens and closes fully: mind what is between its fingers.

        Raises:
            DeviceError: if it is not ready within the motion timeout; names the fault.
        """
        # Activating again would drop what it holds.
        if self._get("STA") == ACTIVE and self._get("FLT") == 0:
            return
        self._set(ACT=0)
        self._wait("reset", lambda: self._get("ACT") == 0 and self._get("STA") == 0)
        self._set(ACT=1)
        self._wait("activated", lambda: self._get("STA") == ACTIVE)
        self._check_fault()

    def open(self) -> None:
        """Opens fully and waits; raises as ``move`` does."""
        self.move(1.0)

    def close_fingers(self) -> None:
        """Closes until the fingers meet or hold something, and waits; raises as ``move`` does."""
        self.move(0.0)

    def move(self, opening: float) -> float:
        """Moves the fingers and waits until they stand.

        Args:
            opening: from 0, closed, to 1, open.

        Returns:
            The opening really sent, a multiple of 1/255.

        Raises:
            DeviceError: if the gripper is not active, faults, or does not come to rest within
                the motion timeout.
            ValueError: on an opening outside 0 to 1.
        """
        target = round(CLOSED * (1.0 - _check_fraction(opening, "opening")))
        self._check_fault()
        if self._get("STA") != ACTIVE:
            raise DeviceError(f"{self._label} ignores commands until activated: call activate()")
        self._set(POS=target, SPE=self._speed, FOR=self._force, GTO=1)
        # PRE echoes the target once the gripper has taken it; OBJ before that is the last move's.
        self._wait("at rest", lambda: self._get("PRE") == target and self._get("OBJ") != 0)
        self._check_fault()
        return 1.0 - target / CLOSED

    def position(self) -> float:
        """The present opening, from 0 to 1.

        Raises:
            DeviceError: if the gripper does not answer.
        """
        return min(max(1.0 - self._get("POS") / CLOSED, 0.0), 1.0)

    def holds_object(self) -> bool:
        """Whether the fingers were stopped by something while closing.

        Raises:
            DeviceError: if the gripper does not answer or has a fault.
        """
        self._check_fault()
        return self._get("OBJ") == STOPPED_BY_OBJECT

    @property
    def _label(self) -> str:
        return f"gripper {self.name!r} at {self.address}:{self.port}"

    def _check_fault(self) -> None:
        code = self._get("FLT")
        if code:
            meaning = FAULTS.get(code, "unknown fault")
            raise DeviceError(f"{self._label} reports fault {code}: {meaning}")

    def _wait(self, state: str, reached: Callable[[], bool]) -> None:
        until = time.monotonic() + self.motion_timeout
        while not reached():
            if time.monotonic() > until:
                self._check_fault()
                raise DeviceError(f"{self._label} was not {state} within {self.motion_timeout:g} s")
            time.sleep(_POLL)

    def _get(self, variable: str) -> int:
        reply = self._request(f"GET {variable}", rf"{variable} (\S+)")
        value = reply.split()[1]
        if not value.isdigit():
            raise DeviceError(
                f"{self._label} answers {reply!r}: the robot's URCap has no gripper connected"
            )
        return int(value)

    def _set(self, **variables: int) -> None:
        assignments = " ".join(f"{name} {value}" for name, value in variables.items())
        self._request(f"SET {assignments}", "ack")

    def _request(self, command: str, expected: str) -> str:
        """The reply to a command; on a broken link connects again and asks once more."""
        with self._lock:
            if self._socket is None:
                self._open_socket()
                return self._exchange(command, expected)
            try:
                return self._exchange(command, expected)
            except DeviceError:
                self._open_socket()
                return self._exchange(command, expected)

    def _open_socket(self) -> None:
        self.disconnect()
        try:
            self._socket = socket.create_connection((self.address, self.port), self.timeout)
        except OSError as error:
            raise DeviceError(f"{self._label} cannot be reached: {_cause(error)}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _exchange(self, command: str, expected: str) -> str:
        """One command and its reply; any trouble closes the link, so that no late reply stays."""
        link = self._socket
        if link is None:
            raise DeviceError(f"{self._label} is not connected")
        try:
            link.settimeout(self.timeout)
            link.sendall(f"{command}\n".encode("ascii"))
            reply = self._read_reply(link, expected)
        except OSError as error:
            self.disconnect()
            raise DeviceError(
                f"{self._label} did not answer {command!r}: {_cause(error)}"
            ) from error
        except DeviceError:
            self.disconnect()
            raise
        return reply

    def _read_reply(self, link: socket.socket, expected: str) -> str:
        # The URCap ends its replies with nothing, some of its imitations with a newline.
        received = b""
        until = time.monotonic() + self.timeout
        while True:
            chunk = link.recv(_MAX_REPLY)
            if not chunk:
                raise ConnectionResetError("the link was closed")
            received += chunk
            reply = received.decode("ascii", errors="replace").strip()
            if re.fullmatch(expected, reply):
                return reply
            if b"\n" in received or len(received) > _MAX_REPLY or time.monotonic() > until:
                raise DeviceError(
                    f"{self._label}: expected a reply like {expected!r}, got {reply!r}"
                )


class SimulatedGripper(_Connected):
    """A gripper that does at once what it is told, by the rules of the real one.

    Args:
        name: for messages.
        object_opening: the opening at which something between the fingers stops them; None when
            there is nothing.
    """

    def __init__(self, name: str = "gripper", *, object_opening: float | None = None) -> None:
        self.name = name
        self.object_opening = object_opening
        self._opening = 1.0
        self._holds = False
        self._connected = self._active = False

    def connect(self) -> None:
        """Opens the link; connecting twice does no harm."""
        self._connected = True

    def disconnect(self) -> None:
        """Ends the link; the fingers stay as they are."""
        self._connected = False

    def activate(self) -> None:
        """Makes the gripper ready.

        Raises:
            DeviceError: if it is not connected.
        """
        self._require_link()
        self._active = True

    def open(self) -> None:
        """Opens fully; raises as ``move`` does."""
        self.move(1.0)

    def close_fingers(self) -> None:
        """Closes until the fingers meet or hold something; raises as ``move`` does."""
        self.move(0.0)

    def move(self, opening: float) -> float:
        """Moves the fingers and returns the opening sent, a multiple of 1/255.

        Raises:
            DeviceError: if the gripper is not connected or not active.
            ValueError: on an opening outside 0 to 1.
        """
        sent = round(CLOSED * _check_fraction(opening, "opening")) / CLOSED
        self._require_link()
        if not self._active:
            raise DeviceError(
                f"gripper {self.name!r} ignores commands until activated: call activate()"
            )
        stop = self.object_opening
        self._holds = stop is not None and sent < stop <= self._opening
        self._opening = stop if self._holds and stop is not None else sent
        return sent

    def position(self) -> float:
        """The present opening, from 0 to 1.

        Raises:
            DeviceError: if it is not connected.
        """
        self._require_link()
        return self._opening

    def holds_object(self) -> bool:
        """Whether the fingers were stopped by something while closing.

        Raises:
            DeviceError: if it is not connected.
        """
        self._require_link()
        return self._holds

    def _require_link(self) -> None:
        if not self._connected:
            raise DeviceError(f"gripper {self.name!r} is not connected")


def _check_fraction(value: float, name: str) -> float:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name}: expected a value from 0 to 1, got {value}")
    return value


def _cause(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return "no reply in time"
    return error.strerror or str(error) or type(error).__name__
