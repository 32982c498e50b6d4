"""A run as the rerun viewer shows it: images, shapes in space, forces, timing, a log."""

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from dlo_gym.exceptions import MissingExtra
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array
from dlo_gym.overlay import GOAL, SEEN
from dlo_gym.scene.arms import SIDES
from sim2real.config import CellConfig
from sim2real.steps import CellStep

AHEAD = (245, 205, 60)
JPEG_QUALITY = 80
RADIUS = 0.0025  # of the lines in space [m]
AXIS = 0.05  # of the grippers' frames [m]
TIMELINE = "run"


class LiveView:
    """Shows the steps of a run in the rerun viewer, or writes them to a file for it.

    A context manager; leaving it hands the last data over.

    Args:
        config: of the cell.
        goal: (n_nodes, 3) goal centerline, world [m].
        spawn: whether to open the viewer.
        save: an .rrd file to write instead.

    Raises:
        MissingExtra: if rerun-sdk is not installed.
        ValueError: if there is neither a viewer nor a file.
    """

    def __init__(
        self, config: CellConfig, goal: Array, *, spawn: bool = True, save: Path | None = None
    ) -> None:
        try:
            import rerun as rr
        except ImportError as error:
            raise MissingExtra("rerun-sdk", "view") from error
        if save is None and not spawn:
            raise ValueError("spawn, save: expected a viewer to open or a file to write, got none")
        self._rr = rr
        self._cameras = {camera.name: camera for camera in config.camera_models}
        self._goal = np.asarray(goal, dtype=np.float64)
        self._stream = rr.RecordingStream("dlo-gym")
        if save is not None:
            self._stream.save(save)
        else:
            self._stream.spawn()
        self._stream.send_blueprint(_layout(list(self._cameras)))
        self._show_scene()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self.note(f"stopped: {error}", level="ERROR")
        self.close()

    def show(self, step: CellStep) -> None:
        """Everything of one control step, at the time its command went out."""
        self._stream.set_time(TIMELINE, duration=step.sent)
        output = step.output
        self._show_curve("world/cable/seen", output.estimate.centerline, SEEN)
        self._show_curve("world/cable/ahead", output.ahead, AHEAD)
        for view in step.given.views:
            at = f"world/cameras/{view.camera.name}"
            image = self._rr.Image(view.image).compress(jpeg_quality=JPEG_QUALITY)
            self._log(f"{at}/image", image)
            self._show_drawn(f"{at}/image/tracked", view.camera, output.estimate.centerline, SEEN)
        boundary = step.given.commanded if step.accepted is None else step.accepted
        for side, clamp in zip(SIDES, (boundary.left, boundary.right), strict=True):
            assert clamp is not None
            self._log(
                f"world/grippers/{side}",
                self._rr.Transform3D(translation=clamp[:3, 3], mat3x3=clamp[:3, :3]),
            )
        self._show_numbers(step)
        if step.begins:
            self.note("takes over from where the arms are")
        for cut in output.decision.cuts:
            self.note(f"cut by the safety gate: {cut}")

    def note(self, text: str, *, level: str = "WARN") -> None:
        """A line in the log, at the time of the last step."""
        self._log("log", self._rr.TextLog(text, level=level))

    def close(self) -> None:
        """Hands over what is left; the viewer stays open. Closing twice does no harm."""
        self._stream.flush()
        self._stream.disconnect()

    def _show_scene(self) -> None:
        """What does not change."""
        rr = self._rr
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._show_curve("world/goal", self._goal, GOAL, static=True)
        for name, camera in self._cameras.items():
            at = f"world/cameras/{name}"
            T = camera.T_world_camera
            self._log(at, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
            pinhole = rr.Pinhole(
                image_from_camera=camera.K,
                width=camera.width,
                height=camera.height,
                image_plane_distance=0.2,
            )
            self._log(f"{at}/image", pinhole, static=True)
            self._show_drawn(f"{at}/image/goal", camera, self._goal, GOAL, static=True)
        for side in SIDES:
            self._log(f"world/grippers/{side}", rr.TransformAxes3D(AXIS), static=True)

    def _show_curve(
        self, entity: str, curve: Array, colour: tuple[int, int, int], *, static: bool = False
    ) -> None:
        strips = self._rr.LineStrips3D([curve], colors=[colour], radii=RADIUS)
        self._log(entity, strips, static=static)

    def _show_drawn(
        self,
        entity: str,
        camera: CameraModel,
        curve: Array,
        colour: tuple[int, int, int],
        *,
        static: bool = False,
    ) -> None:
        """The part of a curve (n, 3) in front of a camera, distorted as its images are."""
        pixels = camera.project(curve)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        self._log(entity, self._rr.LineStrips2D([pixels], colors=[colour]), static=static)

    def _show_numbers(self, step: CellStep) -> None:
        error = np.linalg.norm(step.output.estimate.centerline - self._goal, axis=1).mean()
        numbers = {
            "error/goal_distance_mm": 1e3 * error,
            "timing/tracking_ms": step.output.tracking_ms,
            "timing/control_ms": step.output.control_ms,
            "timing/image_age_ms": 1e3 * (step.sent - step.given.stamp),
            "timing/late_ms": 1e3 * step.late,
        }
        for side, wrench in zip(SIDES, step.wrenches, strict=True):
            numbers[f"wrench/{side}/force_n"] = np.linalg.norm(wrench[:3])
            numbers[f"wrench/{side}/torque_nm"] = np.linalg.norm(wrench[3:])
        for entity, value in numbers.items():
            self._log(entity, self._rr.Scalars(float(value)))

    def _log(self, entity: str, what: Any, *, static: bool = False) -> None:
        self._stream.log(entity, what, static=static)


def _layout(cameras: list[str]) -> Any:
    """Images on the left, space in the middle, plots on the right, the log below."""
    import rerun.blueprint as rrb

    images = [
        rrb.Spatial2DView(origin=f"world/cameras/{name}/image", name=name) for name in cameras
    ]
    plots = [rrb.TimeSeriesView(origin=name, name=name) for name in ("error", "wrench", "timing")]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(*images),
                rrb.Spatial3DView(origin="world", name="cell"),
                rrb.Vertical(*plots),
            ),
            rrb.TextLogView(origin="log", name="log"),
            row_shares=[5, 1],
        )
    )
