"""A run as the rerun viewer shows it: images, shapes in space, forces, timing, a log."""

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.overlay import GOAL, SEEN
from dlo_gym.scene.arms import SIDES
from dlo_gym.scene.viewer import SceneViewer
from sim2real.config import CellConfig
from sim2real.steps import CellStep

AHEAD = (245, 205, 60)


class LiveView:
    """Shows the steps of a run in the rerun viewer, or writes them to a file for it.

    A context manager; leaving it hands the last data over.

    Args:
        config: of the cell.
        goal: (n_nodes, 3) goal centerline, world [m].
        spawn, save: see ``SceneViewer``.

    Raises:
        MissingExtra, RenderingUnavailable, FileExistsError, ValueError: as ``SceneViewer``.
    """

    def __init__(
        self, config: CellConfig, goal: Array, *, spawn: bool = True, save: Path | None = None
    ) -> None:
        self._goal = np.asarray(goal, dtype=np.float64)
        cameras = config.camera_models
        self._viewer = SceneViewer(
            [camera.name for camera in cameras],
            config.dual_arm,
            ("error", "wrench", "timing"),
            spawn=spawn,
            save=save,
        )
        self._viewer.show_curve("goal", self._goal, GOAL, static=True)
        for camera in cameras:
            self._viewer.show_camera(camera, static=True)
            self._viewer.show_drawn("goal", camera, self._goal, GOAL, static=True)

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
        viewer, output = self._viewer, step.output
        viewer.set_time(step.sent)
        viewer.show_curve("cable/seen", output.estimate.centerline, SEEN)
        viewer.show_curve("cable/ahead", output.ahead, AHEAD)
        for view in step.given.views:
            viewer.show_image(view)
            viewer.show_drawn("tracked", view.camera, output.estimate.centerline, SEEN)
        viewer.show_clamps(step.given.commanded if step.accepted is None else step.accepted)
        viewer.show_arms(step.given.joint_angles)
        viewer.show_numbers(self._numbers(step))
        if step.begins:
            self.note("takes over from where the arms are")
        for cut in output.decision.cuts:
            self.note(f"cut by the safety gate: {cut}")

    def note(self, text: str, *, level: str = "WARN") -> None:
        """A line in the log, at the time of the last step."""
        self._viewer.note(text, level=level)

    def close(self) -> None:
        """Hands over what is left; the viewer stays open. Closing twice does no harm."""
        self._viewer.close()

    def _numbers(self, step: CellStep) -> dict[str, float]:
        error = np.linalg.norm(step.output.estimate.centerline - self._goal, axis=1).mean()
        numbers = {
            "error/goal_distance_mm": 1e3 * float(error),
            "timing/tracking_ms": step.output.tracking_ms,
            "timing/control_ms": step.output.control_ms,
            "timing/image_age_ms": 1e3 * (step.sent - step.given.stamp),
            "timing/late_ms": 1e3 * step.late,
        }
        for side, wrench in zip(SIDES, step.wrenches, strict=True):
            numbers[f"wrench/{side}/force_n"] = float(np.linalg.norm(wrench[:3]))
            numbers[f"wrench/{side}/torque_nm"] = float(np.linalg.norm(wrench[3:]))
        return numbers
