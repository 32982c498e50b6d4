"""The command that starts an emulated cell and takes faults from the terminal."""

import os
import select
import signal
import sys
import tempfile
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from dlo_gym.exceptions import DeviceError
from dlo_gym.interrupts import deferred_interrupt
from dlo_gym.scene.arms import SIDES
from dlo_gym.scene.builder import default_cameras
from sim2real.config import CellConfig
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.emulator.world_config import Gripper, WorldConfig

PORTS = {
    29999: "dashboard",
    30003: "script upload",
    30004: "RTDE",
    63352: "Robotiq gripper",
    63999: "control port: wrench, faults",
}
BOARDS: dict[str, Gripper | None] = {"left": "left", "right": "right", "none": None}
HELP = """\
left | right  FAULT [seconds]     freeze 1.5, drop_link, refuse 2, mute, protective_stop,
                                  emergency_stop, release_emergency_stop, clear, crash
camera NAME  FAULT seconds        freeze 2, drop 2, latency 0.1; clear ends freezing and dropping
board left | right | none         a calibration board in place of the cable; both arms go home
status                            what the arms and the world do
help, quit"""
_REFRESH = 0.5


def emulate(
    *,
    world: bool = False,
    cell: Path | None = None,
    left: str | None = None,
    right: str | None = None,
    address: str | None = None,
    port: int | None = None,
    rate: float = 20.0,
    image_height: int = 360,
    board: Literal["none", "left", "right"] = "none",
    clutter: bool = False,
    occluders: int = 0,
    quality: Literal["fast", "high"] = "fast",
    seed: int = 0,
) -> None:
    """Emulate two UR5e controllers on loopback, with the simulated world behind them or without.

    Stays until Ctrl-C or `quit`. Lines typed here are faults, for example `left freeze 1.5` or
    `camera side drop 2`; `help` lists them.

    Args:
        world: also simulate rod, forces and cameras.
        cell: take addresses, bases, tool centre points, rod and cameras from this cell file.
        left: loopback address of the left controller (127.0.0.2 unless the cell file says else).
        right: of the right controller (127.0.0.3).
        address: where the cameras are served (127.0.0.4).
        port: where the cameras are served (8080).
        rate: sets of pictures per second; fewer where the processor does not keep up.
        image_height: of all views [pixels], 16:9; a cell file's cameras have their own.
        board: put a calibration board into this gripper, in place of the cable; `board right`
            typed later swaps it.
        clutter: put industrial parts and other cables into the scene.
        occluders: panels that pass in front of the cameras.
        quality: of the rendering; high has shadows and antialiasing and takes several times longer.
        seed: of the other cables and the panels' paths.
    """
    if not 90 <= image_height <= 2160:
        raise ValueError(f"image_height: expected 90 to 2160 pixels, got {image_height}")
    options: dict[str, Any] = {
        "rate": rate,
        "clutter": "industrial" if clutter else "none",
        "n_distractor_cables": 3 if clutter else 0,
        "n_occluders": occluders,
        "quality": quality,
        "board": BOARDS[board],
        "seed": seed,
    }
    options |= {"address": address} if address else {}
    options |= {"port": port} if port is not None else {}
    config = _config(cell, (left, right), image_height, options)
    console = Console()
    with (
        deferred_interrupt() as interrupt,
        _terminated() as terminated,
        tempfile.NamedTemporaryFile("w") as log,
        open(log.name) as written,
    ):
        try:
            with EmulatedCell(config, world=world, log=log) as emulated:
                console.print(_overview(emulated, world=world))
                console.print("help lists what can be typed here; Ctrl-C stops", style="dim")

                def over() -> bool:
                    return interrupt.requested or terminated.is_set()

                _attend(emulated, console, over, written, world=world)
        finally:
            _show(written, console)
    console.print("stopped")


def _config(
    cell: Path | None,
    controllers: tuple[str | None, str | None],
    image_height: int,
    options: dict[str, Any],
) -> WorldConfig:
    if cell is None:
        config = WorldConfig(cameras=default_cameras(image_height / 1080), **options)
    else:
        config = WorldConfig.of_cell(CellConfig.load(cell), **options)
    left, right = controllers
    return config.behind(left or config.controllers[0], right or config.controllers[1])


@contextmanager
def _terminated() -> Iterator[threading.Event]:
    """An event that SIGTERM sets; outside the main thread nothing does."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    former = signal.signal(signal.SIGTERM, lambda *_: event.set())
    try:
        yield event
    finally:
        signal.signal(signal.SIGTERM, former)


def _overview(emulated: EmulatedCell, *, world: bool) -> Table:
    table = Table("part", "process", "listens at", "what", box=None)
    for side, address in zip(SIDES, emulated.config.controllers, strict=True):
        ports = list(PORTS.items())
        for i, (port, what) in enumerate(ports):
            first = (f"{side} UR5e", str(emulated.pids[side])) if i == 0 else ("", "")
            table.add_row(*first, f"{address}:{port}", what)
    if world:
        url = emulated.world.url
        table.add_row("world", str(emulated.pids["world"]), url, "all cameras, for a browser")
        for camera in emulated.config.cameras:
            size = f"camera, MJPEG {camera.width}x{camera.height}"
            table.add_row("", "", f"{url}/{camera.name}", size)
        table.add_row("", "", f"{url}/truth", "the rod's true shape, JSON")
    return table


def _show(log: IO[str], console: Console) -> None:
    """Prints what the world has written since the last time."""
    if text := log.read().rstrip():
        console.print(text, style="yellow", markup=False, highlight=False)


def _attend(
    emulated: EmulatedCell,
    console: Console,
    over: Callable[[], bool],
    log: IO[str],
    *,
    world: bool,
) -> None:
    """Shows the state and takes commands until ``over()`` or ``quit``."""
    lines = _Lines()
    with lines, Live(console=console, auto_refresh=False, transient=True) as live:
        while not over():
            for line in lines.read(_REFRESH):
                if line.strip() in ("quit", "exit"):
                    return
                if line.strip():
                    live.console.print(f"> {line.strip()}", style="dim", markup=False)
                    live.console.print(_answer(emulated, line, world=world), markup=False)
            _show(log, live.console)
            if console.is_terminal:
                status = Text(status_line(emulated, world=world), style="cyan")
                live.update(Text.assemble(status, f"\n> {lines.typed}"), refresh=True)


def _answer(emulated: EmulatedCell, line: str, *, world: bool) -> str:
    try:
        return run_command(emulated, line, world=world)
    except (ValueError, DeviceError) as error:
        return str(error)


def run_command(emulated: EmulatedCell, line: str, *, world: bool = True) -> str:
    """Does what a typed line asks for; returns what to say.

    Raises:
        ValueError: if the line is no command, or the part refuses it.
        DeviceError: if the part does not answer.
    """
    words = line.split()
    if words == ["help"]:
        return HELP
    if words == ["status"]:
        return status_line(emulated, world=world)
    if words[:1] == ["board"]:
        if len(words) != 2 or words[1] not in BOARDS:
            raise ValueError("board: expected left, right or none after it")
        emulated.carry(BOARDS[words[1]])
        return f"{' '.join(words)}: done, both arms are home"
    if words[:1] == ["camera"]:
        words = words[1:]
        if words[:1] in ([], ["left"], ["right"]):
            raise ValueError("camera: which one?")
        if not world:
            raise ValueError("there are no cameras without --world")
    elif words[:1] not in (["left"], ["right"]):
        raise ValueError(f"no command {line.strip()!r}; help lists them")
    if len(words) not in (2, 3):
        raise ValueError(f"expected a fault and perhaps seconds after {words[0]!r}; see help")
    seconds = None
    if len(words) == 3:
        try:
            seconds = float(words[2])
        except ValueError:
            raise ValueError(f"expected a number of seconds, got {words[2]!r}") from None
    emulated.fault(words[0], words[1], seconds)
    return f"{' '.join(words)}: done"


def status_line(emulated: EmulatedCell, *, world: bool) -> str:
    """What the arms and the world do, in one line."""
    parts = []
    for side in SIDES:
        try:
            state = emulated.state(side)
            program = "program runs" if state.get("program") else "no program"
            parts.append(f"{side}: {state.get('safety', '?')}, {program}")
        except (ValueError, DeviceError):
            parts.append(f"{side}: gone")
    if world:
        try:
            status = emulated.world.status()
            if status["board"]:
                parts.append(f"board in the {status['board']} gripper")
            distance = status["rod"]["distance_m"]
            if distance is not None:
                parts.append(f"grippers {1e3 * distance:.1f} mm apart")
            if status["rod"]["problem"]:
                parts.append("ROD OVERSTRETCHED OR LOST")
            clients = sum(camera["clients"] for camera in status["cameras"].values())
            parts.append(f"{status['sets_drawn']} sets of pictures, {clients} streams open")
        except DeviceError:
            parts.append("world: gone")
    return "   ".join(parts)


class _Lines:
    """Lines from standard input without waiting for them; a context manager.

    At a terminal keys are taken one by one, so that what is typed can be shown below a status line
    that changes meanwhile.

    Attributes:
        typed: the line so far.
    """

    def __init__(self, source: IO[str] | None = None) -> None:
        self._source = sys.stdin if source is None else source
        self._terminal_settings: Any = None
        self._over = False
        self.typed = ""

    def __enter__(self) -> "_Lines":
        if self._source.isatty():
            self._terminal_settings = termios.tcgetattr(self._source)
            tty.setcbreak(self._source)
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal_settings is not None:
            termios.tcsetattr(self._source, termios.TCSADRAIN, self._terminal_settings)

    def read(self, timeout: float) -> list[str]:
        """Lines that have come within ``timeout`` [s]; when the input has ended, none."""
        if self._over:
            select.select([], [], [], timeout)
            return []
        ready, _, _ = select.select([self._source], [], [], timeout)
        if not ready:
            return []
        data = os.read(self._source.fileno(), 4096).decode(errors="replace")
        self._over = not data
        lines = []
        for key in data:
            if key in "\r\n":
                lines.append(self.typed)
                self.typed = ""
            elif key in "\x7f\b":
                self.typed = self.typed[:-1]
            elif key.isprintable() and len(self.typed) < 200:
                self.typed += key
        return lines
