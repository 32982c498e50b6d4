"""Port 30004: recipes, input registers, and the stream of the controller's fields."""

import logging
import math
import struct

from sim2real.emulator.connections import Connection, Listener
from sim2real.emulator.controller import Controller
from sim2real.emulator.fields import INPUT_TYPES, OUTPUT_TYPES, InputRecipe, OutputRecipe
from sim2real.emulator.motion import TICK
from sim2real.emulator.rtde_protocol import (
    IN_USE,
    NOT_FOUND,
    Packet,
    PacketReader,
    PacketType,
    ProtocolError,
    field_names,
    packet,
    read_text_message,
    text_message,
)

_log = logging.getLogger(__name__)

RTDE_PORT = 30004
_MAX_INPUT_RECIPES = 255
_MAX_FIELDS = 512
_STREAM_BACKLOG = 1 << 16  # bytes unread beyond which packets are left out, as on the robot


class RtdeServer:
    """All RTDE clients of one controller.

    Attributes:
        listener: the port.
        paused_until: the stream is frozen until this time, monotonic [s].
        mute: whether nothing is streamed at all.
    """

    def __init__(self, address: str, controller: Controller) -> None:
        self.controller = controller
        self.listener = Listener(address, RTDE_PORT, lambda port: RtdeConnection(port, controller))
        self.paused_until = -math.inf
        self.mute = False

    def stream(self, now: float) -> None:
        """Send this tick's fields to everyone whose turn it is."""
        if self.mute or now < self.paused_until:
            return
        for connection in list(self.listener.connections):
            assert isinstance(connection, RtdeConnection)
            connection.stream()


class RtdeConnection(Connection):
    """One RTDE client."""

    def __init__(self, listener: Listener, controller: Controller) -> None:
        super().__init__(listener)
        self._controller = controller
        self._reader = PacketReader()
        self._version = 1
        self._outputs: OutputRecipe | None = None
        self._inputs: dict[int, InputRecipe] = {}
        self._started = False
        self._share = 1.0  # of the ticks that are sent
        self._due = 0.0

    def leave(self) -> None:
        self._controller.inputs.release(self)

    def stream(self) -> None:
        """Send the fields, if it is this client's turn and it reads what it gets."""
        if not self._started or self._outputs is None:
            return
        self._due += self._share
        if self._due < 1.0 - 1e-9:
            return
        self._due = max(self._due - 1.0, 0.0)
        if self.backlog < _STREAM_BACKLOG:
            self.send(self._outputs.packet())

    def data_received(self, data: bytes) -> None:
        try:
            for received in self._reader.feed(data):
                self._handle(received)
        except ProtocolError as error:
            _log.warning("RTDE: %s; connection closed", error)
            self.send(text_message(str(error), "RTDE", 1))
            self.close()

    def _handle(self, received: Packet) -> None:
        kind, payload = received
        if kind == PacketType.DATA:
            self._take(payload)
        elif kind == PacketType.PROTOCOL_VERSION:
            self._choose_version(payload)
        elif kind == PacketType.CONTROLLER_VERSION:
            version = struct.pack(">4I", *self._controller.options.polyscope)
            self.send(packet(PacketType.CONTROLLER_VERSION, version))
        elif kind == PacketType.SETUP_OUTPUTS:
            self._set_up_outputs(payload)
        elif kind == PacketType.SETUP_INPUTS:
            self._set_up_inputs(payload)
        elif kind == PacketType.START:
            self._started = self._outputs is not None or bool(self._inputs)
            self.send(packet(PacketType.START, bytes([self._started])))
        elif kind == PacketType.PAUSE:
            self._started = False
            self.send(packet(PacketType.PAUSE, b"\x01"))
        elif kind == PacketType.TEXT_MESSAGE:
            text, source, level = read_text_message(payload)
            self._controller.note(f"RTDE message from {source}, level {level}: {text}")
        else:
            self._complain(f"packet type {kind} is unknown")

    def _choose_version(self, payload: bytes) -> None:
        if len(payload) != 2:
            raise ProtocolError(f"protocol version: expected 2 bytes, got {len(payload)}")
        (version,) = struct.unpack(">H", payload)
        accepted = version in (1, 2)
        if accepted:
            self._version = version
        self.send(packet(PacketType.PROTOCOL_VERSION, bytes([accepted])))

    def _set_up_outputs(self, payload: bytes) -> None:
        frequency = 1.0 / TICK
        if self._version == 2:
            if len(payload) < 8:
                raise ProtocolError("output setup: no frequency")
            (frequency,) = struct.unpack_from(">d", payload)
            payload = payload[8:]
        names = field_names(payload)
        types = [OUTPUT_TYPES[n].name if n in OUTPUT_TYPES else NOT_FOUND for n in names]
        valid = bool(names) and NOT_FOUND not in types and len(names) <= _MAX_FIELDS
        if not frequency > 0.0:  # or not a number
            self._complain(f"output frequency {frequency} is not above 0")
            valid = False
        self._outputs = None
        if valid:
            self._share, self._due = min(max(frequency * TICK, TICK), 1.0), 0.0
            identifier = 1 if self._version == 2 else None
            self._outputs = self._controller.image.recipe(names, identifier)
        head = bytes([valid]) if self._version == 2 else b""
        self.send(packet(PacketType.SETUP_OUTPUTS, head + ",".join(types).encode()))

    def _set_up_inputs(self, payload: bytes) -> None:
        names, inputs = field_names(payload), self._controller.inputs
        types = []
        for name in names:
            if name not in INPUT_TYPES:
                types.append(NOT_FOUND)
            elif inputs.owners.get(name, self) is not self:
                types.append(IN_USE)
            else:
                types.append(INPUT_TYPES[name].name)
        identifier = 0
        usable = names and len(names) <= _MAX_FIELDS and not {NOT_FOUND, IN_USE} & set(types)
        if usable and len(self._inputs) < _MAX_INPUT_RECIPES:
            identifier = len(self._inputs) + 1
            self._inputs[identifier] = inputs.recipe(names)
            inputs.owners.update(dict.fromkeys(names, self))
        reply = bytes([identifier]) + ",".join(types).encode()
        self.send(packet(PacketType.SETUP_INPUTS, reply))

    def _take(self, payload: bytes) -> None:
        recipe = self._inputs.get(payload[0]) if payload else None
        if recipe is None:
            self._complain("data for an input recipe that was not set up")
            return
        try:
            others = self._controller.inputs.apply(recipe, payload)
        except struct.error:
            expected = recipe.layout.size + 1
            self._complain(f"data of {len(payload)} bytes for a recipe of {expected}")
            return
        self._controller.written(recipe.names)
        if others:
            self._controller.set_outputs(others)

    def _complain(self, text: str) -> None:
        if self._version == 2:
            self.send(text_message(text, "RTDE", 1))
        _log.warning("RTDE: %s", text)
