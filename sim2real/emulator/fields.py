"""The fields a client may receive or write over RTDE, and where the emulator keeps them.

Source: the tables of Universal Robots' RTDE guide. What the controller sends lies ready in one
big-endian image, renewed once per tick; a recipe then is a list of the image's bytes, so a packet
costs the same few microseconds whatever it carries.
"""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim2real.emulator.rtde_protocol import (
    BOOL,
    DOUBLE,
    HEADER,
    INT32,
    UINT8,
    UINT32,
    UINT64,
    VECTOR3D,
    VECTOR6D,
    VECTOR6INT32,
    FieldType,
    PacketType,
)

REGISTERS = 48  # of each kind; 0-23 for fieldbus users, 24-47 for external RTDE clients

# What changes in every tick lies together, in this order, for one kernel to fill.
_LIVE = (
    "actual_q target_q actual_qd target_qd target_qdd actual_TCP_pose target_TCP_pose"
    " actual_TCP_speed target_TCP_speed actual_TCP_force ft_raw_wrench"
)
_VECTORS = (
    f"{_LIVE} target_current target_moment actual_current joint_control_output joint_temperatures"
    " actual_joint_voltage tcp_offset payload_inertia actual_current_window"
)
_TRIPLES = "actual_tool_accelerometer elbow_position elbow_velocity payload_cog"
_DOUBLES = (
    "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum"
    " actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0"
    " standard_analog_input1 standard_analog_output0 standard_analog_output1 io_current"
    " tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature payload"
    " tcp_force_scalar joint_position_deviation_ratio collision_detection_ratio"
)
_UINT32S = (
    "runtime_state robot_status_bits safety_status_bits analog_io_types tool_mode"
    " tool_analog_input_types output_bit_registers0_to_31 output_bit_registers32_to_63"
    " script_control_line input_bit_registers0_to_31 input_bit_registers32_to_63"
)
_INT32S = "robot_mode safety_mode safety_status tool_output_voltage time_scale_source"
_UINT64S = "actual_digital_input_bits actual_digital_output_bits"


def _output_types() -> dict[str, FieldType]:
    types: dict[str, FieldType] = {}
    for names, kind in (
        (_DOUBLES, DOUBLE),
        (_VECTORS, VECTOR6D),
        (_TRIPLES, VECTOR3D),
        (_INT32S, INT32),
        ("joint_mode", VECTOR6INT32),
        (_UINT32S, UINT32),
        (_UINT64S, UINT64),
    ):
        types.update((name, kind) for name in names.split())
    for direction in ("output", "input"):
        types.update((f"{direction}_double_register_{i}", DOUBLE) for i in range(REGISTERS))
        types.update((f"{direction}_int_register_{i}", INT32) for i in range(REGISTERS))
    return types


def _input_types() -> dict[str, FieldType]:
    types: dict[str, FieldType] = dict.fromkeys(
        ("speed_slider_mask", "input_bit_registers0_to_31", "input_bit_registers32_to_63"), UINT32
    )
    types.update(
        dict.fromkeys(
            (
                *(f"{kind}_digital_output" for kind in ("standard", "configurable", "tool")),
                *(f"{kind}_digital_output_mask" for kind in ("standard", "configurable", "tool")),
                "standard_analog_output_mask",
                "standard_analog_output_type",
            ),
            UINT8,
        )
    )
    doubles = ("speed_slider_fraction", "standard_analog_output_0", "standard_analog_output_1")
    types.update(dict.fromkeys(doubles, DOUBLE))
    types.update((f"input_bit_register_{i}", BOOL) for i in range(64, 128))
    types.update((f"input_int_register_{i}", INT32) for i in range(REGISTERS))
    types.update((f"input_double_register_{i}", DOUBLE) for i in range(REGISTERS))
    types["external_force_torque"] = VECTOR6D
    return types


OUTPUT_TYPES = _output_types()
INPUT_TYPES = _input_types()


class OutputImage:
    """Values of all output fields and the bytes they are sent as.

    Attributes:
        doubles: native copy of every float; ``view`` gives a field's part. Goes out at ``renew``.
    """

    def __init__(self) -> None:
        self._start: dict[str, int] = {}  # first byte of each field
        offset = 0
        for letters in ("d", "iI", "Q"):
            for name, kind in OUTPUT_TYPES.items():
                if kind.letter in letters:
                    self._start[name] = offset
                    offset += kind.length * kind.item_size
            if letters == "d":
                self.doubles = np.zeros(offset // 8)
        self._bytes = np.zeros(offset, dtype=np.uint8)
        self._wire_doubles = self._bytes[: 8 * len(self.doubles)].view(">f8")

    def view(self, name: str) -> NDArray[np.float64]:
        """The values (count,) of a field of floats, to write into."""
        start = self._start[name] // 8
        return self.doubles[start : start + OUTPUT_TYPES[name].length]

    def live(self) -> NDArray[np.float64]:
        """The vectors (11, 6) that change in every tick, to write into.

        Joint angles, actual and target; velocities, actual and target; target accelerations; TCP
        pose vector, actual and target; TCP speed, actual and target; TCP force; raw wrench.
        """
        start, names = self._start[_LIVE.split()[0]] // 8, _LIVE.split()
        return self.doubles[start : start + 6 * len(names)].reshape(len(names), 6)

    def registers(self) -> NDArray[np.float64]:
        """All output_double_registers (48,), to write into."""
        start = self._start["output_double_register_0"] // 8
        return self.doubles[start : start + REGISTERS]

    def input_registers(self) -> NDArray[np.float64]:
        """All input_double_registers (48,) as they are sent back to clients."""
        start = self._start["input_double_register_0"] // 8
        return self.doubles[start : start + REGISTERS]

    def set_integer(self, name: str, *values: int) -> None:
        """Write a field of integers."""
        kind = OUTPUT_TYPES[name]
        struct.pack_into(f">{kind.format}", self._bytes.data, self._start[name], *values)

    def renew(self) -> None:
        """Take the floats over into what is sent."""
        self._wire_doubles[:] = self.doubles

    def value(self, name: str) -> tuple[float | int, ...]:
        """What a client would receive now."""
        kind = OUTPUT_TYPES[name]
        return struct.unpack_from(f">{kind.format}", self._bytes.data, self._start[name])

    def recipe(self, names: list[str], identifier: int | None) -> "OutputRecipe":
        """A packet with these fields; ``identifier`` is None in protocol version 1."""
        places = [
            np.arange(OUTPUT_TYPES[name].length * OUTPUT_TYPES[name].item_size) + self._start[name]
            for name in names
        ]
        index = np.concatenate(places) if places else np.empty(0, dtype=np.intp)
        return OutputRecipe(self._bytes, index.astype(np.intp), identifier)


class OutputRecipe:
    """Fills a data packet from the image."""

    def __init__(
        self, image: NDArray[np.uint8], index: NDArray[np.intp], identifier: int | None
    ) -> None:
        head = b"" if identifier is None else bytes([identifier])
        size = HEADER.size + len(head) + len(index)
        self._image, self._index = image, index
        self._packet = np.empty(size, dtype=np.uint8)
        start = HEADER.pack(size, PacketType.DATA) + head
        self._packet[: len(start)] = np.frombuffer(start, dtype=np.uint8)
        self._fields = self._packet[len(start) :]

    def packet(self) -> bytes:
        """The packet with the fields' present values."""
        self._image.take(self._index, out=self._fields, mode="clip")
        return self._packet.tobytes()


class InputRecipe(NamedTuple):
    """How a client's data packet is read."""

    names: tuple[str, ...]
    layout: struct.Struct
    slots: tuple[tuple[list[int] | list[float], int], ...]  # registers alone, else empty


class Inputs:
    """What clients have written.

    Attributes:
        integers, floats: the 48 registers of either kind.
        others: every other field, name to values, as written last.
        owners: which connection has set up a field.
    """

    def __init__(self) -> None:
        self.integers = [0] * REGISTERS
        self.floats = [0.0] * REGISTERS
        self.others: dict[str, tuple[float | int, ...]] = {}
        self.owners: dict[str, object] = {}

    def recipe(self, names: list[str]) -> InputRecipe:
        """The recipe of fields that all exist."""
        layout = struct.Struct(">" + "".join(INPUT_TYPES[name].format for name in names))
        slots = []
        for name in names:
            if name.startswith("input_int_register_"):
                slots.append((self.integers, int(name.rsplit("_", 1)[1])))
            elif name.startswith("input_double_register_"):
                slots.append((self.floats, int(name.rsplit("_", 1)[1])))
            else:
                return InputRecipe(tuple(names), layout, ())
        return InputRecipe(tuple(names), layout, tuple(slots))

    def apply(self, recipe: InputRecipe, payload: bytes) -> dict[str, tuple[float | int, ...]]:
        """Write a packet's fields (after its recipe byte); the ones that are no registers.

        Raises:
            struct.error: if the packet has another length than the recipe.
        """
        values = recipe.layout.unpack(payload[1:])
        if recipe.slots:
            for (registers, index), value in zip(recipe.slots, values, strict=True):
                registers[index] = value
            return {}
        written: dict[str, tuple[float | int, ...]] = {}
        position = 0
        for name in recipe.names:
            count = INPUT_TYPES[name].length
            part = values[position : position + count]
            position += count
            if name.startswith("input_int_register_"):
                self.integers[int(name.rsplit("_", 1)[1])] = int(part[0])
            elif name.startswith("input_double_register_"):
                self.floats[int(name.rsplit("_", 1)[1])] = part[0]
            else:
                written[name] = self.others[name] = part
        return written

    def release(self, owner: object) -> None:
        """Free the fields that a connection had set up; their values stay."""
        for name in [name for name, holder in self.owners.items() if holder is owner]:
            del self.owners[name]
