"""The whole loop in one command: two arms, two cameras, the tracker, the MPC, a report."""

import os
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from control.evaluate import (
    Step,
    episode_metrics,
    gate_for,
    make_controller,
    make_env,
    run_episode,
    write_metrics,
)
from control.report import EpisodeVideo, plot_episode, side_by_side, write_page
from dlo_gym.envs.shape_env import ShapeControlEnv
from dlo_gym.interrupts import deferred_interrupt
from dlo_gym.output_folder import check_output_folder, replace_folder
from dlo_gym.overlay import draw_overlay
from dlo_gym.recording import RecordingWriter

ENVIRONMENT = "dlo_gym/ShapeControlTracked-v0"
MADE = ("report.html", "views.mp4", "views.png", "plots.png", "metrics.json", "recording")


def demo(
    *,
    out: Path = Path("out/demo"),
    seed: int = 0,
    steps: int = 60,
    image_height: int = 720,
    occluders: int = 1,
    clutter: bool = True,
    quality: Literal["fast", "high"] = "fast",
    model: Literal["surrogate", "rod"] = "surrogate",
    overwrite: bool = False,
) -> None:
    """Steer a cable to a goal shape, seeing it only through two rendered cameras.

    One episode of model predictive control on tracked observations. Leaves a folder with
    report.html, a video of both views, plots, metrics.json and the recording; Ctrl-C ends the
    episode early and reports the steps made.

    Args:
        out: folder to make.
        seed: of the start, the goal and the passing occluders.
        steps: control steps of 0.1 s.
        image_height: of both views [pixels], 16:9.
        occluders: panels that pass in front of the cameras.
        clutter: put industrial parts and other cables into the scene.
        quality: of the rendering; high has shadows and antialiasing and takes several times longer.
        model: what the MPC plans on: the trained surrogate, or the rod itself.
        overwrite: replace the output folder if it exists and holds nothing but a former report.
    """
    out = out.resolve()
    check_output_folder(out, MADE, overwrite=overwrite)
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    if seed < 0:
        raise ValueError(f"seed: expected 0 or more, got {seed}")
    if not 90 <= image_height <= 2160:
        raise ValueError(f"image_height: expected 90 to 2160 pixels, got {image_height}")
    console = Console()
    environment = make_env(
        ENVIRONMENT,
        image_scale=image_height / 1080,
        n_occluders=occluders,
        clutter="industrial" if clutter else "none",
        n_distractor_cables=3 if clutter else 0,
        quality=quality,
        max_episode_steps=steps,
        goal_distance=(0.06, 0.12),
    )
    partial = out.with_name(f".{out.name}.part-{os.getpid()}")
    with deferred_interrupt() as interrupt, ExitStack() as stack:
        stack.callback(environment.close)
        stack.callback(shutil.rmtree, partial, ignore_errors=True)
        cell_env = environment.unwrapped
        assert isinstance(cell_env, ShapeControlEnv)
        gate = gate_for(cell_env.config)
        controller = make_controller("mpc", gate.limits, cell_env.config, model=model)
        partial.mkdir(parents=True)
        made: list[Step] = []
        poster: NDArray[np.uint8] | None = None
        progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
        )
        with (
            EpisodeVideo(partial / "views.mp4", 1.0 / cell_env.config.control_step) as video,
            _recording(partial / "recording", cell_env, seed) as recording,
            progress,
        ):
            task = progress.add_task("starting the cell", total=steps)
            for step in run_episode(environment, controller, gate, seed=seed):
                made.append(step)
                _record(recording, cell_env, step)
                image = _picture(cell_env, step)
                video.append(image)
                if poster is None or step.shape_error > 0.5 * made[0].shape_error:
                    poster = image
                progress.update(
                    task,
                    completed=len(made) - 1,
                    description=f"shape {1e3 * step.shape_error:6.1f} mm   tracking"
                    f" {1e3 * step.tracking_ptp3d:4.1f} mm",
                )
                if interrupt.requested:
                    break
            progress.update(task, description="writing the report")
        assert poster is not None
        imageio.imwrite(partial / "views.png", poster)
        metrics = episode_metrics(made) | {"seed": seed, "environment": ENVIRONMENT}
        write_metrics(partial / "metrics.json", metrics)
        _plot(partial / "plots.png", made, cell_env.config.success_threshold)
        write_page(
            partial / "report.html",
            title="Shape control of a cable on tracked observations",
            metrics=metrics,
            video="views.mp4",
            picture="views.png",
            plots=["plots.png"],
            command=f"dlo demo --seed {seed} --steps {steps} --image-height {image_height}"
            f" --occluders {occluders} --{'' if clutter else 'no-'}clutter --quality {quality}"
            f" --model {model}",
        )
        replace_folder(partial, out)
    console.print(_summary(metrics))
    console.print(f"report: {out / 'report.html'}", highlight=False, soft_wrap=True, markup=False)
    if interrupt.requested:
        raise KeyboardInterrupt(f"the report shows the {len(made) - 1} steps made")


def _recording(path: Path, env: ShapeControlEnv, seed: int) -> RecordingWriter:
    properties = env.config.properties
    return RecordingWriter(
        path,
        env.cell.cameras,
        rod_length=properties.length,
        rod_radius=float(np.max(properties.radius)),
        youngs_modulus=float(np.mean(properties.youngs_modulus)),
        density=float(np.mean(properties.density)),
        rate_hz=1.0 / env.config.control_step,
        name=f"demo-{seed}",
        image_format="jpg",
    )


def _record(recording: RecordingWriter, env: ShapeControlEnv, step: Step) -> None:
    boundary = env.cell.boundary
    recording.append(
        env.cell.views(),
        boundary.left,
        boundary.right,
        step.stamp,
        centerline=step.truth,
        visible=env.cell.visibility(),
    )


def _picture(env: ShapeControlEnv, step: Step) -> NDArray[np.uint8]:
    """All views in a row with goal, true and tracked centerline."""
    return side_by_side(
        [
            draw_overlay(
                view,
                step.estimate.centerline,
                visible=visible,
                truth=step.truth,
                goal=step.goal,
                caption=f"{view.camera.name}, {step.stamp:.1f} s,"
                f" {1e3 * step.shape_error:.1f} mm to the goal",
            )
            for view, visible in zip(env.cell.views(), step.estimate.visible, strict=True)
        ]
    )


def _plot(path: Path, steps: list[Step], success_threshold: float) -> None:
    plot_episode(
        path,
        stamps=[step.stamp for step in steps],
        shape_error=[step.shape_error for step in steps],
        tracking_error=[step.tracking_ptp3d for step in steps],
        occlusion=[step.occlusion_ratio for step in steps],
        control_ms=[np.nan if step.control_ms is None else step.control_ms for step in steps],
        tracking_ms=[np.nan if step.tracking_ms is None else step.tracking_ms for step in steps],
        success_threshold=success_threshold,
    )


def _summary(metrics: dict) -> Table:
    table = Table(box=None, show_header=False)
    for name, key in (
        ("goal distance at the start", "initial_shape_error_mm"),
        ("goal distance at the end, true rod", "final_shape_error_mm"),
        ("tracking PTP3D along the way", "tracking_ptp3d_mm"),
    ):
        table.add_row(name, f"{metrics[key]:.2f} mm")
    table.add_row("nodes hidden, mean", f"{metrics['occlusion_percent']:.0f} %")
    for name, key in (("control", "control_ms"), ("tracking", "tracking_ms")):
        times = metrics[key]
        if times is not None:
            table.add_row(name, f"{times['median']:.1f} ms (p99 {times['p99']:.1f})")
    table.add_row("goal reached", "yes" if metrics["success"] else "no")
    return table
