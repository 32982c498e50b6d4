"""``dlo robot demo``: a shape task through two emulated UR5e, as on real arms but for the metal."""

import os
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from control.evaluate import write_metrics
from control.report import EpisodeVideo, plot_episode, side_by_side, write_page
from dlo_gym.exceptions import DloError
from dlo_gym.geometry.se3 import Array
from dlo_gym.metrics import occlusion_ratio, ptp_3d
from dlo_gym.output_folder import check_output_folder, replace_folder
from dlo_gym.overlay import draw_overlay
from dlo_gym.recording import Recording
from sim2real.cell import RobotCell
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.goals import make_goal
from sim2real.loop import ClosedLoop
from sim2real.run import steer, summary

MADE = ("report.html", "views.mp4", "views.png", "plots.png", "metrics.json", "recording")
RECOVERIES = 5  # a busy machine may freeze a stream for a moment


def demo(
    *,
    out: Path = Path("out/demo-robot"),
    seed: int = 0,
    steps: int = 100,
    speed: float = 1.0,
    clutter: bool = True,
    occluders: int = 0,
    model: Literal["surrogate", "rod"] = "surrogate",
    live: bool = False,
    overwrite: bool = False,
) -> None:
    """Steer a cable to a goal shape through two emulated UR5e, everything over sockets.

    Starts two emulated controllers and a simulated world with two cameras on loopback addresses,
    then does what `dlo robot run` does on real arms: the unmodified ur_rtde client streams
    servo commands at 500 Hz, the cameras are network streams, the tracker sees the cable through
    them. Leaves a folder with report.html, a video, plots, metrics.json and the recording.

    Args:
        out: folder to make.
        seed: of the goal and the scene.
        steps: control periods of 0.1 s.
        speed: share of the step and speed limits.
        clutter: put industrial parts and other cables into the scene.
        occluders: panels that pass in front of the cameras.
        model: what the MPC plans on: the trained surrogate, or the rod itself.
        live: show the run in the rerun viewer.
        overwrite: replace the output folder if it exists and holds nothing but a former report.
    """
    out = out.resolve()
    check_output_folder(out, MADE, overwrite=overwrite)
    config = CellConfig.load(TEMPLATES / "emulated.toml")
    control = config.control.model_copy(update={"model": model})
    config = config.model_copy(update={"control": control})
    console = Console()
    partial = out.with_name(f".{out.name}.part-{os.getpid()}")
    with ExitStack() as stack:
        partial.mkdir(parents=True)
        stack.callback(shutil.rmtree, partial, ignore_errors=True)
        with console.status("starting two controllers and the world"):
            stack.enter_context(
                EmulatedCell.of(
                    config,
                    clutter="industrial" if clutter else "none",
                    n_distractor_cables=3 if clutter else 0,
                    n_occluders=occluders,
                    seed=seed,
                )
            )
            robot = stack.enter_context(RobotCell(config))
            robot.open()
            goal = make_goal("sampled", config, robot.boundary, seed)
        metrics = steer(
            robot,
            ClosedLoop(config, goal, speed),
            steps=steps,
            recoveries=RECOVERIES,
            recording=partial / "recording",
            settings={"goal": goal.tolist(), "speed": speed, "seed": seed},
            live=live,
            console=console,
        )
        robot.close()
        if not metrics["steps"]:
            raise DloError(metrics["stopped"])
        source = Recording.load(partial / "recording")
        metrics |= _true_metrics(source, goal, config)
        write_metrics(partial / "metrics.json", metrics)
        _draw(partial, source, goal, config, console)
        write_page(
            partial / "report.html",
            title="Shape control through two emulated UR5e",
            metrics=metrics,
            video="views.mp4",
            picture="views.png",
            plots=["plots.png"],
            command=f"dlo robot demo --seed {seed} --steps {steps} --speed {speed}"
            f" --{'' if clutter else 'no-'}clutter --occluders {occluders} --model {model}",
        )
        replace_folder(partial, out)
    console.print(summary(metrics))
    console.print(f"report: {out / 'report.html'}", highlight=False, soft_wrap=True, markup=False)
    if metrics["stopped"]:
        raise DloError(metrics["stopped"])


def _true_metrics(source: Recording, goal: Array, config: CellConfig) -> dict[str, Any]:
    """The figures of the report, on the true cable at the images' time."""
    truth = _truth(source)
    errors = 1e3 * ptp_3d(truth, np.broadcast_to(goal, truth.shape)).mean(axis=1)
    visible = np.stack(list(source.visible.values()))
    final = float(errors[-1])
    return {
        "initial_shape_error_mm": float(errors[0]),
        "final_shape_error_mm": final,
        "tracking_ptp3d_mm": 1e3 * float(ptp_3d(source.extra["estimate"], truth).mean()),
        "occlusion_percent": 100.0 * occlusion_ratio(visible),
        "success": final <= 1e3 * config.control.success_threshold_m,
    }


def _truth(source: Recording) -> Array:
    if source.centerline is None:
        raise DloError(f"{source.name}: expected the emulated world's truth in the recording")
    return source.centerline


def _draw(
    folder: Path, source: Recording, goal: Array, config: CellConfig, console: Console
) -> None:
    """Video, poster and plots of a recorded run."""
    truth, estimate = _truth(source), source.extra["estimate"]
    errors = ptp_3d(truth, np.broadcast_to(goal, truth.shape)).mean(axis=1)
    poster: NDArray[np.uint8] | None = None
    with EpisodeVideo(folder / "views.mp4", source.rate_hz) as video:
        for sample in track(range(len(source)), "drawing", console=console, transient=True):
            image = _picture(source, sample, goal, 1e3 * errors[sample])
            video.append(image)
            if poster is None or errors[sample] > 0.5 * errors[0]:
                poster = image
    assert poster is not None
    imageio.imwrite(folder / "views.png", poster)
    plot_episode(
        folder / "plots.png",
        stamps=source.stamps,
        shape_error=errors,
        tracking_error=ptp_3d(estimate, truth).mean(axis=1),
        occlusion=[
            occlusion_ratio(np.stack([seen[sample] for seen in source.visible.values()]))
            for sample in range(len(source))
        ],
        control_ms=source.extra["control_ms"],
        tracking_ms=source.extra["tracking_ms"],
        success_threshold=config.control.success_threshold_m,
    )


def _picture(source: Recording, sample: int, goal: Array, error_mm: float) -> NDArray[np.uint8]:
    estimate, visible = source.extra["estimate"][sample], source.extra["estimate_visible"][sample]
    return side_by_side(
        [
            draw_overlay(
                view,
                estimate,
                visible=seen,
                truth=_truth(source)[sample],
                goal=goal,
                caption=f"{view.camera.name}, {source.stamps[sample]:.1f} s,"
                f" {error_mm:.1f} mm to the goal",
            )
            for view, seen in zip(source.views(sample), visible, strict=True)
        ]
    )
