"""RTDE, the Real-Time Data Exchange of Universal Robots: packets and field types.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A packet is a big-endian uint16
size that counts its own three header bytes, a uint8 type, and a payload.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

MAX_PACKET = 16384  # bytes; the longest setup of every known field has about 9000
MAX_PACKETS_AT_ONCE = 2000  # in one read of a socket; a client that sends more is flooding

HEADER = struct.Struct(">HB")


class PacketType(IntEnum):
    """The letter that says what a packet is for."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA = ord("U")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class FieldType(NamedTuple):
    """How a field is written: its name on the wire, struct letter and number of them."""

    name: str
    letter: str
    length: int

    @property
    def format(self) -> str:
        return f"{self.length}{self.letter}"

    @property
    def item_size(self) -> int:
        return struct.calcsize(f">{self.letter}")


BOOL = FieldType("BOOL", "B", 1)
UINT8 = FieldType("UINT8", "B", 1)
UINT32 = FieldType("UINT32", "I", 1)
UINT64 = FieldType("UINT64", "Q", 1)
INT32 = FieldType("INT32", "i", 1)
DOUBLE = FieldType("DOUBLE", "d", 1)
VECTOR3D = FieldType("VECTOR3D", "d", 3)
VECTOR6D = FieldType("VECTOR6D", "d", 6)
VECTOR6INT32 = FieldType("VECTOR6INT32", "i", 6)

NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"


class ProtocolError(Exception):
    """Bytes that are no RTDE packet; the connection cannot be trusted any longer."""


class Packet(NamedTuple):
    """One packet that arrived."""

    type: int
    payload: bytes


def packet(kind: PacketType, payload: bytes = b"") -> bytes:
    """The bytes of a packet."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def text_message(text: str, source: str, level: int) -> bytes:
    """A message to the client; ``level`` 0 exception, 1 error, 2 warning, 3 info."""
    message, origin = text.encode()[:255], source.encode()[:255]
    payload = bytes([len(message)]) + message + bytes([len(origin)]) + origin + bytes([level])
    return packet(PacketType.TEXT_MESSAGE, payload)


def read_text_message(payload: bytes) -> tuple[str, str, int]:
    """Text, source and level of a message a client sent.

    Raises:
        ProtocolError: if the lengths in it do not fit.
    """
    try:
        length = payload[0]
        text = payload[1 : 1 + length]
        source_length = payload[1 + length]
        source = payload[2 + length : 2 + length + source_length]
        level = payload[2 + length + source_length]
    except IndexError:
        raise ProtocolError("text message: lengths beyond the packet's end") from None
    return text.decode(errors="replace"), source.decode(errors="replace"), level


def field_names(payload: bytes) -> list[str]:
    """The names of a setup, without the empty one behind a trailing comma."""
    return [name for name in payload.decode("ascii", errors="replace").split(",") if name]


class PacketReader:
    """Cuts the bytes of a connection into packets."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that are complete with ``data``; keeps what is not.

        Raises:
            ProtocolError: at a size no packet can have, or too many packets at once.
        """
        if self._rest:
            data = self._rest + data
        packets: list[Packet] = []
        offset, end = 0, len(data)
        while end - offset >= HEADER.size:
            size, kind = HEADER.unpack_from(data, offset)
            if not HEADER.size <= size <= MAX_PACKET:
                raise ProtocolError(f"packet size {size}, expected {HEADER.size} to {MAX_PACKET}")
            if end - offset < size:
                break
            packets.append(Packet(kind, data[offset + HEADER.size : offset + size]))
            offset += size
            if len(packets) > MAX_PACKETS_AT_ONCE:
                raise ProtocolError(f"more than {MAX_PACKETS_AT_ONCE} packets at once")
        self._rest = data[offset:]
        return packets
