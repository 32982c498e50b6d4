"""A calibration as a folder to look at: one page, pictures, metrics.json."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, inverse, log_so3
from dlo_gym.output_folder import replace_folder
from sim2real.calibration.board import BoardSpec
from sim2real.calibration.hand_eye import project_board
from sim2real.calibration.intrinsics import Intrinsics, coverage_grid
from sim2real.calibration.residuals import GOOD, USABLE
from sim2real.calibration.samples import Sample
from sim2real.calibration.solve import CellCalibration

MADE = ("report.html", "residuals.png", "coverage.png", "metrics.json")
_KEPT, _REJECTED = "#0a6ebd", "#c8501e"


def write_report(
    out: Path,
    cell_name: str,
    board: BoardSpec,
    samples: Sequence[Sample],
    found: CellCalibration,
    lenses: Mapping[str, Intrinsics],
) -> None:
    """Makes the folder ``out``, replacing a former report.

    Args:
        out: folder to make.
        cell_name: for the title.
        board: that was carried.
        samples: all of them, in the order that ``found`` counts them.
        found: the calibration.
        lenses: intrinsics from the images alone, by camera; empty where they were kept.
    """
    partial = out.with_name(f".{out.name}.part-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        corners = {name: _corners(name, board, samples, found) for name in found.geometry.cameras}
        with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False}):
            _plot_residuals(partial / "residuals.png", samples, found, corners)
            _plot_coverage(partial / "coverage.png", found, corners)
        metrics = report_metrics(samples, found, lenses)
        (partial / "metrics.json").write_text(json.dumps(metrics, indent=1))
        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True
        )
        page = environment.get_template("report.html").render(
            title=f"Calibration of cell {cell_name}", metrics=metrics, good=GOOD, usable=USABLE
        )
        (partial / "report.html").write_text(page)
        replace_folder(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def report_metrics(
    samples: Sequence[Sample], found: CellCalibration, lenses: Mapping[str, Intrinsics]
) -> dict[str, Any]:
    """Everything the page shows, ready for JSON."""
    noise, geometry = found.adjustment.noise, found.geometry
    return {
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "residuals": {name: one._asdict() for name, one in found.residuals.items()},
        "deviations": {name: one._asdict() for name, one in found.adjustment.deviations.items()},
        "noise": {
            "corner_px": noise.corner_px,
            "position_mm": 1e3 * noise.position_m,
            "rotation_deg": float(np.degrees(noise.rotation_rad)),
        },
        "anchor": found.anchor,
        "cameras": {
            name: {
                "intrinsics_px": camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                "distortion": camera.distortion.tolist(),
                "T_world_camera": camera.T_world_camera.tolist(),
                "views": sum(view.camera == name for view in found.views),
                "rejected": [
                    samples[view.sample].name or str(view.sample)
                    for view in found.views
                    if view.camera == name and not view.kept
                ],
                "coverage": lenses[name].coverage if name in lenses else None,
                "warnings": list(lenses[name].warnings) if name in lenses else [],
            }
            for name, camera in geometry.cameras.items()
        },
        "methods": [
            {"arm": side, "camera": name, "method": method, "mm": off[0], "deg": off[1]}
            for (side, name), hand_eye in found.hand_eyes.items()
            for method, T_base_camera in hand_eye.by_method.items()
            for off in [
                _apart(
                    geometry.T_world_base[side] @ T_base_camera,
                    geometry.cameras[name].T_world_camera,
                )
            ]
        ],
    }


def result_table(found: CellCalibration) -> Table:
    """Residuals and deviations, for the terminal."""
    table = Table(
        "",
        "residual px",
        "mm",
        "deg",
        "uncertain by mm",
        "deg",
        "views (rejected)",
        title=f"calibration: {found.verdict}",
        box=None,
    )
    for name, residual in found.residuals.items():
        views = [view for view in found.views if name in ("all", view.camera)]
        deviation = found.adjustment.deviations.get(f"camera/{name}")
        table.add_row(
            name,
            *(f"{value:.2f}" for value in residual),
            *(("", "") if deviation is None else (f"{deviation.mm:.2f}", f"{deviation.deg:.3f}")),
            f"{len(views)} ({sum(not view.kept for view in views)})",
        )
    for name, deviation in found.adjustment.deviations.items():
        if name.startswith("base/"):
            table.add_row(
                f"{name[5:]} base", "", "", "", f"{deviation.mm:.2f}", f"{deviation.deg:.3f}", ""
            )
    return table


def _apart(first: Array, second: Array) -> tuple[float, float]:
    """Distance of two poses [mm], [degrees]."""
    off = inverse(first) @ second
    turn = float(np.degrees(np.linalg.norm(log_so3(off[:3, :3]))))
    return 1e3 * float(np.linalg.norm(off[:3, 3])), turn


def _corners(
    name: str, board: BoardSpec, samples: Sequence[Sample], found: CellCalibration
) -> Array:
    """(n, 5): u, v, their residuals [pixels], 1 if kept; of all corners a camera saw."""
    camera: CameraModel = found.geometry.cameras[name]
    rows = [np.zeros((0, 5))]
    for view in found.views:
        if view.camera != name:
            continue
        sample = samples[view.sample]
        detection = sample.detections[name]
        T = found.geometry.T_camera_board(name, sample)
        expected = project_board(camera, board, T, detection)
        kept = np.full((len(detection), 1), float(view.kept))
        rows.append(np.hstack([detection.corners, detection.corners - expected, kept]))
    return np.concatenate(rows)


def _plot_residuals(
    path: Path,
    samples: Sequence[Sample],
    found: CellCalibration,
    corners: Mapping[str, Array],
) -> None:
    figure = Figure(figsize=(10, 3.4 * len(corners)), layout="constrained")
    axes = figure.subplots(len(corners), 2, width_ratios=(1, 2), squeeze=False)
    for (name, rows), (scatter, bars) in zip(corners.items(), axes, strict=True):
        kept = rows[:, 4] > 0
        reach = 4.0 * float(np.sqrt(np.square(rows[kept, 2:4]).mean())) if kept.any() else 1.0
        for chosen, colour in ((kept, _KEPT), (~kept, _REJECTED)):
            inside = np.clip(rows[chosen, 2:4], -reach, reach)
            scatter.plot(*inside.T, ".", color=colour, markersize=2, alpha=0.5)
        scatter.set_xlim(-reach, reach)
        scatter.set_ylim(reach, -reach)
        scatter.set_aspect("equal")
        scatter.axhline(0, color="0.7", linewidth=0.7)
        scatter.axvline(0, color="0.7", linewidth=0.7)
        scatter.set_title(f"{name}: residuals of the corners [px]", loc="left", fontsize=10)
        views = [view for view in found.views if view.camera == name]
        colours = [_KEPT if view.kept else _REJECTED for view in views]
        bars.bar(range(len(views)), [view.px for view in views], color=colours)
        labels = [f"{samples[v.sample].side[0]}{samples[v.sample].name}" for v in views]
        bars.set_xticks(range(len(views)), labels, rotation=90, fontsize=7)
        top = 1.3 * max([view.px for view in views if view.kept], default=1.0)
        bars.set_ylim(0, max(top, 1.5 * GOOD.residual_px))
        bars.axhline(GOOD.residual_px, color="0.5", linewidth=1, linestyle="--")
        bars.set_title("of each view, orange: rejected [px]", loc="left", fontsize=10)
    figure.savefig(path, dpi=130)


def _plot_coverage(path: Path, found: CellCalibration, corners: Mapping[str, Array]) -> None:
    figure = Figure(figsize=(10, 3.4 * ((len(corners) + 1) // 2)), layout="constrained")
    grid = figure.subplots((len(corners) + 1) // 2, 2, squeeze=False).ravel()
    for axes in grid[len(corners) :]:
        axes.set_visible(False)
    for axes, (name, rows) in zip(grid, corners.items(), strict=False):
        _coverage(axes, found.geometry.cameras[name], rows[rows[:, 4] > 0])
        axes.set_title(f"{name}: corners that were used", loc="left", fontsize=10)
    figure.savefig(path, dpi=130)


def _coverage(axes: Axes, camera: CameraModel, rows: Array) -> None:
    counts = coverage_grid(rows[:, :2], (camera.width, camera.height))
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    axes.imshow(counts > 0, cmap="Greys", vmin=0, vmax=6, extent=extent, aspect="equal")
    size = np.linalg.norm(rows[:, 2:4], axis=1)
    top = max(float(np.quantile(size, 0.98)) if len(size) else 1.0, 1e-6)
    dots = axes.scatter(*rows[:, :2].T, c=size, s=3, cmap="viridis", vmin=0, vmax=top)
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.8)  # type: ignore[union-attr]
    bar.set_label("residual [px]")
    axes.set_xlim(*extent[:2])
    axes.set_ylim(*extent[2:])
