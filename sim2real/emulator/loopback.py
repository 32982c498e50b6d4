"""Addresses that only this machine can reach, and the emulated controllers' control port."""

import ipaddress
import json
import socket
from typing import Any

from dlo_gym.exceptions import DeviceError

CONTROL_PORT = 63999  # of an emulated controller: faults, state, the world's forces
LARGEST_REPLY = 1 << 16


def is_loopback(address: str) -> bool:
    """Whether an address is an IPv4 address in 127.0.0.0/8."""
    try:
        return ipaddress.IPv4Address(address).is_loopback
    except ValueError:
        return False


def check_loopback(address: str, name: str = "address") -> str:
    """``address`` again. The emulator has no authentication and drives nothing real: it does not
    belong on a network.

    Raises:
        ValueError: if it is no IPv4 address in 127.0.0.0/8.
    """
    if not is_loopback(address):
        raise ValueError(f"{name}: expected an IPv4 address in 127.0.0.0/8, got {address!r}")
    return address


def ask(
    address: str, value: dict[str, Any], *, port: int = CONTROL_PORT, timeout: float = 2.0
) -> dict[str, Any]:
    """Asks an emulated controller's control port and waits for the answer.

    Raises:
        ValueError: if the controller refuses what it was asked.
        DeviceError: if it does not answer within ``timeout`` [s].
    """
    try:
        with socket.create_connection((address, port), timeout) as connection:
            connection.sendall(json.dumps(value).encode() + b"\n")
            line = connection.makefile("rb").readline(LARGEST_REPLY)
    except OSError as error:
        raise DeviceError(f"the emulated controller at {address}: {error}") from error
    answer = json_object(line)
    if answer is None:
        raise DeviceError(f"the emulated controller at {address} closed its control port")
    if "error" in answer:
        raise ValueError(f"the emulated controller at {address}: {answer['error']}")
    return answer


def json_object(line: bytes) -> dict[str, Any] | None:
    """The JSON object on a line; None if there is none."""
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
