"""The child process that streams to one UR5e: ``python -m sim2real.ur5e.process SETTINGS``.

It alone loads ur_rtde, so that a crash or hang of that library costs this process and not the
control program. Started by ``sim2real.ur5e.child``, which shares memory (``shared_state``) and a
socket (JSON lines: connection, ``move_to``, exit) with it.

The robot comes to rest when:

- the setpoints reach their target and no new one came: it holds there;
- a stop is asked for, or the parent's heartbeat is older than allowed: ``servoStop``;
- the robot's data stay away or a link closes: the dashboard's ``stop``, and this process ends;
- the robot's safety system stops it: the program is ended too, because a paused program would
  continue the old motion when the stop is released;
- this process dies or hangs: the controller's own watchdog ends the program. A hang ends in death,
  since the kernel sends an alarm when the loop does not come round.
"""

import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from sim2real.realtime import ask_for_real_time
from sim2real.ur5e import shared_state
from sim2real.ur5e.dashboard import stop_program
from sim2real.ur5e.rtde_client import RtdeClient
from sim2real.ur5e.setpoint import (
    JointSetpoints,
    PoseSetpoints,
    SetpointLimits,
    from_pose_vector,
)
from sim2real.ur5e.shared_state import RawReading, SharedState, Status

HANG_LIMIT = 2.0  # [s] without coming round, then the kernel ends this process
ANSWER_LIMIT = 1.5  # [s] for a stop or the start of a move
EXIT_HALTED, EXIT_REFUSED = 3, 4
SAFETY_NAMES = {
    2: "protective_stop",
    3: "recovery",
    4: "safeguard_stop",
    5: "emergency_stop",
    6: "emergency_stop",
    7: "emergency_stop",
    8: "violation",
    9: "fault",
    10: "protective_stop",
}
_MOVE_TOLERANCE = 2e-3  # [rad]
_AT_REST = 5e-3  # [rad/s]
_POLLING_SLACK_NS = 500_000
_PROGRAM_GRACE = 0.05  # [s] for a safety bit to come after the program's end that it caused
_STANDSTILL_LIMIT = 1.0  # [s] away from the goal without moving


def safety_name(bits: int, connected: bool = True) -> str:
    """The name of ``safety_status_bits``; the gravest where several are set."""
    if not connected:
        return "disconnected"
    for bit in (9, 8, 7, 6, 5, 2, 4, 3, 10):
        if bits & (1 << bit):
            return SAFETY_NAMES[bit]
    return "reduced" if bits & 2 else "normal"


class ArmProcess:
    """The loop: read, watch, stream.

    Args:
        settings: of the parent, JSON.
        memory: shared with the parent.
        link: socket to the parent.
    """

    def __init__(self, settings: dict[str, Any], memory: SharedState, link: socket.socket) -> None:
        self._settings, self._memory, self._link = settings, memory, link
        self._limits = SetpointLimits(**settings["limits"])
        self._parent = settings["parent"]
        self._state = shared_state.STARTING
        self._text, self._is_safety = "start", False
        self._setpoints: PoseSetpoints | JointSetpoints | None = None
        self._accepted = 0
        self._received = b""
        self._move: dict[str, Any] | None = None
        self._standstill_since = 0.0
        self._exit_asked = False

    def connect(self) -> None:
        """Connect and report; ends the process where that fails."""
        try:
            self._robot = RtdeClient(self._settings, self._tell_phase)
            _calm_pollers()
            reading = self._first_reading()
        except Exception as error:
            self._reply(failed=str(error))
            os._exit(EXIT_REFUSED)
        control = self._settings["control"]
        self._text = ""
        self._state = shared_state.IDLE if control else shared_state.LISTENING
        self._last_reading, self._last_news = reading, time.monotonic()
        self._playing_at = self._last_news
        self._stops_seen = self._memory.stops_done
        self._memory.progress(0, self._last_news)
        self._publish()
        self._reply(ready=True)

    def _tell_phase(self, phase: str) -> None:
        self._text = phase
        self._publish()

    def _first_reading(self) -> RawReading:
        deadline = time.monotonic() + self._settings["connect_timeout"]
        while time.monotonic() < deadline:
            # The first samples may be older than the tool that was just set.
            reading = self._robot.read()
            if reading is not None:
                self._memory.publish_reading(reading)
                return reading
            time.sleep(0.001)
        raise RuntimeError("no data came")

    def run(self) -> NoReturn:
        """Until the parent goes, asks for the exit, or the link breaks."""
        period = self._limits.period
        due, cycle = time.monotonic(), 0
        while True:
            cycle += 1
            now = time.monotonic()
            if cycle % 64 == 1:
                signal.setitimer(signal.ITIMER_REAL, HANG_LIMIT)
            self._memory.progress(cycle, now)
            self._cycle(now)
            due += period
            now = time.monotonic()
            if due > now:
                time.sleep(due - now)
            elif now - due > 10 * period:
                due = now  # a long stop in between; don't chase the lost cycles

    def _cycle(self, now: float) -> None:
        self._read(now)
        self._listen()
        if self._exit_asked or os.getppid() != self._parent:
            self.leave()
        if self._state in (shared_state.LISTENING, shared_state.HALTED):
            return
        self._watch(now)
        if self._state == shared_state.HALTED:
            return
        self._obey_stops()
        self._take_command()
        self._stream(now)

    def _read(self, now: float) -> None:
        try:
            reading = self._robot.read()
            connected = self._robot.is_connected
        except Exception as error:
            self._break_off(f"its link failed: {error}")
        if reading is not None:
            self._memory.publish_reading(reading)
            self._last_reading, self._last_news = reading, now
        elif now - self._last_news > self._settings["stale_after"]:
            self._break_off(f"the controller sent no data for {now - self._last_news:.2f} s")
        if not connected:
            self._break_off("the controller closed the link")

    def _watch(self, now: float) -> None:
        """Halt where the robot stopped, its program ended, or the parent fell silent."""
        name = safety_name(self._last_reading.safety_bits)
        if name not in ("normal", "reduced"):
            # Before the stop is released: a paused program would continue the old motion.
            stop_program(self._settings["address"], timeout=0.3)
            self._halt(f"the robot is in {name.replace('_', ' ')}", is_safety=True)
            return
        if self._last_reading.running:
            self._playing_at = now
        elif now - self._playing_at > _PROGRAM_GRACE:
            self._halt("the robot's program ended (on the pendant, or its watchdog fired)")
        if self._state in (shared_state.SERVOING, shared_state.MOVING):
            silence = now - self._memory.heartbeat
            if silence > self._settings["heartbeat_timeout"]:
                why = f"no sign of life from the controlling process for {silence:.2f} s"
                self._decelerate(why)
                self._halt(why)

    def _take_command(self) -> None:
        command = self._memory.command(self._accepted)
        if command is None or self._state == shared_state.MOVING:
            return
        self._accepted = command.number
        self._obey_stops()  # those asked for before the command
        if command.stops != self._stops_seen:
            return  # from before the last stop; it must not start the arm again
        if self._state == shared_state.IDLE or self._setpoints is None:
            # Always from where the arm really is: nothing jumps.
            reading = self._last_reading
            if len(command.target) == 6:
                self._setpoints = JointSetpoints(reading.joint_angles, self._limits)
            else:
                self._setpoints = PoseSetpoints(from_pose_vector(reading.tcp_pose), self._limits)
            self._state = shared_state.SERVOING
        self._setpoints.move_to(command.target, command.duration)

    def _stream(self, now: float) -> None:
        if self._state == shared_state.SERVOING and self._setpoints is not None:
            # False when the program has ended, which the next readings tell.
            self._call(self._robot.servo, self._setpoints.step())
        else:
            self._call(self._robot.keep_alive)
            if self._state == shared_state.MOVING:
                self._follow_move(now)
        self._publish()

    def _start_move(self, request: dict[str, Any]) -> None:
        self._obey_stops()  # those asked for before the request
        if self._state == shared_state.SERVOING:
            self._decelerate("move_to() was called")
        if self._state != shared_state.IDLE or request["stops"] != self._stops_seen:
            self._reply(move=request["number"], done=False, why=self._text or "stop() was called")
            return
        started = self._call_blocking(
            self._robot.start_move, request["joints"], request["speed"], request["acceleration"]
        )
        if not started:
            self._reply(move=request["number"], done=False, why="the robot's program refused it")
            return
        self._move, self._state = request, shared_state.MOVING
        self._standstill_since = time.monotonic()

    def _follow_move(self, now: float) -> None:
        assert self._move is not None
        reading = self._last_reading
        away = max(
            abs(a - b) for a, b in zip(reading.joint_angles, self._move["joints"], strict=True)
        )
        if max(map(abs, reading.joint_velocities)) > _AT_REST:
            self._standstill_since = now
        elif away < _MOVE_TOLERANCE:
            self._end_move(True, "")
        elif now - self._standstill_since > _STANDSTILL_LIMIT:
            self._end_move(False, f"it stands {away:.3f} rad away from the goal")

    def _end_move(self, done: bool, why: str) -> None:
        if self._move is not None:
            self._reply(move=self._move["number"], done=done, why=why)
        self._move = None
        if self._state == shared_state.MOVING:
            self._state = shared_state.IDLE

    def _obey_stops(self) -> None:
        stops_asked = self._memory.stops_asked
        if stops_asked != self._stops_seen:
            self._stops_seen = stops_asked
            self._decelerate("stop() was called")
            self._memory.acknowledge_stop(stops_asked)

    def _decelerate(self, why: str) -> None:
        """To rest under the program's control; it stays ready for the next motion."""
        if self._state == shared_state.SERVOING:
            self._call_blocking(self._robot.stop_servo)
        elif self._state == shared_state.MOVING:
            self._call_blocking(self._robot.stop_move)
            self._end_move(False, why)
        if self._state in (shared_state.SERVOING, shared_state.MOVING):
            self._state = shared_state.IDLE
        self._setpoints = None
        self._publish()

    def _halt(self, why: str, is_safety: bool = False) -> None:
        """No motion until the parent restarts this process; readings go on."""
        self._state, self._text, self._is_safety = shared_state.HALTED, why, is_safety
        self._setpoints = None
        self._memory.acknowledge_stop(self._memory.stops_asked)
        self._publish()
        self._end_move(False, why)

    def _break_off(self, why: str) -> NoReturn:
        """The link cannot be trusted: halt the robot from outside, end before ur_rtde crashes."""
        self._state, self._text = shared_state.HALTED, why
        self._publish()
        if self._settings["control"]:
            stop_program(self._settings["address"], timeout=0.3)
        self._end_move(False, why)
        os._exit(EXIT_HALTED)

    def leave(self) -> NoReturn:
        """Stop the arm, end the robot's program, end this process."""
        signal.setitimer(signal.ITIMER_REAL, HANG_LIMIT)
        if self._settings["control"] and self._state != shared_state.HALTED:
            self._decelerate("the connection was closed")
            self._call_blocking(self._robot.stop_script)
        os._exit(0)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            self._break_off(f"its link failed: {error}")

    def _call_blocking(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A call that waits for the robot's answer; meanwhile readings and their watch go on."""
        result: list[Any] = []
        worker = threading.Thread(
            target=lambda: result.append(self._call(function, *arguments)), daemon=True
        )
        began = now = time.monotonic()
        worker.start()
        while worker.is_alive():
            worker.join(self._limits.period)
            now = time.monotonic()
            self._memory.progress(self._memory.cycles + 1, now)
            self._read(now)
            if now - began > ANSWER_LIMIT:
                self._break_off(f"the robot's program gave no answer for {now - began:.1f} s")
        return result[0]

    def _publish(self) -> None:
        setpoint = () if self._setpoints is None else self._setpoints.setpoint
        self._memory.publish_status(
            Status(self._state, self._accepted, self._is_safety, setpoint, self._text)
        )

    def _listen(self) -> None:
        try:
            received = self._link.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self._exit_asked = True
            return
        *lines, self._received = (self._received + received).split(b"\n")
        for request in map(json.loads, lines):
            if request["do"] == "exit":
                self._exit_asked = True
            elif request["do"] == "move":
                self._start_move(request)

    def _reply(self, **reply: Any) -> None:
        try:
            self._link.sendall(json.dumps(reply).encode() + b"\n")
        except OSError:
            self._exit_asked = True

    def ask_exit(self, signal_number: int, frame: FrameType | None) -> None:
        """Signal handler: leave at the next cycle."""
        self._exit_asked = True


def _calm_pollers() -> None:
    """Have ur_rtde's threads poll a third as often.

    Each looks at its socket every 0.1 ms, which takes a fifth of a processor; where it may, ur_rtde
    gives itself real-time priority too, so two arms would starve a small machine. At ordinary
    priority a timer slack stretches their sleep. This thread, which streams, keeps its priority.
    """
    threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in set(threads) - {threading.get_native_id()}:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
            Path(f"/proc/{thread}/timerslack_ns").write_text(f"{_POLLING_SLACK_NS}")


def main() -> None:
    """Entry point of the child; the argument is the parent's settings as JSON."""
    settings = json.loads(sys.argv[1])
    # Ends this process even where ur_rtde hangs with Python's lock held.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, settings["connect_timeout"] + 1.0)
    with contextlib.suppress(OSError):
        os.nice(-10)  # where permitted: others can wait, a robot cannot
    link = socket.socket(fileno=settings["socket"])
    link.setblocking(False)
    ask_for_real_time()  # before ur_rtde starts its threads, which take after this one
    arm = ArmProcess(settings, SharedState(settings["memory"]), link)
    arm.connect()
    signal.signal(signal.SIGTERM, arm.ask_exit)
    signal.signal(signal.SIGINT, arm.ask_exit)
    arm.run()


if __name__ == "__main__":
    main()
