"""One emulated UR5e controller as a process of its own.

From a shell: ``python -m sim2real.emulator.process --address 127.0.0.2``; from Python the context
manager ``EmulatedController``. The process must be one of its own because ur_rtde's constructors
hold the interpreter's lock while they wait for the robot.
"""

import argparse
import asyncio
import gc
import logging
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from dlo_gym.exceptions import DeviceError
from sim2real.emulator import kinematics
from sim2real.emulator.controller import Controller, ControllerOptions
from sim2real.emulator.dashboard import DashboardServer
from sim2real.emulator.faults import FaultServer
from sim2real.emulator.gripper_server import GripperServer
from sim2real.emulator.kinematics import Array
from sim2real.emulator.loopback import ask, check_loopback
from sim2real.emulator.motion import TICK, Motion, MotionFault, MotionLimits
from sim2real.emulator.rtde_server import RtdeServer
from sim2real.emulator.script_server import ScriptServer
from sim2real.emulator.ticker import Ticker
from sim2real.realtime import ask_for_real_time

# Elbow and wrist up, the tool in front of the base; the default start pose of the left arm.
DEFAULT_JOINTS = (2.21, -1.61, 2.30, -0.68, 0.64, 1.57)
DEFAULT_TCP = (0.0, 0.0, 0.163, 0.0, 0.0, 0.0)
_START_TIMEOUT = 60.0  # s; the first start on a machine compiles the kernels


class Emulator:
    """A controller with its ports, driven by one loop.

    Args:
        address: in 127.0.0.0/8.
        controller: the robot.

    Raises:
        ValueError: on another address.
    """

    def __init__(self, address: str, controller: Controller) -> None:
        self.controller = controller
        self._rtde = RtdeServer(address, controller)
        self._gripper = GripperServer(address)
        self._robot_ports = [
            DashboardServer(address, controller).listener,
            ScriptServer(address, controller).listener,
            self._rtde.listener,
            self._gripper.listener,
        ]
        self._control = FaultServer(address, controller, self).listener
        self._ticker = Ticker(TICK, self._tick)
        self._reopening: asyncio.Task[None] | None = None
        self._reopen_at = -math.inf

    async def run(self, parent: int | None = None) -> None:
        """Serve until a signal ends it, or until ``parent`` is no longer the parent process."""
        stopped = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, stopped.set)
        await self._open()
        await self._control.open()  # the last: whoever waits for it finds the others open
        self._ticker.start()
        while not stopped.is_set() and (parent is None or os.getppid() == parent):
            try:
                await asyncio.wait_for(stopped.wait(), 0.25)
            except TimeoutError:
                continue

    async def _open(self) -> None:
        for port in self._robot_ports:
            await port.open()

    def _tick(self) -> None:
        self.controller.tick()
        self._rtde.stream(time.monotonic())

    # What faults do

    def freeze(self, seconds: float) -> None:
        self._rtde.paused_until = time.monotonic() + seconds

    def drop(self) -> None:
        self._rtde.listener.drop()

    def refuse(self, seconds: float) -> None:
        for port in self._robot_ports:
            port.refuse()
        self._reopen_at = time.monotonic() + seconds
        if self._reopening is None or self._reopening.done():
            self._reopening = asyncio.get_running_loop().create_task(self._reopen())

    async def _reopen(self) -> None:
        while time.monotonic() < self._reopen_at:
            await asyncio.sleep(0.01)
        await self._open()

    def mute(self) -> None:
        self._rtde.mute = True

    def clear(self) -> None:
        self._rtde.mute = False
        self._rtde.paused_until = -math.inf
        self._reopen_at = -math.inf

    def timing(self) -> dict[str, Any]:
        return self._ticker.timing()

    def state(self) -> dict[str, Any]:
        gripper = self._gripper.gripper.state()
        return {**self.controller.state(), "gripper": gripper, "pid": os.getpid()}

    def set_object(self, width: int | None) -> None:
        self._gripper.gripper.set_object(width)


class EmulatedController:
    """Starts an emulated controller and ends it with the ``with`` block.

    Args:
        address: in 127.0.0.0/8; the ports are the robot's own, so every controller needs its own.
        joint_angles: (6,) at the start [rad]; a default pose when omitted.
        tcp: (6,) pose vector of the tool centre point on the flange [m], [rad].
        servo_lag: time constant of servoj [s].
        unlock_delay: before a protective stop can be unlocked [s]; 5 on the robot.
        force_limit: of the force at the TCP before a protective stop [N].
        log: where the process writes its log; nowhere when omitted.

    Attributes:
        pid: of the process, once started.

    Raises:
        ValueError: on an address elsewhere or settings that are no numbers in range.
    """

    def __init__(
        self,
        address: str,
        *,
        joint_angles: Sequence[float] | Array | None = None,
        tcp: Sequence[float] | Array = DEFAULT_TCP,
        servo_lag: float = MotionLimits.servo_lag,
        unlock_delay: float = ControllerOptions.unlock_delay,
        force_limit: float = ControllerOptions.force_limit,
        log: IO[Any] | None = None,
    ) -> None:
        self.address = check_loopback(address)
        joints = DEFAULT_JOINTS if joint_angles is None else joint_angles
        self._arguments = [
            *("--address", address),
            *("--joints", *_six(joints, "joint_angles")),
            *("--tcp", *_six(tcp, "tcp")),
            *("--servo-lag", repr(_not_negative(servo_lag, "servo_lag"))),
            *("--unlock-delay", repr(_not_negative(unlock_delay, "unlock_delay"))),
            *("--force-limit", repr(_not_negative(force_limit, "force_limit"))),
        ]
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """The process's number.

        Raises:
            DeviceError: if it has not been started.
        """
        if self._process is None:
            raise DeviceError(f"the emulated controller at {self.address} is not running")
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start the process and wait until it listens.

        Raises:
            DeviceError: if it ends or does not listen in time.
        """
        if self.alive:
            return
        log = subprocess.DEVNULL if self._log is None else self._log
        # The child compares its parent with ours, not with what it has when it gets to ask.
        command = [sys.executable, "-m", "sim2real.emulator.process", *self._arguments]
        self._process = subprocess.Popen(
            [*command, "--parent", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            # Linux schedules by session: in its starter's, a busy starter would make it late.
            start_new_session=True,
        )
        until = time.monotonic() + _START_TIMEOUT
        try:
            while not self._listens():
                if not self.alive or time.monotonic() > until:
                    raise DeviceError(
                        f"the emulated controller at {self.address} does not start; is another"
                        " one running there?"
                    )
                time.sleep(0.02)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the process; stopping twice does no harm."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(3.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def fault(self, name: str, **details: Any) -> dict[str, Any]:
        """Inject a fault, see ``sim2real.emulator.faults``; raises as ``command`` does."""
        if name == "crash":
            try:
                return self.command({"fault": name, **details})
            except DeviceError:
                return {"ok": True}
        return self.command({"fault": name, **details})

    def state(self) -> dict[str, Any]:
        """What the emulator says of itself."""
        return self.command({"get": "state"})

    def command(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send an object to the control port and return the reply.

        Raises:
            ValueError: if the emulator refuses it.
            DeviceError: if it does not answer within 5 s.
        """
        return ask(self.address, request, timeout=5.0)

    def _listens(self) -> bool:
        """Whether this process answers, not another one that has the address."""
        try:
            return self.state()["pid"] == self.pid
        except (DeviceError, KeyError, ValueError):
            return False


def _six(values: Sequence[float] | Array, name: str) -> list[str]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected six finite numbers, got {values}")
    return [repr(value) for value in array.tolist()]


def _not_negative(value: float, name: str) -> float:
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"{name}: expected a finite number, at least 0, got {value}")
    return float(value)


def _compile(controller: Controller) -> None:
    """Run every kernel once, so that none is compiled or loaded in a tick."""
    limits = controller.options.limits
    motion = Motion(np.array(DEFAULT_JOINTS), controller.motion.T_flange_tcp, limits)
    start = kinematics.forward(motion.q, motion.T_flange_tcp)
    try:
        motion.servo_tool(start)
        motion.step()
        motion.speed_joints(np.full(6, 0.1), 1.0)
        motion.step()
        motion.speed_tool(np.full(6, 0.01), 1.0)
        motion.step()
        motion.move_tool(start, 0.1, 1.0)
        for _ in range(50):
            motion.step()
        motion.move_joints(motion.q + 0.001, 0.1, 1.0)
        motion.step()
    except MotionFault as fault:
        raise RuntimeError("the kernels do not work") from fault
    kinematics.inverse_nearest(start, motion.T_flange_tcp, motion.q)
    controller.tick()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one emulated controller until SIGTERM, SIGINT or the end of the parent process."""
    parser = argparse.ArgumentParser(
        prog="python -m sim2real.emulator.process", description=(__doc__ or "").splitlines()[0]
    )
    add = parser.add_argument
    numbers: dict[str, Any] = {"nargs": 6, "type": float, "metavar": "X"}
    add("--address", default="127.0.0.2", help="loopback address to listen on")
    add("--joints", **numbers, default=DEFAULT_JOINTS, help="joint angles at the start [rad]")
    add("--tcp", **numbers, default=DEFAULT_TCP, help="tool centre point, a pose vector")
    add("--servo-lag", type=float, default=MotionLimits.servo_lag, help="of servoj [s]")
    add("--unlock-delay", type=float, default=ControllerOptions.unlock_delay, help="[s]")
    add("--force-limit", type=float, default=ControllerOptions.force_limit, help="[N]")
    add("--parent", type=int, default=os.getppid(), help="end with this parent process")
    add("--log-level", default="INFO")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=options.log_level, format="%(asctime)s %(name)s %(message)s")
    limits = MotionLimits(servo_lag=max(options.servo_lag, TICK))
    settings = ControllerOptions(
        limits=limits, unlock_delay=options.unlock_delay, force_limit=options.force_limit
    )
    controller = Controller(np.array(options.joints), np.array(options.tcp), settings)
    emulator = Emulator(options.address, controller)
    _compile(controller)
    gc.collect()
    gc.freeze()
    ask_for_real_time()
    asyncio.run(emulator.run(options.parent))


if __name__ == "__main__":
    main()
