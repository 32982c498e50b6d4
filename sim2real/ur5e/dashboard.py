"""The dashboard server of a UR controller (port 29999): power, safety and program, by text lines.

A plain socket with time limits, independent of ur_rtde: it still stops a program when the
streaming client has died.
"""

import socket
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

DASHBOARD_PORT = 29999


class Dashboard:
    """A connection, opened at once.

    Args:
        address: of the controller.
        timeout: for the connection and for each reply [s].

    Raises:
        OSError: when nothing answers in time.
    """

    def __init__(self, address: str, timeout: float = 0.5) -> None:
        self._socket = socket.create_connection((address, DASHBOARD_PORT), timeout=timeout)
        self._lines = b""
        try:
            self._read_line()  # the greeting
        except OSError:
            self._socket.close()
            raise

    def ask(self, command: str) -> str:
        """The reply to one command.

        Raises:
            OSError: when the link is gone or no reply comes in time.
        """
        self._socket.sendall(command.encode() + b"\n")
        return self._read_line()

    def _read_line(self) -> str:
        while b"\n" not in self._lines:
            received = self._socket.recv(4096)
            if not received:
                raise ConnectionError("the dashboard server closed the connection")
            self._lines += received
        line, _, self._lines = self._lines.partition(b"\n")
        return line.decode(errors="replace").strip()

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def ask(address: str, commands: Sequence[str], timeout: float = 0.5) -> list[str]:
    """The replies to some commands over one connection.

    Raises:
        OSError: when the controller does not answer in time.
    """
    with Dashboard(address, timeout) as dashboard:
        return [dashboard.ask(command) for command in commands]


def stop_program(address: str, timeout: float = 0.5) -> str:
    """End the robot's program, which halts the arm; returns what came of it, never raises."""
    try:
        return ask(address, ["stop"], timeout)[0]
    except OSError as error:
        return f"no answer from the dashboard server ({error})"


def unlock_protective_stop(address: str, timeout: float) -> str:
    """Release a protective stop; returns the controller's last reply.

    A program that the stop paused is ended first, so that releasing cannot resume its motion. A
    controller refuses in the first 5 s after the stop, so this asks again for ``timeout`` [s].

    Raises:
        OSError: when the controller does not answer in time.
    """
    deadline = time.monotonic() + timeout
    with Dashboard(address) as dashboard:
        dashboard.ask("stop")
        dashboard.ask("close safety popup")
        while True:
            reply = dashboard.ask("unlock protective stop")
            if "releasing" in reply.lower() or time.monotonic() > deadline:
                return reply
            time.sleep(0.25)
