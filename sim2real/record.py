"""``dlo robot record``: what a cell sees, without controlling it."""

import time
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import Progress

from dlo_gym.geometry.camera import View
from dlo_gym.interrupts import deferred_interrupt
from sim2real.cell import RobotCell
from sim2real.config import CellConfig
from sim2real.recorder import CellRecorder
from sim2real.truth_source import TruthSource


def record(
    cell: Path,
    out: Path,
    /,
    *,
    seconds: float = 10.0,
    rate_hz: float | None = None,
    image_format: Literal["png", "jpg"] = "jpg",
) -> None:
    """Record images and gripper poses of a cell; moves nothing and starts no program on the arms.

    The arms may be moved by others meanwhile: by hand in freedrive, by another program. The
    recording is one that `dlo track` takes. Ctrl-C ends it early and keeps what there is.

    Args:
        cell: the cell file.
        out: folder of the recording; an existing one is never replaced.
        seconds: how long.
        rate_hz: samples per second; the cell's control rate when omitted.
        image_format: png keeps every bit, jpg is ten times smaller.
    """
    if not seconds > 0:
        raise ValueError(f"seconds: expected a positive time, got {seconds}")
    if rate_hz is not None and not rate_hz > 0:
        raise ValueError(f"rate_hz: expected a positive rate, got {rate_hz}")
    config = CellConfig.load(cell)
    period = 1.0 / rate_hz if rate_hz else config.control.period_s
    count = max(1, round(seconds / period))
    truth = TruthSource(config.truth_url) if config.truth_url else None
    console = Console()
    with RobotCell(config) as robot:
        robot.open()
        robot.sample()
        with (
            deferred_interrupt() as interrupt,
            CellRecorder(out, config, {}, truth=truth, image_format=image_format) as recorder,
            Progress(console=console, transient=True) as progress,
        ):
            task = progress.add_task("recording", total=count)
            origin, tick, made = None, time.monotonic(), 0
            while made < count and not interrupt.requested:
                sample = robot.wait_for_sample()
                origin = sample.stamp if origin is None else origin
                views = tuple(
                    View(view.image, view.camera, view.stamp - origin) for view in sample.views
                )
                recorder.add(views, sample.boundary, sample.stamp - origin, taken=sample.stamp)
                made += 1
                progress.advance(task)
                tick = max(tick + period, time.monotonic() - period)
                time.sleep(max(0.0, tick - time.monotonic()))
    lost = f", {recorder.n_dropped} lost to a slow disk" if recorder.n_dropped else ""
    console.print(f"{made} samples{lost} in {out}", highlight=False, markup=False, soft_wrap=True)
