"""The simulated world behind two emulated controllers: rod or board, forces, cameras, truth.

One process: ``python -m sim2real.emulator.world --config FILE``; from Python, ``EmulatedWorld``.
It reads where the arms are over RTDE, lets the rod follow the grippers, tells each controller the
force on its gripper, and serves what the cameras see.
"""

import json
import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.arms import SIDES
from sim2real.emulator.camera_feed import CameraFeed
from sim2real.emulator.controller_link import ControllerLink
from sim2real.emulator.drawing import CellDrawing, Drawing, Snapshot, encode
from sim2real.emulator.held_rod import HeldRod, HeldShape
from sim2real.emulator.mjpeg_server import Answer, MjpegServer
from sim2real.emulator.truth import TruthHistory
from sim2real.emulator.world_config import Gripper, WorldConfig, check_seconds

ROD_RATE = 40.0  # at which the rod follows the grippers [Hz]
WRENCH_EVERY = 2  # of these steps the controllers are told the wrench
GONE = 0.25  # a controller silent for longer is taken to stand still [s]
LONGEST_FAULT = 600.0
_NICENESS = 5  # of drawing: the robots come first
_PARENT_CHECK = 0.2

_log = logging.getLogger(__name__)


class World:
    """Runs in this process, in threads, from ``start`` until ``close``.

    Args:
        config: of the world.
        make_drawing: what draws the pictures, made in the thread that uses it.
    """

    def __init__(
        self, config: WorldConfig, make_drawing: Callable[[WorldConfig], Drawing] = CellDrawing
    ) -> None:
        self.config = config
        self.failed = False
        self._make_drawing = make_drawing
        self._rod = HeldRod(config.rod, config.n_elements, config.overstretch_stiffness)
        # Loads the rod's compiled kernels and gives the first drawing something to draw.
        home = config.dual_arm.forward_kinematics(config.dual_arm.home)
        settled = self._rod.follow(home)
        self._home = settled if config.board is None else HeldShape.nothing(home)
        self._board: Gripper | None = config.board
        self._links = [ControllerLink(address) for address in config.controllers]
        self._feeds = {
            camera.name: CameraFeed(config.latency.get(camera.name, 0.0))
            for camera in config.cameras
        }
        self._truth = TruthHistory()
        self._snapshot: Snapshot | None = None
        self._began = time.monotonic()
        self._n_drawn = 0
        self._settle_anew = threading.Event()
        self._drawable = threading.Event()
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._server: MjpegServer | None = None

    def start(self) -> None:
        """Begins to move, draw and serve; returns when a drawing has been made.

        Raises:
            OSError: if the address is taken.
        """
        self._server = MjpegServer(self.config.address, self.config.port, self._feeds, self)
        for target in (self._move_rod, self._draw_pictures):
            thread = threading.Thread(
                target=self._guarded, args=(target,), name=target.__name__, daemon=True
            )
            thread.start()
            self._threads.append(thread)
        self._drawable.wait()

    @property
    def url(self) -> str:
        """Where it serves.

        Raises:
            ValueError: before ``start``.
        """
        if self._server is None:
            raise ValueError("url: the world has not been started")
        return self.config.moved_to(self.config.address, self._server.port).url

    def close(self) -> None:
        """Stops everything; closing twice does no harm."""
        self._closing.set()
        for thread in self._threads:
            thread.join(timeout=5.0)
        if self._server is not None:
            self._server.close()
            self._server = None
        for link in self._links:
            link.close()

    def wait(self, timeout: float) -> bool:
        """Whether the world has closed or failed within ``timeout`` [s]."""
        return self._closing.wait(timeout)

    def _guarded(self, run: Callable[[], None]) -> None:
        try:
            run()
        except Exception:
            # A world that stands still unnoticed would be worse than none.
            _log.exception("the world stops: %s failed", run.__name__)
            self.failed = True
            self._closing.set()
        finally:
            self._drawable.set()

    def _move_rod(self) -> None:
        ticks, step = _Ticks(1.0 / ROD_RATE), 0
        while not self._closing.wait(ticks.until_next()):
            snapshot = self._present()
            if snapshot is not None:
                self._snapshot = snapshot
            step += 1
            if step % WRENCH_EVERY:
                continue
            wrenches: list[Array | None] = [None, None]
            if snapshot is not None:
                wrenches = list(self._wrenches_on_grippers(snapshot.shape))
            for link, wrench in zip(self._links, wrenches, strict=True):
                link.exchange(wrench)

    def _present(self) -> Snapshot | None:
        """The world at the newest moment at which both arms are known; None before there is one.

        A controller that is gone stands still, so its last joint angles hold until now.
        """
        now = time.monotonic()
        stamp = now
        for link in self._links:
            newest = link.newest
            if newest is None:
                return None
            if now - newest.stamp < GONE:
                stamp = min(stamp, newest.stamp)
        last = self._snapshot
        if last is not None and stamp <= last.stamp:
            return last
        joint_angles = np.array([link.joint_angles(stamp) for link in self._links])
        if self._settle_anew.is_set():
            self._settle_anew.clear()
            self._rod.forget()
            last = None
        board = self._board
        if (
            last is not None
            and board == last.board
            and np.array_equal(joint_angles, last.joint_angles)
        ):
            return Snapshot(stamp, joint_angles, last.shape, board)
        boundary = self.config.dual_arm.forward_kinematics(joint_angles)
        if board is not None:
            self._rod.forget()  # it hangs anew when it is back
            return Snapshot(stamp, joint_angles, HeldShape.nothing(boundary), board)
        return Snapshot(stamp, joint_angles, self._rod.follow(boundary))

    def _wrenches_on_grippers(self, shape: HeldShape) -> Array:
        """(2, 6) what the rod exerts on each gripper at its TCP, in the arm's base axes."""
        R_base_world = np.swapaxes(self.config.dual_arm.T_world_base[:, :3, :3], -1, -2)
        # A clamp's origin is its gripper's TCP; reaction is opposite to action.
        by_vector = -shape.wrenches.reshape(2, 2, 3)
        return np.einsum("sij,skj->ski", R_base_world, by_vector).reshape(2, 6)

    def _draw_pictures(self) -> None:
        # Of a thread where the system has such a thing; llvmpipe's own threads inherit it.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        drawing = self._make_drawing(self.config)
        try:
            home = self.config.dual_arm.home
            drawing.draw(Snapshot(time.monotonic(), home, self._home, self.config.board))
            self._drawable.set()
            pause, drawn_stamp = 0.0, -math.inf
            while not self._closing.wait(pause):
                began, worked = time.monotonic(), time.thread_time()
                snapshot = self._snapshot
                if snapshot is not None and snapshot.stamp > drawn_stamp:
                    self._publish(drawing, snapshot)
                    drawn_stamp = snapshot.stamp
                needed = (time.thread_time() - worked) / self.config.drawing_share
                pause = max(began + max(1.0 / self.config.rate, needed) - time.monotonic(), 0.0)
        finally:
            drawing.close()

    def _publish(self, drawing: Drawing, snapshot: Snapshot) -> None:
        drawn = drawing.draw(snapshot)
        jpegs = {name: encode(one.image) for name, one in drawn.items()}
        # First the truth: who has a picture can ask for it.
        self._truth.add(snapshot, drawn)
        for name, jpeg in jpegs.items():
            self._feeds[name].publish(jpeg, snapshot.stamp)
        self._n_drawn += 1

    def get(self, path: str, query: Mapping[str, str]) -> Answer | None:
        """The pages ``/``, ``/status`` and ``/truth``."""
        if path == "/":
            return Answer(200, _page(self._feeds), "text/html; charset=utf-8")
        if path == "/status":
            return Answer.of(self.status)
        if path == "/truth":
            if "since" in query:
                return Answer(200, self._truth.since(_finite(query["since"], "since")).encode())
            newest = self._truth.newest()
            if newest is None:
                return Answer.wrong(503, "nothing drawn yet: a controller has not been reached")
            return Answer(200, newest.encode())
        return None

    def post(self, path: str, body: Any) -> Answer | None:
        """``/fault`` {"camera": name, "freeze" | "drop" | "latency": seconds} or "clear": true;
        ``/settle`` {} hangs the rod anew between the grippers, whatever its past; ``/board``
        {"side": "left" | "right"} takes the rod away and gives that gripper the calibration
        board, null takes the board away and brings the rod back."""
        if path == "/settle":
            self._settle_anew.set()
            return Answer.of({"ok": True})
        if path == "/board":
            if not isinstance(body, dict) or body.get("side", "") not in (None, *SIDES):
                raise ValueError('expected {"side": "left", "right" or null}')
            self._board = body["side"]
            return Answer.of({"ok": True, "board": self._board})
        if path != "/fault":
            return None
        if not isinstance(body, dict) or body.get("camera") not in self._feeds:
            raise ValueError(f'expected {{"camera": one of {", ".join(self._feeds)}, ...}}')
        feed = self._feeds[body["camera"]]
        faults: list[Callable[[], None]] = []
        for name, value in body.items():
            if name in ("freeze", "drop"):
                seconds = check_seconds(value, name, LONGEST_FAULT)
                faults.append(partial(getattr(feed, name), seconds))
            elif name == "latency":
                faults.append(partial(feed.delay, check_seconds(value, name)))
            elif name == "clear":
                faults.append(feed.clear)
            elif name != "camera":
                raise ValueError(f"unknown {name!r}; there are: freeze, drop, latency, clear")
        for fault in faults:
            fault()
        return Answer.of({"ok": True, "camera": body["camera"], **feed.status})

    @property
    def status(self) -> dict[str, Any]:
        """How the world is doing."""
        snapshot, elapsed = self._snapshot, time.monotonic() - self._began
        return {
            "pid": os.getpid(),
            "elapsed_s": round(elapsed, 3),
            "processor": round(time.process_time() / elapsed, 3),
            "stamp": None if snapshot is None else round(snapshot.stamp, 6),
            "sets_drawn": self._n_drawn,
            "board": None if snapshot is None else snapshot.board,
            "rod": {
                "problem": "" if snapshot is None else snapshot.shape.problem,
                "distance_m": None
                if snapshot is None
                else round(snapshot.shape.boundary.distance, 6),
            },
            "controllers": {
                side: link.status for side, link in zip(SIDES, self._links, strict=True)
            },
            "cameras": {name: feed.status for name, feed in self._feeds.items()},
        }


class _Ticks:
    """An even beat that skips what it is too late for."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._next = time.monotonic()

    def until_next(self) -> float:
        """Time to wait for the next beat [s], which it then counts as done."""
        now = time.monotonic()
        self._next += self._period
        if now > self._next:
            self._next += self._period * math.ceil((now - self._next) / self._period)
        return max(self._next - now, 0.0)


def _finite(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name}: expected a number, got {text!r}")
    return value


def _page(cameras: Mapping[str, CameraFeed]) -> bytes:
    figures = "".join(
        f'<figure><img src="/{name}" alt="{name}"><figcaption>{name}</figcaption></figure>'
        for name in cameras
    )
    page = Path(__file__).with_name("world.html").read_text()
    return page.replace("<!-- cameras -->", figures).encode()


def serve(*, config: Path = Path("-")) -> None:
    """Run the simulated world behind two emulated controllers until it is told to stop.

    Prints one line of JSON with its url as soon as it serves. Ends on SIGTERM, on Ctrl-C and with
    the process that started it.

    Args:
        config: JSON file with any fields of ``WorldConfig``; - reads it from standard input.
    """
    text = sys.stdin.read() if str(config) == "-" else config.read_text()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    parent = os.getppid()
    world = World(WorldConfig.from_json(text or "{}"))
    try:
        world.start()
        print(json.dumps({"url": world.url, "pid": os.getpid()}), flush=True)
        while not (stop.is_set() or os.getppid() != parent or world.wait(_PARENT_CHECK)):
            pass
    finally:
        world.close()
    if world.failed:
        sys.exit(1)


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="world: %(message)s")
    tyro.cli(serve, prog="python -m sim2real.emulator.world")
