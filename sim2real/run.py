"""``dlo robot run``: the closed loop on a cell."""

import os
import shutil
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from control.evaluate import write_metrics
from dlo_gym.exceptions import DeviceError, DloError
from dlo_gym.geometry.se3 import Array
from dlo_gym.interrupts import deferred_interrupt
from dlo_gym.metrics import ptp_3d
from dlo_gym.output_folder import check_output_folder, replace_folder
from sim2real.cell import RobotCell
from sim2real.config import CellConfig
from sim2real.goals import make_goal
from sim2real.loop import ClosedLoop
from sim2real.recorder import CellRecorder, step_signals
from sim2real.steps import CellStep, control_steps
from sim2real.truth_source import TruthSource


def run(
    cell: Path,
    /,
    *,
    goal: str = "sampled",
    seed: int = 0,
    steps: int = 100,
    speed: float = 1.0,
    dry_run: bool = False,
    recoveries: int = 0,
    record: bool = True,
    image_format: Literal["png", "jpg"] = "png",
    live: bool = False,
    out: Path = Path("out/robot-run"),
    overwrite: bool = False,
) -> None:
    """Steer the cable of a cell to a goal shape, seeing it only through the cell's cameras.

    The loop of `dlo control` on real or emulated arms: every command passes the safety gate, and
    while the arms move everything a limit is set for is watched. Ctrl-C stops both arms and keeps
    what was recorded.

    Args:
        cell: the cell file.
        goal: sampled, or a .npy file with the goal centerline (n_nodes, 3) in world [m].
        seed: of a sampled goal.
        steps: control periods to run.
        speed: share of the cell's step and speed limits; 0.1 for a first run.
        dry_run: compute everything, send nothing, print what would be sent.
        recoveries: stops that the run may get over by itself (broken link, frozen stream), from
            the poses the arms then have.
        record: keep a recording of everything in the output folder.
        image_format: png keeps every bit, for `dlo robot replay`; jpg is ten times smaller.
        live: show the run in the rerun viewer.
        out: folder for the recording and metrics.json.
        overwrite: replace the former run in the output folder.
    """
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    if recoveries < 0:
        raise ValueError(f"recoveries: expected 0 or more, got {recoveries}")
    config = CellConfig.load(cell)
    check_output_folder(out, ("metrics.json", "recording"), overwrite=overwrite)
    console = Console()
    partial = out.with_name(f".{out.name}.part-{os.getpid()}")
    with ExitStack() as stack:
        robot = stack.enter_context(RobotCell(config))
        robot.open()
        shape = make_goal(goal, config, robot.boundary, seed)
        partial.mkdir(parents=True)
        stack.callback(shutil.rmtree, partial, ignore_errors=True)
        metrics = steer(
            robot,
            ClosedLoop(config, shape, speed),
            steps=steps,
            dry_run=dry_run,
            recoveries=recoveries,
            recording=partial / "recording" if record else None,
            settings={"goal": shape.tolist(), "speed": speed, "seed": seed},
            image_format=image_format,
            live=live,
            console=console,
        )
        write_metrics(partial / "metrics.json", metrics)
        replace_folder(partial, out)
    console.print(summary(metrics))
    console.print(f"written to {out}", highlight=False, markup=False, soft_wrap=True)
    if metrics["stopped"]:
        raise DloError(metrics["stopped"])


def steer(
    robot: RobotCell,
    loop: ClosedLoop,
    *,
    steps: int,
    dry_run: bool = False,
    recoveries: int = 0,
    recording: Path | None = None,
    settings: dict[str, Any] | None = None,
    image_format: str = "png",
    live: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Runs ``loop`` on an open cell; returns the run's metrics.

    A stop that is not recovered from ends the run; ``metrics["stopped"]`` says what it was.

    Args:
        robot: open; control is taken when all is ready, in a dry run never.
        loop: tracker, controller and gate.
        steps, dry_run, recoveries: see ``control_steps``.
        recording: folder to make.
        settings: kept in the recording.
        image_format: of the recording.
        live: show the run in the rerun viewer.
        console: for the progress bar; none when omitted.
    """
    config = robot.config
    truth = TruthSource(config.truth_url) if config.truth_url else None
    made: list[CellStep] = []
    stopped = ""
    started = truth.newest().centerline if truth else None
    with ExitStack() as stack:
        interrupt = stack.enter_context(deferred_interrupt())
        recorder = viewer = None
        if recording is not None:
            recorder = stack.enter_context(
                CellRecorder(
                    recording, config, settings or {}, truth=truth, image_format=image_format
                )
            )
        if live:
            from sim2real.live_view import LiveView

            viewer = stack.enter_context(LiveView(config, loop.goal))
        progress = stack.enter_context(_progress(console))
        task = progress.add_task("starting the loop", total=steps + 1)
        loop_steps = control_steps(robot, loop, steps=steps, dry_run=dry_run, recoveries=recoveries)
        try:
            for step in loop_steps:
                # Without its images, so that a long run needs no more memory.
                made.append(replace(step, given=replace(step.given, views=())))
                error = shape_error(step, loop.goal)
                progress.update(
                    task, completed=len(made), description=f"shape {1e3 * error:6.1f} mm"
                )
                if dry_run:
                    progress.console.print(f"would send {step.output.decision}", highlight=False)
                if recorder is not None:
                    recorder.add(
                        step.given.views,
                        step.given.boundary,
                        step.given.stamp,
                        taken=step.taken,
                        extra=step_signals(step),
                    )
                if viewer is not None:
                    viewer.show(step)
                if interrupt.requested:
                    stopped = f"interrupted after {len(made)} steps"
                    break
        except DloError as error:
            stopped = str(error)
            if viewer is not None:
                viewer.note(stopped, level="ERROR")
        robot.halt()
    return run_metrics(made, loop, config, truth, started) | {"stopped": stopped}


def shape_error(step: CellStep, goal: Array) -> float:
    """Mean node distance of the tracked cable to ``goal`` [m]."""
    return float(ptp_3d(step.output.estimate.centerline, goal).mean())


def run_metrics(
    made: list[CellStep],
    loop: ClosedLoop,
    config: CellConfig,
    truth: TruthSource | None,
    started: Array | None,
) -> dict[str, Any]:
    """What is reported of a run; lengths in mm, times in ms."""
    errors = [1e3 * shape_error(step, loop.goal) for step in made]
    period = config.control.period_s
    late = np.array([step.late for step in made])
    metrics: dict[str, Any] = {
        "cell": config.name,
        "steps": len(made),
        "initial_shape_error_mm": errors[0] if errors else None,
        "final_shape_error_mm": errors[-1] if errors else None,
        "reached": bool(errors and errors[-1] <= 1e3 * config.control.success_threshold_m),
        "late_by_a_period_percent": 100.0 * float((late > period).mean()) if errors else None,
        "tracking_ms": _times([step.output.tracking_ms for step in made]),
        "control_ms": _times([step.output.control_ms for step in made]),
        "image_age_ms": _times([1e3 * (step.sent - step.given.stamp) for step in made]),
        "begun_anew": max(0, sum(step.begins for step in made) - 1),
        "safety_cuts": sorted({name for step in made for name in step.output.decision.reasons}),
    }
    if truth is not None and started is not None:
        try:
            end = truth.newest().centerline
        except DeviceError:
            return metrics
        metrics["initial_true_error_mm"] = 1e3 * float(ptp_3d(started, loop.goal).mean())
        metrics["final_true_error_mm"] = 1e3 * float(ptp_3d(end, loop.goal).mean())
    return metrics


def summary(metrics: dict[str, Any]) -> Table:
    """The main figures as a table."""
    table = Table(box=None, show_header=False)
    for name, key, unit in (
        ("goal distance at the start, tracked", "initial_shape_error_mm", "mm"),
        ("goal distance at the end, tracked", "final_shape_error_mm", "mm"),
        ("goal distance at the start, true cable", "initial_true_error_mm", "mm"),
        ("goal distance at the end, true cable", "final_true_error_mm", "mm"),
        ("steps late by more than a period", "late_by_a_period_percent", "%"),
    ):
        if metrics.get(key) is not None:
            table.add_row(name, f"{metrics[key]:.2f} {unit}")
    for name, key in (
        ("tracking", "tracking_ms"),
        ("control and safety gate", "control_ms"),
        ("image age when the command goes out", "image_age_ms"),
    ):
        if metrics[key] is not None:
            times = metrics[key]
            table.add_row(name, f"{times['median']:.1f} ms (p99 {times['p99']:.1f})")
    table.add_row("steps", str(metrics["steps"]))
    table.add_row("cut by the safety gate", ", ".join(metrics["safety_cuts"]) or "never")
    table.add_row("goal reached", "yes" if metrics["reached"] else "no")
    return table


def _progress(console: Console | None) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=console is None,
    )


def _times(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "p99": float(np.percentile(values, 99))}
