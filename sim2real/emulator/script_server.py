"""Port 30003: takes programs; the one of ur_rtde runs, others are logged and left alone."""

import logging
import re

from sim2real.emulator import control_program
from sim2real.emulator.connections import Connection, Listener
from sim2real.emulator.controller import Controller

_log = logging.getLogger(__name__)

SCRIPT_PORT = 30003
LONGEST_SCRIPT = 1 << 18  # bytes; ur_rtde's program has about 42000
_START = re.compile(rb"^(?:def|sec)\b", re.M)
_END = re.compile(rb"^end[ \t\r]*\n", re.M)


class ScriptServer:
    """The port programs are sent to."""

    def __init__(self, address: str, controller: Controller) -> None:
        self.listener = Listener(
            address, SCRIPT_PORT, lambda port: _ScriptConnection(port, controller)
        )


class _ScriptConnection(Connection):
    def __init__(self, listener: Listener, controller: Controller) -> None:
        super().__init__(listener)
        self._controller = controller
        self._text = b""
        self._searched = 0

    def data_received(self, data: bytes) -> None:
        self._text += data
        while script := self._next_script():
            self._run(script.decode(errors="replace"))
        if len(self._text) > LONGEST_SCRIPT:
            self._controller.note(f"script of more than {LONGEST_SCRIPT} bytes refused")
            self.abort()

    def eof_received(self) -> None:
        if self._text:
            self.data_received(b"\n")

    def _next_script(self) -> bytes:
        """The next complete program; what is not inside one is thrown away."""
        if not _START.match(self._text):
            start = _START.search(self._text)
            # The last line may become a program's first with the bytes to come.
            outside = start.start() if start else self._text.rfind(b"\n") + 1
            if self._text[:outside].strip():
                self._controller.note("script line outside of a program ignored")
            self._text, self._searched = self._text[outside:], 0
            if start is None:
                return b""
        end = _END.search(self._text, self._searched)
        if end is None:
            self._searched = self._text.rfind(b"\n") + 1
            return b""
        script, self._text, self._searched = self._text[: end.end()], self._text[end.end() :], 0
        return script

    def _run(self, script: str) -> None:
        controller = self._controller
        if not controller.remote:
            controller.note("script refused: the robot is in local control")
            return
        if not control_program.recognised(script):
            controller.note(f"script ignored: {script.splitlines()[0][:80]}")
            return
        try:
            program = control_program.ControlProgram(controller, script)
        except ValueError as error:
            controller.note(f"script refused: {error}")
            return
        controller.start_program(program)
