"""``dlo track``: the tracker on a recording, measured."""

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import imageio.v2 as imageio
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dlo_gym.exceptions import TrackLost
from dlo_gym.geometry.camera import View
from dlo_gym.geometry.curves import resample
from dlo_gym.geometry.se3 import Array
from dlo_gym.interrupts import deferred_interrupt
from dlo_gym.metrics import distance_to_centerline, occlusion_ratio, ptp_2d, ptp_3d
from dlo_gym.output_folder import check_output_folder, replace_folder
from dlo_gym.overlay import draw_overlay
from dlo_gym.recording import Recording
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import ShapeEstimate
from tracking.occlusion import Patch, paste, random_patches
from tracking.predictors import make_predictor
from tracking.tracker import COMPONENTS, MultiViewTracker, TrackerConfig

OCCLUSION = (0.4, 0.2, 0.7)  # share of nodes hidden; from, to: shares of the duration
VIDEO_WIDTH = 960  # of each view [pixels]
PATCH_SIZE = 80 / 1920  # of the image width
N_PICTURES = 5


@dataclass(frozen=True)
class Occlusion:
    """Which patches cover which camera, and in which samples.

    Attributes:
        patches: per camera name.
        first, last: samples from ``first`` up to, not including, ``last``.
    """

    patches: dict[str, tuple[Patch, ...]] = field(default_factory=dict)
    first: int = 0
    last: int = 0

    def cover(self, view: View, sample: int) -> View:
        if not self.first <= sample < self.last:
            return view
        return paste(view, self.patches.get(view.camera.name, ()))


@dataclass
class Track:
    """What the tracker said about a recording, sample by sample.

    Attributes:
        estimates: one per sample processed.
        residuals: (cameras, n_nodes) distance of seen nodes from the seen centerline [pixels],
            per sample; NaN where hidden.
        lost: per sample whether the track was lost.
    """

    estimates: list[ShapeEstimate] = field(default_factory=list)
    residuals: list[Array] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)

    @property
    def centerline(self) -> Array:
        """(T, n_nodes, 3) [m]."""
        return np.stack([estimate.centerline for estimate in self.estimates])

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(cameras, T, n_nodes)."""
        return np.stack([estimate.visible for estimate in self.estimates], axis=1)


def track(
    recording: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path | None = None,
    predictor: Literal["network", "rod"] = "rod",
    triangulation: Literal["curve", "paper"] = "curve",
    occlude_seed: int | None = None,
    occlude_share: float = OCCLUSION[0],
    occlude_from: float = OCCLUSION[1],
    occlude_to: float = OCCLUSION[2],
    youngs_modulus: float | None = None,
    overlay: Literal["video", "pictures", "none"] = "video",
    overwrite: bool = False,
) -> None:
    """Track the cable in a recording.

    Writes estimate.npz (centerline (T, n, 3) [m], visible (cameras, T, n)), metrics.json, and
    the views with the tracked and the true centerline drawn in. Without truth.npz the metrics are
    reprojection residuals.

    Args:
        recording: folder in the format dlo-recording/1.
        out: folder to make; out/track-<name of the recording> if omitted.
        predictor: how the shape follows the grippers between images.
        triangulation: "curve" (the default) or the paper's, node by node.
        occlude_seed: paste opaque patches over all views, in the layout of this seed.
        occlude_share: share of the nodes that they hide in each view.
        occlude_from: when they appear, share of the recording's duration.
        occlude_to: when they are gone, share of the recording's duration.
        youngs_modulus: of the rod [Pa], if the recording does not say; 1e6 otherwise.
        overlay: what to draw.
        overwrite: replace the folder if it exists.
    """
    console = Console()
    source = Recording.load(recording)
    folder = (out or Path("out") / f"track-{source.name}").resolve()
    made = ("estimate.npz", "metrics.json", "overlay*")
    check_output_folder(folder, made, overwrite=overwrite)
    occlusion = Occlusion()
    if occlude_seed is None:
        if (occlude_share, occlude_from, occlude_to) != OCCLUSION:
            raise ValueError(
                "occlude_share, occlude_from, occlude_to: they say how --occlude-seed hides the"
                " cable; give that too"
            )
    elif occlude_seed < 0 or not 0.0 < occlude_share < 1.0:
        raise ValueError(
            "occlude_seed, occlude_share: expected a seed of 0 or more and a share between 0 and 1,"
            f" got {occlude_seed} and {occlude_share}"
        )
    else:
        occlusion = occlude(source, occlude_seed, occlude_share, (occlude_from, occlude_to))
    config = TrackerConfig(triangulation=triangulation)
    properties = rod_properties(source, youngs_modulus)
    tracker = make_tracker(source, properties, predictor, config)
    settings = {
        "recording": source.name,
        "predictor": predictor,
        "triangulation": triangulation,
        "occlude_seed": occlude_seed,
        "occluded_range": [occlusion.first, occlusion.last],
    }
    partial = folder.with_name(f".{folder.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    result = Track()
    pictures = _Pictures(partial, source, overlay)
    metrics: dict[str, Any] = {}
    with deferred_interrupt() as interrupt:
        try:
            with Progress(console=console, transient=True) as progress:
                task = progress.add_task("tracking", total=len(source))
                for views in follow(tracker, source, properties, result, occlusion):
                    pictures.add(views, result, len(result.estimates) - 1)
                    progress.advance(task)
                    if interrupt.requested:
                        break
                progress.update(task, description="writing the video")
                pictures.close()
        finally:  # what was finished before an interruption or a damaged image is kept
            pictures.close()
            complete = len(result.estimates) == len(source)
            if result.estimates and (complete or not folder.exists()):
                metrics = {**settings, "complete": complete, **evaluate(source, result)}
                _write(partial, result, metrics)
                replace_folder(partial, folder)
            shutil.rmtree(partial, ignore_errors=True)
    if not metrics:
        raise KeyboardInterrupt(f"the former result in {folder} stays")
    console.print(summary(metrics))
    console.print(f"written to {folder}", highlight=False, markup=False, soft_wrap=True)
    if not complete:
        raise KeyboardInterrupt(f"{len(result.estimates)} of {len(source)} samples were tracked")


def rod_properties(source: Recording, youngs_modulus: float | None = None) -> RodProperties:
    """The rod as far as the recording knows it; the rest from an argument or the defaults."""
    return RodProperties(
        source.rod_length,
        source.rod_radius,
        youngs_modulus=youngs_modulus or source.youngs_modulus or RodProperties.youngs_modulus,
        density=source.density or RodProperties.density,
    )


def boundaries(source: Recording) -> list[BoundaryPoses]:
    """The clamp poses of every sample."""
    right = source.clamp_right
    return [
        BoundaryPoses(left, None if right is None else right[sample])
        for sample, left in enumerate(source.clamp_left)
    ]


def make_tracker(
    source: Recording,
    properties: RodProperties,
    predictor: str = "rod",
    config: TrackerConfig | None = None,
) -> MultiViewTracker:
    """A tracker for a recording's cameras, with as many nodes as its truth has, 51 without."""
    if predictor == "network" and source.clamp_right is None:
        raise ValueError("predictor: the network knows no rod held by one gripper; take 'rod'")
    n_nodes = 51 if source.centerline is None else source.centerline.shape[1]
    model = make_predictor(predictor, properties, n_nodes)
    return MultiViewTracker(model, source.cameras, config=config)


def occlude(
    source: Recording, seed: int, share: float = 0.4, span: tuple[float, float] = (0.2, 0.7)
) -> Occlusion:
    """Patches over all views that hide about ``share`` of the nodes in each during ``span``.

    The rod's place is taken from the truth, or from the rod's equilibrium if there is none.
    """
    if not 0.0 <= span[0] < span[1] <= 1.0:
        raise ValueError(f"occlude_from, occlude_to: expected 0 <= from < to <= 1, got {span}")
    first, last = (round(fraction * len(source)) for fraction in span)
    samples = range(first, max(last, first + 1))
    if source.centerline is not None:
        shapes = source.centerline[samples.start : samples.stop]
    else:
        rod = CosseratRod(rod_properties(source))
        poses = boundaries(source)
        shapes = np.stack([rod.settle(poses[sample]).positions for sample in samples])
    rng = np.random.default_rng(seed)
    patches = {
        camera.name: random_patches(rng, camera.project(shapes), share, PATCH_SIZE * camera.width)
        for camera in source.cameras
    }
    return Occlusion(patches, samples.start, samples.stop)


def follow(
    tracker: MultiViewTracker,
    source: Recording,
    properties: RodProperties,
    result: Track,
    occlusion: Occlusion | None = None,
):
    """Tracks a recording, adding to ``result``; yields each sample's views as the tracker saw
    them. A lost track goes on from the prediction."""
    occlusion = occlusion or Occlusion()
    poses = boundaries(source)
    views = tuple(occlusion.cover(view, 0) for view in source.views(0))
    at_rest = poses[0].displacement_to(poses[0])
    # Once for nothing, so that no compilation is measured.
    tracker.initialise(poses[0], properties, stamp=float(source.stamps[0]))
    tracker.update(views, at_rest)
    tracker.initialise(poses[0], properties, stamp=float(source.stamps[0]))
    for sample in range(len(source)):
        if sample:
            views = tuple(occlusion.cover(view, sample) for view in source.views(sample))
        displacement = poses[max(sample - 1, 0)].displacement_to(poses[sample])
        lost = False
        try:
            tracker.update(views, displacement, float(source.stamps[sample]))
        except TrackLost:
            lost = True
        result.estimates.append(tracker.estimate)
        result.residuals.append(tracker.residuals)
        result.lost.append(lost)
        yield views


def evaluate(source: Recording, result: Track) -> dict[str, Any]:
    """The measures of Section VI for the samples of ``result``, for metrics.json."""
    count = len(result.estimates)
    residuals = np.stack(result.residuals, axis=1)
    totals = [estimate.timings_ms["total"] for estimate in result.estimates]
    names = [camera.name for camera in source.cameras]
    metrics: dict[str, Any] = {
        "samples": count,
        "lost": any(result.lost),
        "lost_samples": int(sum(result.lost)),
        "unseen_samples": int(sum(not estimate.seen for estimate in result.estimates)),
        "occlusion_percent": {
            name: 100.0 * occlusion_ratio(seen)
            for name, seen in zip(names, result.visible, strict=True)
        },
        "reprojection_residual_px": {
            name: _mean(values) for name, values in zip(names, residuals, strict=True)
        },
        "update_ms": _times(totals),
        "components_ms": {
            name: _times([estimate.timings_ms[name] for estimate in result.estimates])
            for name in COMPONENTS
        },
        "messages": {
            str(sample): estimate.message
            for sample, estimate in enumerate(result.estimates)
            if estimate.message
        },
    }
    if source.centerline is None:
        return metrics
    truth = source.centerline[:count]
    errors = 1e3 * ptp_3d(result.centerline, truth)
    metrics["ptp_3d_mm"] = float(errors.mean())
    metrics["ptp_3d_mm_max"] = float(errors.max())
    metrics["ptp_3d_mm_per_sample"] = errors.mean(axis=1).tolist()
    metrics["ptp_2d_percent"] = {}
    metrics["distance_to_centerline_percent"] = {}
    for camera in source.cameras:
        estimated, true = camera.project(result.centerline), camera.project(truth)
        metrics["ptp_2d_percent"][camera.name] = _mean(ptp_2d(estimated, true, camera.width))
        metrics["distance_to_centerline_percent"][camera.name] = _mean(
            [
                distance_to_centerline(points, _fine(curve), camera.width)
                for points, curve in zip(estimated, true, strict=True)
            ]
        )
    if source.visible:
        metrics["visibility_agreement_percent"] = {
            name: 100.0 * float((seen == source.visible[name][:count]).mean())
            for name, seen in zip(names, result.visible, strict=True)
            if name in source.visible
        }
    return metrics


def summary(metrics: dict[str, Any]) -> Table:
    """The main figures as a table."""
    table = Table("measure", "value", title=f"{metrics['recording']}: {metrics['samples']} samples")
    if "ptp_3d_mm" in metrics:
        table.add_row("PTP3D, mean over nodes and samples", f"{metrics['ptp_3d_mm']:.2f} mm")
        table.add_row("PTP3D, worst node", f"{metrics['ptp_3d_mm_max']:.2f} mm")
        table.add_row("PTP2D", _per_view(metrics["ptp_2d_percent"], "{:.3f} %"))
    table.add_row(
        "reprojection residual", _per_view(metrics["reprojection_residual_px"], "{:.2f} px")
    )
    table.add_row("nodes not seen", _per_view(metrics["occlusion_percent"], "{:.0f} %"))
    table.add_row("samples lost", str(metrics["lost_samples"]))
    for name, times in (("update", metrics["update_ms"]), *metrics["components_ms"].items()):
        table.add_row(f"{name}, median (p99)", f"{times['median']:.2f} ms ({times['p99']:.2f})")
    return table


class _Pictures:
    """Draws overlays while tracking: a video of all views side by side, and some pictures."""

    def __init__(self, folder: Path, source: Recording, kind: str) -> None:
        self._folder = folder
        self._source = source
        self._kind = kind
        wanted = np.linspace(0, len(source) - 1, min(N_PICTURES, len(source)))
        self._wanted = set(np.round(wanted).astype(int).tolist())
        self._video: Any = None
        if kind == "video":
            self._video = imageio.get_writer(
                folder / "overlay.mp4", fps=source.rate_hz, macro_block_size=2, quality=7
            )

    def add(self, views: Sequence[View], result: Track, sample: int) -> None:
        if self._kind == "none" or (self._kind == "pictures" and sample not in self._wanted):
            return
        estimate = result.estimates[sample]
        truth = None if self._source.centerline is None else self._source.centerline[sample]
        panels = []
        for view, visible in zip(views, estimate.visible, strict=True):
            drawn = draw_overlay(
                view,
                estimate.centerline,
                visible=visible,
                truth=truth,
                caption=f"{view.camera.name}  {estimate.stamp:.1f} s",
            )
            height = round(view.camera.height * VIDEO_WIDTH / view.camera.width / 2) * 2
            panels.append(cv2.resize(drawn, (VIDEO_WIDTH, height), interpolation=cv2.INTER_AREA))
        tallest = max(panel.shape[0] for panel in panels)
        frame = np.hstack([np.pad(p, ((0, tallest - p.shape[0]), (0, 0), (0, 0))) for p in panels])
        if self._video is not None:
            self._video.append_data(frame)
        if sample in self._wanted:
            file = self._folder / f"overlay_{sample:06d}.png"
            cv2.imwrite(str(file), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finishes the video; does nothing the second time."""
        if self._video is not None:
            self._video.close()
            self._video = None


def _write(folder: Path, result: Track, metrics: dict[str, Any]) -> None:
    np.savez(folder / "estimate.npz", centerline=result.centerline, visible=result.visible)
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n")


def _times(milliseconds: Sequence[float]) -> dict[str, float]:
    return {
        "median": float(np.median(milliseconds)),
        "p99": float(np.percentile(milliseconds, 99)),
    }


def _mean(values: Any) -> float | None:
    """Mean of what is not NaN; None, JSON's null, if all is."""
    values = np.asarray(values, dtype=np.float64)
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else None


def _fine(curve: Array) -> Array:
    """A projected centerline (n, 2) as a polyline fine enough to measure distances to."""
    flat = np.column_stack([curve, np.zeros(len(curve))])
    return resample(flat, 8 * len(curve))[:, :2]


def _per_view(values: dict[str, float | None], form: str) -> str:
    return ", ".join(
        f"{name} {'-' if value is None else form.format(value)}" for name, value in values.items()
    )
