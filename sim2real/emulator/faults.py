"""Port 63999: what is done to the emulator from outside the robot, one JSON object per line.

Every object gets one reply, an object too: ``{"ok": true}``, what was asked for, or
``{"error": "..."}``.

======================================  ========================================================
``{"get": "state"}``                    joints, target, safety, mode, program and more
``{"get": "timing"}``                   lateness of ticks since the last such question, CPU time
``{"set": "wrench", "value": [6]}``     what the world exerts at the TCP, base axes [N], [N m]
``{"set": "joints", "value": [6]}``     puts the standing arm elsewhere [rad]
``{"set": "object_width", "value": w}``  gripper position at which fingers meet an object; null
``{"set": "remote_control", "value": b}``  remote or local control
``{"set": "unlock_delay", "value": s}``  of protective stops [s]
``{"fault": "freeze", "seconds": s}``   the RTDE stream pauses; sockets stay, the robot goes on
``{"fault": "drop_link"}``              all RTDE connections are closed
``{"fault": "refuse", "seconds": s}``   no new connections to any port of the robot
``{"fault": "mute"}``                   RTDE takes setups but never streams, until ``clear``
``{"fault": "clear"}``                  ends freeze, refuse and mute; safety stops stay
``{"fault": "protective_stop"}``        also ``emergency_stop``, ``release_emergency_stop``
``{"fault": "stop_program"}``           the program ends, as by the pendant's stop button
``{"fault": "crash"}``                  the process exits at once
======================================  ========================================================
"""

import json
import os
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from sim2real.emulator.connections import LineConnection, Listener
from sim2real.emulator.controller import Controller
from sim2real.emulator.loopback import CONTROL_PORT

LONGEST_FAULT = 3600.0  # s


class Links(Protocol):
    """The robot's side of its connections, as faults need it."""

    def freeze(self, seconds: float) -> None: ...
    def drop(self) -> None: ...
    def refuse(self, seconds: float) -> None: ...
    def mute(self) -> None: ...
    def clear(self) -> None: ...
    def timing(self) -> dict[str, Any]: ...
    def state(self) -> dict[str, Any]: ...
    def set_object(self, width: int | None) -> None: ...


class FaultServer:
    """The control port of one emulator."""

    def __init__(self, address: str, controller: Controller, links: Links) -> None:
        self._robot, self._links = controller, links
        self.listener = Listener(address, CONTROL_PORT, lambda port: _FaultConnection(port, self))
        self._faults: dict[str, Callable[[dict[str, Any]], None]] = {
            "freeze": lambda request: links.freeze(_seconds(request)),
            "drop_link": lambda request: links.drop(),
            "refuse": lambda request: links.refuse(_seconds(request)),
            "mute": lambda request: links.mute(),
            "clear": lambda request: links.clear(),
            "protective_stop": lambda request: controller.protective_stop("fault injected"),
            "emergency_stop": lambda request: controller.emergency_stop(),
            "release_emergency_stop": lambda request: controller.release_emergency_stop(),
            "stop_program": lambda request: controller.stop_program("stopped at the pendant"),
            "crash": lambda request: os._exit(1),
        }
        self._settings: dict[str, Callable[[Any], None]] = {
            "wrench": self._set_wrench,
            "joints": lambda value: controller.teleport(_six_numbers(value)),
            "object_width": self._set_object,
            "remote_control": self._set_remote,
            "unlock_delay": self._set_unlock_delay,
        }
        self._questions: dict[str, Callable[[], dict[str, Any]]] = {
            "state": links.state,
            "timing": links.timing,
        }

    def reply(self, line: str) -> dict[str, Any]:
        """The answer to one line."""
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise ValueError(f"expected a JSON object, got {type(request).__name__}")
            if "get" in request:
                return _choice(self._questions, request["get"], "get")()
            if "set" in request:
                _choice(self._settings, request["set"], "set")(request.get("value"))
            else:
                _choice(self._faults, request.get("fault"), "fault")(request)
        except (ValueError, RecursionError) as error:
            return {"error": str(error)[:1000]}
        return {"ok": True}

    def _set_wrench(self, value: Any) -> None:
        self._robot.wrench = _six_numbers(value)

    def _set_remote(self, value: Any) -> None:
        if not isinstance(value, bool):
            raise ValueError(f"remote_control: expected true or false, got {value!r}")
        self._robot.remote = value

    def _set_unlock_delay(self, value: Any) -> None:
        self._robot.unlock_delay = _number(value, "unlock_delay")

    def _set_object(self, value: Any) -> None:
        if value is not None and not (type(value) is int and 0 <= value <= 255):
            raise ValueError(f"object_width: expected an integer 0 to 255 or null, got {value!r}")
        self._links.set_object(value)


class _FaultConnection(LineConnection):
    def __init__(self, listener: Listener, server: FaultServer) -> None:
        super().__init__(listener)
        self._server = server

    def answer(self, line: str) -> str | None:
        return json.dumps(self._server.reply(line)) if line else None


def _choice(choices: dict[str, Callable[..., Any]], name: Any, what: str) -> Callable[..., Any]:
    if not isinstance(name, str) or name not in choices:
        raise ValueError(f"{what}: expected one of {', '.join(choices)}, got {name!r}")
    return choices[name]


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: expected a number, got {value!r}")
    if not 0.0 <= value <= LONGEST_FAULT:
        raise ValueError(f"{name}: expected 0 to {LONGEST_FAULT:g} s, got {value!r}")
    return float(value)


def _seconds(request: dict[str, Any]) -> float:
    return _number(request.get("seconds"), "seconds")


def _six_numbers(value: Any) -> np.ndarray:
    if not isinstance(value, list) or len(value) != 6:
        raise ValueError(f"value: expected six numbers, got {value!r}")
    for number in value:
        finite = isinstance(number, int | float) and not isinstance(number, bool)
        if not finite or not abs(number) < 1e9:
            raise ValueError(f"value: expected six numbers within 1e9, got {value!r}")
    return np.array(value, dtype=np.float64)
