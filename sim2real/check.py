"""``dlo robot check``: looks at every part of a cell and moves nothing."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from dlo_gym.exceptions import DeviceError, DloError, MissingExtra
from dlo_gym.scene.arms import SIDES
from sim2real.cell import POLL, CellSample, RobotCell
from sim2real.cell_checks import (
    Row,
    check_calibration,
    check_clamps,
    check_dashboard,
    check_frames,
    check_goal,
    check_gripper,
    check_readings,
    check_sight,
    frames_meanwhile,
    open_camera,
)
from sim2real.config import CellConfig, CellFileError

COLOURS = {"ok": "green", "warning": "yellow", "failed": "red"}


def check(cell: Path, /, *, seconds: float = 2.0) -> None:
    """Connect to a cell and check every part of it; nothing moves.

    Controllers, readings, tools, grippers, poses against the limits, cameras, whether they see
    the cable where the arms say that it is, and the calibration. Exits with status 1 if a check
    failed; warnings do not keep a cell from running.

    Args:
        cell: the cell file.
        seconds: to listen to arms and cameras.
    """
    if not 0.1 <= seconds <= 60.0:
        raise ValueError(f"seconds: expected 0.1 to 60, got {seconds}")
    console = Console()
    try:
        config = CellConfig.load(cell)
    except CellFileError as error:
        rows = [Row("cell file", "failed", str(error), "correct it; `dlo robot init` writes one")]
    else:
        rows = [Row("cell file", "ok", f"{config.name}: {cell}")]
        with console.status("looking at the cell"):
            rows += check_cell(config, seconds)
    console.print(as_table(rows))
    failed = [row.check for row in rows if row.verdict == "failed"]
    warnings = sum(row.verdict == "warning" for row in rows)
    if failed:
        raise DloError(f"{len(failed)} of {len(rows)} checks failed: {', '.join(failed)}")
    console.print(f"all {len(rows)} checks passed, {warnings} with a warning")


def check_cell(config: CellConfig, seconds: float, cell: RobotCell | None = None) -> list[Row]:
    """All checks of a cell, one row each; what depends on a missing part is left out.

    Args:
        config: of the cell.
        seconds: to listen.
        cell: devices in place of those that ``config`` describes; not open.
    """
    try:
        cell = cell or RobotCell(config)
    except (DloError, ValueError) as error:
        return [Row("drivers", "failed", str(error), "install what is missing")]
    rows = []
    for side in SIDES:
        if config.arms[side].driver == "ur5e":  # type: ignore[index]
            rows += check_dashboard(side, config.arms[side].address)  # type: ignore[index]
    with ExitStack() as stack:
        connected = []
        for side, arm in cell.arms.items():
            stack.callback(arm.close)
            try:
                arm.connect(control=False)
                connected.append(side)
                rows.append(Row(f"{side} arm: link", "ok", "readings come"))
            except (DeviceError, MissingExtra) as error:
                advice = "see the rows of its dashboard; is its RTDE interface on?"
                rows.append(Row(f"{side} arm: link", "failed", str(error), advice))
        opened = []
        for name, camera in cell.cameras.items():
            stack.callback(camera.close)
            rows.append(open_camera(name, camera))
            if rows[-1].verdict == "ok":
                opened.append(name)
        rows += _listen(cell, connected, opened, seconds)
    for side in SIDES:
        rows += check_gripper(config, side)
    return [*rows, *check_calibration(config)]


def as_table(rows: list[Row]) -> Table:
    """The rows as they are printed."""
    table = Table("check", "", "found", "what to do", box=None)
    for row in rows:
        style = COLOURS[row.verdict]
        table.add_row(
            row.check, f"[{style}]{row.verdict}[/]", _plain(row.found), _plain(row.advice)
        )
    return table


def _listen(
    cell: RobotCell, connected: list[str], opened: list[str], seconds: float
) -> Iterator[Row]:
    """What arms and cameras tell within some seconds."""
    config, since = cell.config, time.monotonic()
    whole = len(connected) == len(cell.arms) and len(opened) == len(cell.cameras)
    samples: list[CellSample] = []
    trouble = ""
    while time.monotonic() < since + seconds:
        try:
            sample = cell.sample() if whole else None
        except DeviceError as error:
            sample, trouble = None, str(error)
        if sample is not None:
            samples = [*samples[-1:], sample]
        time.sleep(POLL)
    joint_angles = []
    for side in connected:
        try:
            readings = cell.arms[side].readings(since)
        except DeviceError:
            readings = []
        yield from check_readings(config, side, readings, seconds)
        joint_angles += [reading.joint_angles for reading in readings[-1:]]
    cameras = {name: cell.cameras[name] for name in opened}
    for name, frames in frames_meanwhile(cameras, since).items():
        yield from check_frames(config, name, frames)
    if len(joint_angles) == len(SIDES):
        yield from check_clamps(config, np.stack(joint_angles))
    if whole:
        yield from _of_samples(config, samples, trouble)
    if len(joint_angles) == len(SIDES):
        yield from check_goal(config, config.dual_arm.forward_kinematics(np.stack(joint_angles)))


def _of_samples(config: CellConfig, samples: list[CellSample], trouble: str) -> Iterator[Row]:
    if not samples:
        found = trouble or "no images that were taken together"
        advice = "are the cameras' clocks, stamps and latency_s right?"
        yield Row("synchronised images", "failed", found, advice)
        return
    stamps = [view.stamp for view in samples[-1].views]
    spread = 1e3 * (max(stamps) - min(stamps))
    yield Row("synchronised images", "ok", f"taken within {spread:.0f} ms")
    yield from check_sight(config, samples)


def _plain(text: str) -> str:
    """``text`` without markup of its own."""
    return text.replace("[", r"\[")
