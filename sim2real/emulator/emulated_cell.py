"""A whole emulated cell: two controllers and the world behind them, started as one."""

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import SIDES
from sim2real.config import CellConfig
from sim2real.emulator.emulated_world import EmulatedWorld
from sim2real.emulator.loopback import ask
from sim2real.emulator.process import EmulatedController
from sim2real.emulator.rtde_reader import PORT as RTDE_PORT
from sim2real.emulator.truth import WorldTruth
from sim2real.emulator.world_config import Gripper, WorldConfig

PLACED_WITHIN = 1e-4  # of the joint angles asked for [rad]
_PLACE_TIMEOUT = 10.0


class EmulatedCell:
    """Two emulated UR5e that hold a simulated rod in front of rendered cameras.

    A context manager; each part is a process of its own, and all end with it.

    Args:
        config: of the world, and with it of the addresses.
        start: joint angles (2, 6) [rad] or clamp poses that the arms hold the rod at; home when
            omitted.
        world: whether there is a world behind the controllers, or just arms.
        log: where the world writes what went wrong; this process's stderr when omitted.

    Attributes:
        config: of the world.
        controllers: the controllers' processes by side, while running.
        world: the world's process.

    Raises:
        UnreachablePose: if an arm cannot hold its end of the rod at ``start``.
    """

    def __init__(
        self,
        config: WorldConfig | None = None,
        *,
        start: BoundaryPoses | ArrayLike | None = None,
        world: bool = True,
        log: IO[Any] | None = None,
    ) -> None:
        self.config = WorldConfig() if config is None else config
        self.controllers: dict[str, EmulatedController] = {}
        self.world = EmulatedWorld(self.config, log=log)
        self._with_world = world
        self._start = self._joint_angles(start)
        self._stack = ExitStack()

    @classmethod
    def of(cls, cell: CellConfig, *, start: Any = None, **options: Any) -> "EmulatedCell":
        """The emulation of a cell file, with the fields of ``WorldConfig`` in ``options`` set
        besides."""
        return cls(WorldConfig.of_cell(cell, **options), start=start)

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

    def start(self) -> None:
        """Starts everything and waits until the rod hangs at the start.

        Raises:
            DeviceError: if a part does not start, or an address is taken; none is left running
                then.
        """
        for address in self.config.controllers:
            _check_free(address)
        try:
            if self._with_world:
                self.world.launch()  # the slowest first: it starts while the controllers do
            for side, address in zip(SIDES, self.config.controllers, strict=True):
                controller = EmulatedController(address)
                self.controllers[side] = self._stack.enter_context(controller)
            if self._with_world:
                self._teleport(self._start)
                self.world.wait()
            self.place(self._start)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Ends all processes; stopping twice does no harm."""
        self.world.stop()  # before it could miss the controllers
        self._stack.close()
        self.controllers = {}

    def place(self, start: BoundaryPoses | ArrayLike | None = None) -> None:
        """Sets the arms, which must stand, to ``start`` at once and hangs the rod there anew.

        Raises:
            ValueError: if a controller refuses because its arm moves.
            DeviceError: if the world does not follow.
        """
        joint_angles = self._joint_angles(start)
        self._teleport(joint_angles)
        if not self._with_world:
            return
        self._wait_for(joint_angles, time.monotonic())
        self.world.settle()
        # The rod settles with the next sample, the pictures that show it come after.
        self._wait_for(joint_angles, time.monotonic() + 0.1)

    def carry(self, board: Gripper | None) -> None:
        """Sets the arms, which must stand, home at once and puts the calibration board into a
        gripper in place of the rod; None brings the rod back. Returns when pictures show it.

        Raises:
            ValueError: if an arm moves, or there is no world.
            DeviceError: if the world does not follow.
        """
        if not self._with_world:
            raise ValueError("board: there is nothing to carry without a world")
        self._teleport(self.config.dual_arm.home)
        self.world.carry(board)
        self._wait_for(self.config.dual_arm.home, time.monotonic())

    def truth(self, stamp: float | None = None) -> WorldTruth:
        """What was true at a picture's ``stamp``; of the newest picture when omitted."""
        return self.world.truth(stamp)

    def truths(self, since: float) -> Iterator[WorldTruth]:
        """The truth of every set of pictures later than ``since``, oldest first."""
        return self.world.truths(since)

    def fault(self, name: str, fault: str, seconds: float | None = None) -> dict[str, Any]:
        """Injects a fault and returns the answer of the part concerned.

        Args:
            name: a side or a camera.
            fault: of a controller, see ``sim2real.emulator.faults``; of a camera ``freeze``,
                ``drop``, ``latency`` or ``clear``.
            seconds: how long it lasts, where it does.

        Raises:
            ValueError: if there is no such part or fault.
        """
        if name in SIDES:
            request: dict[str, Any] = {"fault": fault}
            if seconds is not None:
                request["seconds"] = seconds
            return ask(self._address(name), request)
        if name not in (camera.name for camera in self.config.cameras):
            cameras = ", ".join(camera.name for camera in self.config.cameras)
            raise ValueError(f"expected {', '.join(SIDES)} or a camera ({cameras}), got {name!r}")
        if fault == "clear":
            return self.world.fault(name, clear=True)
        if seconds is None:
            raise ValueError(f"{fault}: for how many seconds?")
        return self.world.fault(name, **{fault: seconds})

    def state(self, side: str) -> dict[str, Any]:
        """What a controller says of itself on its control port.

        Raises:
            DeviceError: if it does not answer.
        """
        return ask(self._address(side), {"get": "state"})

    @property
    def pids(self) -> dict[str, int]:
        """The processes by name: left, right, world."""
        pids = {side: controller.pid for side, controller in self.controllers.items()}
        return pids | ({"world": self.world.pid} if self._with_world else {})

    def _address(self, side: str) -> str:
        return self.config.controllers[SIDES.index(side)]

    def _joint_angles(self, start: BoundaryPoses | ArrayLike | None) -> Array:
        arms = self.config.dual_arm
        if start is None:
            return arms.home
        if isinstance(start, BoundaryPoses):
            return arms.inverse_kinematics(start)
        joint_angles = np.array(start, dtype=np.float64)
        arms.forward_kinematics(joint_angles)  # checks them
        return joint_angles

    def _teleport(self, joint_angles: Array) -> None:
        for side, angles in zip(SIDES, joint_angles, strict=True):
            ask(self._address(side), {"set": "joints", "value": angles.tolist()})

    def _wait_for(self, joint_angles: Array, since: float) -> None:
        """Until the arms are drawn at ``joint_angles`` in pictures of a time after ``since``."""
        deadline = time.monotonic() + _PLACE_TIMEOUT
        problem = "no pictures"
        while time.monotonic() < deadline:
            try:
                truth = self.world.truth()
            except DeviceError as error:
                problem = str(error)
            else:
                off = float(np.abs(truth.joint_angles - joint_angles).max())
                if off < PLACED_WITHIN and truth.stamp > since:
                    return
                problem = f"its arms are {off:.3g} rad off"
            time.sleep(0.02)
        raise DeviceError(
            f"the simulated world did not follow the arms within {_PLACE_TIMEOUT:g} s: {problem}"
        )


def _check_free(address: str) -> None:
    """Raises DeviceError if another controller is at ``address``: it would be mistaken for ours."""
    try:
        socket.create_connection((address, RTDE_PORT), timeout=0.5).close()
    except OSError:
        return
    raise DeviceError(
        f"something listens at {address}:{RTDE_PORT} already; is another emulated cell running?"
    )
