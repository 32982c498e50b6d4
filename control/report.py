"""An episode as a folder to look at: plots, video of all views, one HTML page."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import jinja2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

SEEN_COLOUR, LIMIT_COLOUR = "#0a6ebd", "#c8501e"


class EpisodeVideo:
    """An H.264 video of images of one size, written under a temporary name until complete."""

    def __init__(self, path: Path, frame_rate: float) -> None:
        self.path = path
        self._partial = path.with_name(f".{path.stem}.part{path.suffix}")
        self._writer = imageio.get_writer(
            self._partial, fps=frame_rate, codec="libx264", quality=7, macro_block_size=2
        )

    def append(self, image: NDArray[np.uint8]) -> None:
        self._writer.append_data(image)

    def close(self) -> None:
        self._writer.close()
        if self._partial.exists():
            os.replace(self._partial, self.path)

    def __enter__(self) -> "EpisodeVideo":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def side_by_side(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Images (h, w, 3) in a row, with even height and width as video needs them."""
    height = min(len(image) for image in images) // 2 * 2
    row = np.hstack([image[:height] for image in images])
    return np.ascontiguousarray(row[:, : row.shape[1] // 2 * 2])


def plot_episode(
    path: Path,
    *,
    stamps: ArrayLike,
    shape_error: ArrayLike,
    tracking_error: ArrayLike,
    occlusion: ArrayLike,
    control_ms: ArrayLike,
    tracking_ms: ArrayLike,
    success_threshold: float,
) -> None:
    """Four panels over time: shape error, tracking error, occlusion, computing times.

    Args:
        stamps: (T,) [s], the first before any command.
        shape_error, tracking_error: (T,) mean over the nodes, on the true rod [m].
        occlusion: (T,) share of nodes truly hidden, over all views, 0 to 1.
        control_ms, tracking_ms: (T,) of each step [ms]; NaN where there was none.
        success_threshold: mean node error that counts as success [m].
    """
    stamps = np.asarray(stamps, dtype=np.float64)
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "svg.fonttype": "none"}):
        figure = Figure(figsize=(10, 6), layout="constrained")
        shape, tracking, hidden, times = figure.subplots(2, 2, sharex=True).ravel()
        _line(shape, stamps, 1e3 * np.asarray(shape_error), "shape error to the goal [mm]")
        shape.axhline(1e3 * success_threshold, color=LIMIT_COLOUR, linewidth=1, linestyle="--")
        shape.set_yscale("log")
        _line(tracking, stamps, 1e3 * np.asarray(tracking_error), "tracking PTP3D [mm]")
        tracking.set_ylim(bottom=0)
        _line(hidden, stamps, 100 * np.asarray(occlusion), "nodes hidden, both views [%]")
        hidden.set_ylim(0, 100)
        hidden.fill_between(stamps, 100 * np.asarray(occlusion), color=SEEN_COLOUR, alpha=0.15)
        _line(times, stamps, np.asarray(control_ms), "computing time [ms]", label="control")
        times.plot(stamps, np.asarray(tracking_ms), color=LIMIT_COLOUR, label="tracking")
        times.set_ylim(bottom=0)
        times.legend(frameon=False)
        for axes in (hidden, times):
            axes.set_xlabel("time [s]")
        partial = path.with_name(f".{path.stem}.part{path.suffix}")
        figure.savefig(partial, dpi=130)
    os.replace(partial, path)


def write_page(
    path: Path,
    *,
    title: str,
    metrics: Mapping[str, Any],
    video: str,
    picture: str,
    plots: Sequence[str],
    command: str,
) -> None:
    """One HTML page that shows the files beside it, given by their names."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True
    )
    page = environment.get_template("report.html").render(
        title=title,
        metrics=metrics,
        video=video,
        picture=picture,
        plots=plots,
        command=command,
    )
    partial = path.with_name(f".{path.name}.part")
    partial.write_text(page)
    os.replace(partial, path)


def _line(axes: Axes, x: NDArray, y: NDArray, title: str, label: str | None = None) -> None:
    axes.plot(x, y, color=SEEN_COLOUR, label=label)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(alpha=0.25)
