"""The parent's side of the streaming process: start it, keep it alive or kill it, say what died."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from dlo_gym.exceptions import DeviceError
from sim2real.ur5e import shared_state
from sim2real.ur5e.dashboard import stop_program
from sim2real.ur5e.kinematics import pose_numbers
from sim2real.ur5e.setpoint import to_pose_vector
from sim2real.ur5e.settings import UR5eSettings
from sim2real.ur5e.shared_state import SharedState, Status

_PROJECT = Path(__file__).parents[2]
_HEARTBEAT_PERIOD = 0.02  # [s]
_STOP_ANSWER = 0.25  # [s] that a stop may stay unanswered before the dashboard is asked
_HANG_AFTER = 0.5  # [s] without a cycle

_ADVICE = {
    "start": "the client process did not come up; is this machine overloaded?",
    "receive": (
        "the controller accepts connections but sends no data; restart it, and look for another"
        " client that holds its RTDE interface"
    ),
    "control": (
        "its data come, but the control program did not start; put the robot in remote control,"
        " power on, brakes released, and see the pendant's log"
    ),
    "tool": "the control program runs but does not answer; see the pendant's log",
}


class StreamingProcess:
    """One child process and a thread that gives it a heartbeat and watches over it.

    When the child dies or leaves a stop unanswered, the thread ends the robot's program through
    the dashboard, so the arm halts even if nobody calls.

    Args:
        name: of the arm, for messages.
        settings: of the arm.
        control: whether the arm is to be moved.

    Raises:
        DeviceError: when no connection is made within ``settings.connect_timeout``.
    """

    def __init__(self, name: str, settings: UR5eSettings, *, control: bool) -> None:
        self.name, self.settings, self.control = name, settings, control
        self._log = tempfile.TemporaryFile("a+b")  # noqa: SIM115 (closed in kill)
        descriptor = SharedState.create()
        self.memory = SharedState(descriptor)
        self.memory.beat(time.monotonic())
        self._link, theirs = socket.socketpair()
        request = _child_settings(settings, control, descriptor, theirs.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim2real.ur5e.process", json.dumps(request)],
            pass_fds=(descriptor, theirs.fileno()),
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,  # a Ctrl-C in the terminal is the parent's to handle
        )
        os.close(descriptor)
        theirs.close()
        self._received = b""
        self._ending = threading.Event()
        self._stop_sent = (0, 0.0)
        self._dashboard_asked = False
        self._watch = threading.Thread(target=self._watch_over, name=f"{name} arm", daemon=True)
        self._watch.start()
        try:
            self._await_connection()
        except BaseException:
            self.kill()
            raise

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._process.pid

    def _await_connection(self) -> None:
        settings = self.settings
        reply = self.await_reply(time.monotonic() + settings.connect_timeout)
        if reply is None:
            phase = self.memory.status().text or "start"
            raise DeviceError(
                f"{self.name} arm at {settings.address}: no connection within"
                f" {settings.connect_timeout:g} s: {_ADVICE.get(phase, phase)}"
            )
        if "failed" in reply:
            raise DeviceError(
                f"{self.name} arm at {settings.address}: ur_rtde cannot connect:"
                f" {reply['failed']}; check the address, the cable and that the robot is in remote"
                " control"
            )

    def await_reply(self, deadline: float) -> dict[str, Any] | None:
        """The child's next reply; None at the deadline (monotonic).

        Raises:
            DeviceError: when the child died meanwhile.
        """
        while b"\n" not in self._received:
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                return None
            self._link.settimeout(min(remaining, 0.05))
            try:
                received = self._link.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                received = b""
            if not received:
                self._wait_for_exit()
                raise DeviceError(self.trouble() or f"{self.name} arm: its client process ended")
            self._received += received
        line, _, self._received = self._received.partition(b"\n")
        return json.loads(line)

    def _wait_for_exit(self) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)

    def request(self, **request: Any) -> None:
        """Send a request; a dead child shows at the next reply."""
        with contextlib.suppress(OSError):
            self._link.sendall(json.dumps(request).encode() + b"\n")

    def trouble(self) -> str:
        """What is wrong with child or link, with what to do; empty when all is well."""
        where = f"{self.name} arm at {self.settings.address}"
        status = self.memory.status()
        if status.state == shared_state.HALTED:
            return f"{where} was halted: {status.text}; call recover()"
        code = self._process.poll()
        if code is not None:
            how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
            words = self._last_words()
            return f"{where}: its client process ended by {how}{words}; call recover()"
        now = time.monotonic()
        if status.state != shared_state.STARTING and (
            now - self.memory.progress_time > _HANG_AFTER
        ):
            silence = now - self.memory.progress_time
            return f"{where}: its client process has hung for {silence:.2f} s; call recover()"
        return ""

    def status(self) -> Status:
        """What the child does."""
        return self.memory.status()

    def _last_words(self) -> str:
        """What ur_rtde printed last, for a message."""
        with contextlib.suppress(OSError, ValueError):
            size = self._log.seek(0, os.SEEK_END)
            self._log.seek(max(0, size - 2000))
            lines = self._log.read().decode(errors="replace").strip().splitlines()
            if lines:
                return f" (its last words: {lines[-1][:200]})"
        return ""

    def ask_stop(self) -> None:
        """Have the arm decelerated; returns at once, the watching thread sees to it."""
        self._stop_sent = (self.memory.ask_stop(), time.monotonic())

    def _watch_over(self) -> None:
        while not self._ending.wait(_HEARTBEAT_PERIOD):
            now = time.monotonic()
            self.memory.beat(now)
            number, asked_at = self._stop_sent
            unanswered = number > self.memory.stops_done and now - asked_at > _STOP_ANSWER
            dead = self._process.poll() is not None
            if self.control and (unanswered or dead) and not self._dashboard_asked:
                self._dashboard_asked = True
                stop_program(self.settings.address, timeout=0.3)

    def close(self) -> None:
        """Have the child stop the arm and leave; kill it if it does not within 1 s."""
        self.request(do="exit")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self.kill()

    def kill(self) -> None:
        """End the child at once; a program it left running is ended through the dashboard."""
        self._ending.set()
        if self._watch is not threading.current_thread():
            self._watch.join(2.0)
        left_by_itself = self._process.poll() == 0
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        if self.control and not left_by_itself:
            stop_program(self.settings.address, timeout=0.3)
        self._link.close()
        self._log.close()


def _child_settings(
    settings: UR5eSettings, control: bool, memory: int, link: int
) -> dict[str, Any]:
    return {
        "parent": os.getpid(),
        "memory": memory,
        "socket": link,
        "control": control,
        "address": settings.address,
        "reading_hz": settings.reading_hz,
        "period": 1.0 / settings.frequency_hz,
        "lookahead_time": settings.lookahead_time,
        "gain": settings.gain,
        "tcp": to_pose_vector(pose_numbers(settings.T_flange_tcp)),
        "payload_mass": settings.payload_mass,
        "payload_centre": settings.payload_centre_of_mass,
        "stale_after": settings.stale_after,
        "heartbeat_timeout": settings.heartbeat_timeout,
        "connect_timeout": settings.connect_timeout,
        "watchdog_hz": settings.watchdog_hz,
        "stop_deceleration": settings.stop_deceleration,
        "joint_stop_deceleration": settings.joint_stop_deceleration,
        "limits": vars(settings.setpoint_limits),
    }


def _environment() -> dict[str, str]:
    """This process's, with the project on the path however it was found here."""
    path = os.pathsep.join(filter(None, [str(_PROJECT), os.environ.get("PYTHONPATH", "")]))
    return {**os.environ, "PYTHONPATH": path}
