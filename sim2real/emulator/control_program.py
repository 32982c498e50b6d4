"""The URScript program that ur_rtde uploads, as a state machine in Python.

ur_rtde (1.6.5) steers a robot by a program of its own that reads commands from input registers and
answers in output registers. This is that program's main loop and its commands, one ``step`` per
controller cycle. Register offsets are read out of the uploaded text.

Commands of force mode, freedrive, contact and torque control are accepted and do nothing.
"""

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim2real.emulator import kinematics
from sim2real.emulator.controller import Controller
from sim2real.emulator.kinematics import Array
from sim2real.emulator.motion import TICK, Mode, MotionFault

_READY, _DONE = 1, 2
_STOP_SCRIPT = 255
# Executed in every cycle in which their code stands in the command register.
_REALTIME = frozenset((24, 11, 9, 10, 6, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71))
_OFFSET = r"reg_offset_{}\s*=\s*(?:#[^\n]*\n)?\s*(\d+)"
_PATH_MOVE = re.compile(
    r"^\s*move([jlp])\((p?)\[([^\]]*)\]\s*,\s*a\s*=\s*([-\d.e]+)\s*,\s*v\s*=\s*([-\d.e]+)", re.M
)


def recognised(script: str) -> bool:
    """Whether a script is ur_rtde's control program, by the registers it lives on."""
    return all(
        mark in script
        for mark in ("def rtde_cmd():", "def process_cmd(cmd):", "signal_done_with_cmd()")
    )


@dataclass(frozen=True, eq=False)
class _PathMove:
    """One move of a path."""

    linear: bool
    pose: bool
    goal: Array
    speed: float
    acceleration: float


class ControlProgram:
    """ur_rtde's program on one controller.

    Args:
        controller: that it runs on.
        script: the uploaded text.

    Raises:
        ValueError: if the register offset is none the program can have.
    """

    name = "rtde_control"

    def __init__(self, controller: Controller, script: str) -> None:
        self._robot = controller
        self._integers = _offset(script, "int")
        self._floats = _offset(script, "float")
        self._path = _read_path(script)
        self._outputs = controller.image.registers()[self._floats :]
        self._executing = False
        self._waiting: Callable[[], None] | None = None  # what follows when the arm stands
        self._async = False  # whether an asynchronous motion is under way
        self._queue: deque[_PathMove] = deque()
        self._async_count = self._async_id = 0
        self._stops_by_tool = False
        self._servo_registers: tuple[float, ...] | None = None
        self._commands = self._table()
        self._begun = False
        self._written: dict[int, int] = {}  # of output integers

    # Main loop

    def step(self) -> bool:
        """One cycle; False after the stop command."""
        if not self._begun:
            self._begun = True
            self._signal_async(-1)
            self._write(0, _READY)
        if self._async and self._arrived():
            self._async = False
            self._signal_async(-1)
        if self._waiting is not None:
            if not self._arrived():
                return True
            finish, self._waiting = self._waiting, None
            finish()
        command = self._robot.inputs.integers[self._integers]
        if command in _REALTIME:
            self._run(command)
            self._write(0, _READY)
        elif command == 0:
            self._executing = False
            self._write(0, _READY)
        elif not self._executing:
            self._executing = True
            if command == _STOP_SCRIPT:
                return False
            self._run(command)
            if self._waiting is None:
                self._write(0, _DONE)
        return True

    def _run(self, command: int) -> None:
        action = self._commands.get(command)
        if action is not None:
            action()
        elif command not in _REALTIME:
            self._robot.note(f"rtde_control: command {command} has no effect here")

    def _arrived(self) -> bool:
        if self._robot.motion.mode is not Mode.HOLD:
            return False
        if self._queue:
            self._start(self._queue.popleft())
            return self._robot.motion.mode is Mode.HOLD and not self._queue
        return True

    def _table(self) -> dict[int, Callable[[], None]]:
        robot = self._robot
        return {
            1: lambda: self._move(linear=False, pose=False),
            2: lambda: self._move(linear=False, pose=True),
            3: lambda: self._move(linear=True, pose=True),
            4: lambda: self._move(linear=True, pose=False),
            8: robot.zero_force,
            9: lambda: robot.motion.speed_joints(self._vector(0), self._float(6)),
            10: lambda: robot.motion.speed_tool(self._vector(0), self._float(6)),
            11: self._servo,
            15: self._stop_speed,
            16: lambda: self._stop(by_tool=True),
            17: self._set_payload,
            24: self._servo,
            25: lambda: self._write(1, 0),
            26: lambda: self._answer([TICK]),
            27: lambda: self._answer(robot.history(self._integer(1))),
            28: lambda: self._answer(robot.waypoint),
            29: self._set_tcp,
            30: lambda: self._inverse_kinematics(self._vector(6)),
            31: lambda: robot.protective_stop("asked for by the program"),
            33: self._stop_move,
            34: self._stop_move,
            35: self._set_watchdog,
            36: lambda: self._write(1, robot.within_limits(self._solution(self._vector(0)))),
            37: lambda: self._write(1, robot.within_limits(self._vector(0))),
            38: lambda: self._answer(np.zeros(6)),
            39: self._pose_trans,
            40: lambda: self._answer(robot.tcp),
            41: lambda: robot.motion.speed_tool(self._vector(0), self._float(7)),
            42: lambda: self._stop(by_tool=True, deceleration=1.2),
            43: lambda: self._forward_kinematics(robot.motion.q, robot.tcp),
            44: lambda: self._forward_kinematics(self._vector(0), self._vector(6)),
            45: self._move_path,
            46: lambda: self._inverse_kinematics(robot.motion.q),
            47: lambda: self._write(1, robot.motion.standing),
            51: lambda: self._write(1, 0),
            54: lambda: self._write(1, 0),
            58: lambda: self._forward_kinematics(robot.motion.q, np.zeros(6)),
            60: lambda: self._write(1, self._solution(self._vector(0)) is not None),
            61: lambda: self._write(
                1, self._solution(self._vector(0), self._vector(6)) is not None
            ),
            63: lambda: self._write(1, 0),
            64: lambda: self._write(1, 0),
            65: self._set_payload,
        }

    # Motion

    def _servo(self) -> None:
        """servoj and servol: the target is solved once, until the registers change."""
        base = self._floats
        command = self._robot.inputs.integers[self._integers]
        registers = (command, *self._robot.inputs.floats[base : base + 6])
        motion = self._robot.motion
        if registers == self._servo_registers and motion.mode is Mode.SERVO:
            return
        self._cancel_async()
        target = np.array(registers[1:])
        if command == 11:
            motion.servo_joints(target)
        else:
            _check_finite(target)
            motion.servo_tool(kinematics.transform(target))
        self._servo_registers = registers

    def _move(self, *, linear: bool, pose: bool) -> None:
        move = _PathMove(linear, pose, self._vector(0), self._float(6), self._float(7))
        asynchronous = self._integer(1) == 1
        self._cancel_async()
        self._start(move)
        self._wait(asynchronous)

    def _start(self, move: _PathMove) -> None:
        robot = self._robot
        _check_finite(move.goal)
        goal = kinematics.transform(move.goal) if move.pose else None
        if move.linear:
            if goal is None:
                goal = kinematics.forward(move.goal, robot.motion.T_flange_tcp)
            robot.waypoint = kinematics.vector(goal)
            robot.motion.move_tool(goal, move.speed, move.acceleration)
            return
        joints = move.goal if goal is None else self._solution(move.goal)
        if joints is None:
            raise MotionFault("no inverse kinematics for the target pose")
        robot.waypoint = kinematics.vector(kinematics.forward(joints, robot.motion.T_flange_tcp))
        robot.motion.move_joints(joints, move.speed, move.acceleration)

    def _move_path(self) -> None:
        asynchronous = self._integer(1) == 1
        self._cancel_async()
        self._queue.extend(self._path)
        if self._queue:
            self._start(self._queue.popleft())
        self._wait(asynchronous)

    def _wait(self, asynchronous: bool) -> None:
        """Go on when the arm has arrived, or at once with the motion's progress told apart."""
        if asynchronous:
            self._async = True
            self._signal_async(0)
        else:
            self._waiting = lambda: self._write(0, _DONE)

    def _stop_speed(self) -> None:
        self._stop(by_tool=self._robot.motion.mode is Mode.SPEED_TOOL)

    def _stop(self, *, by_tool: bool, deceleration: float | None = None) -> None:
        rate = self._float(0) if deceleration is None else deceleration
        self._robot.motion.stop(rate, by_tool=by_tool)
        self._wait(asynchronous=False)

    def _stop_move(self) -> None:
        """stopL and stopJ. The program mixes them up, and so does this.

        Its synchronous branch looks at a variable that only an asynchronous stop sets: it is
        stopj until there was one, stopl ever after, whatever was asked for.
        """
        asynchronous = self._integer(1) == 1
        self._cancel_async()
        self._stops_by_tool |= asynchronous
        self._robot.motion.stop(self._float(0), by_tool=self._stops_by_tool)
        self._wait(asynchronous)

    def _cancel_async(self) -> None:
        self._queue.clear()
        self._servo_registers = None
        if self._async:
            self._async = False
            self._signal_async(-1)

    # Questions and settings

    def _solution(self, pose: Array, near: Array | None = None) -> Array | None:
        if not np.isfinite(pose).all():
            return None
        robot = self._robot
        near = robot.motion.q if near is None else near
        return kinematics.inverse_nearest(
            kinematics.transform(pose), robot.motion.T_flange_tcp, near
        )

    def _inverse_kinematics(self, near: Array) -> None:
        joints = self._solution(self._vector(0), near)
        if joints is None:
            self._robot.popups.append("get_inverse_kin: no solution")
            self._robot.note("get_inverse_kin: no solution")
            joints = np.full(6, np.nan)
        self._answer(joints)

    def _forward_kinematics(self, joints: Array, tcp: Array) -> None:
        self._answer(kinematics.vector(kinematics.forward(joints, kinematics.transform(tcp))))

    def _pose_trans(self) -> None:
        product = kinematics.transform(self._vector(0)) @ kinematics.transform(self._vector(6))
        self._answer(kinematics.vector(product))

    def _set_tcp(self) -> None:
        tcp = self._vector(0)
        _check_finite(tcp)
        self._robot.set_tcp(tcp)

    def _set_payload(self) -> None:
        cog = self._vector(1)[:3]
        _check_finite(np.append(cog, self._float(0)))
        self._robot.set_payload(self._float(0), cog if cog.any() else self._robot.payload_cog)

    def _set_watchdog(self) -> None:
        offset = self._integers if self._integers in (0, 24) else 0
        self._robot.set_watchdog(f"input_int_register_{offset}", self._float(0))

    # Registers

    def _float(self, index: int) -> float:
        return self._robot.inputs.floats[self._floats + index]

    def _integer(self, index: int) -> int:
        return self._robot.inputs.integers[self._integers + index]

    def _vector(self, index: int) -> Array:
        start = self._floats + index
        return np.array(self._robot.inputs.floats[start : start + 6])

    def _answer(self, values: Array | list[float]) -> None:
        self._outputs[: len(values)] = values

    def _write(self, index: int, value: int) -> None:
        if self._written.get(index) == value:
            return
        self._written[index] = value
        name = f"output_int_register_{self._integers + index}"
        self._robot.image.set_integer(name, value)

    def _signal_async(self, value: int) -> None:
        """Write the progress register: operation id, change count, running bit, progress."""
        self._async_count = (self._async_count + 1) % 128
        if value == 0:
            self._async_id = (self._async_id + 1) % 128
        word = self._async_count << 16 | self._async_id << 24
        if value >= 0:
            word |= min(value, 32767) | 32768
        self._write(2, word)


def _offset(script: str, kind: str) -> int:
    found = re.search(_OFFSET.format(kind), script)
    offset = int(found.group(1)) if found else 0
    if offset not in (0, 24):
        raise ValueError(f"reg_offset_{kind}: expected 0 or 24, got {offset}")
    return offset


def _read_path(script: str) -> list[_PathMove]:
    """The moves injected into the program's ``exec_move_path``; blends are ignored."""
    start = script.find("def exec_move_path():")
    body = script[start : script.find("\n    end", start)] if start >= 0 else ""
    moves = []
    for kind, pose, numbers, acceleration, speed in _PATH_MOVE.findall(body):
        goal = np.array([float(number) for number in numbers.split(",")])
        if goal.shape == (6,):
            moves.append(
                _PathMove(kind != "j", bool(pose), goal, float(speed), float(acceleration))
            )
    return moves


def _check_finite(values: Array) -> None:
    if not np.isfinite(values).all():
        raise MotionFault("a target is not a number")
