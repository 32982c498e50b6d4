"""Writes what a cell does to a recording, in a thread of its own beside the control loop."""

import queue
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.camera import View
from dlo_gym.recording import RecordingWriter
from dlo_gym.rod.boundary import BoundaryPoses
from sim2real.config import CellConfig
from sim2real.steps import CellStep
from sim2real.truth_source import TruthSource

BACKLOG = 200  # samples that may wait for the disk


class CellRecorder:
    """A ``RecordingWriter`` that never makes the control loop wait.

    A context manager; leaving it writes what is left and publishes the recording. Samples come
    with the emulated world's truth if there is one.

    Args:
        path: the folder to make.
        config: of the cell; kept in the recording, for a replay.
        run: further settings to keep.
        truth: where the true shape can be asked for.
        image_format: "png" keeps every bit, as a replay needs it; "jpg" is ten times smaller.

    Attributes:
        n_dropped: samples lost because the disk did not keep up.
    """

    def __init__(
        self,
        path: Path,
        config: CellConfig,
        run: Mapping[str, Any],
        *,
        truth: TruthSource | None = None,
        image_format: str = "png",
    ) -> None:
        self.n_dropped = 0
        self._truth = truth
        self._names = [camera.name for camera in config.camera_models]
        self._writer = RecordingWriter(
            path,
            config.camera_models,
            rod_length=config.rod.length_m,
            rod_radius=config.rod.radius_m,
            youngs_modulus=config.rod.youngs_modulus_pa,
            density=config.rod.density_kg_m3,
            rate_hz=1.0 / config.control.period_s,
            image_format=image_format,
            run={**run, "cell": config.model_dump(mode="json", by_alias=True)},
        )
        self._queue: queue.Queue[tuple[Any, ...] | None] = queue.Queue(BACKLOG)
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(
        self,
        views: tuple[View, ...],
        boundary: BoundaryPoses,
        stamp: float,
        *,
        taken: float | None = None,
        extra: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Adds one sample; ``taken`` is the images' monotonic time [s], for the truth.

        Raises:
            OSError: if an earlier sample could not be written.
        """
        if self._error is not None:
            raise OSError(f"recording: {self._error}") from self._error
        try:
            self._queue.put_nowait((views, boundary, stamp, taken, extra))
        except queue.Full:
            self.n_dropped += 1

    def close(self) -> None:
        """Writes what waits and publishes the recording.

        Raises:
            OSError: if it could not be written.
        """
        if not self._thread.is_alive() and self._queue.empty():
            return
        self._queue.put(None)
        self._thread.join()
        if self._error is not None:
            raise OSError(f"recording: {self._error}") from self._error

    def _write(self) -> None:
        try:
            with self._writer:
                while (sample := self._queue.get()) is not None:
                    self._append(*sample)
        except (OSError, ValueError) as error:
            self._error = error

    def _append(
        self,
        views: tuple[View, ...],
        boundary: BoundaryPoses,
        stamp: float,
        taken: float | None,
        extra: Mapping[str, ArrayLike] | None,
    ) -> None:
        centerline = visible = None
        if self._truth is not None and taken is not None:
            truth = self._truth.at(taken)
            centerline = truth.centerline
            visible = np.stack([truth.visible[name] for name in self._names])
        self._writer.append(
            views,
            boundary.left,
            boundary.right,
            stamp,
            centerline=centerline,
            visible=visible,
            extra=extra,
        )


def step_signals(step: CellStep) -> dict[str, ArrayLike]:
    """What is kept of a control step beside images and clamps: its inputs, outputs and fate."""
    given, output = step.given, step.output
    sent = output.decision.target if step.accepted is None else step.accepted
    signals: dict[str, ArrayLike] = {
        "joint_angles": given.joint_angles,
        "wrenches": step.wrenches,
        "estimate": output.estimate.centerline,
        "estimate_visible": output.estimate.visible,
        "estimate_confidence": output.estimate.confidence,
        "ahead": output.ahead,
        "requested": output.requested.vector,
        "controller_status": np.str_(f"{output.status:.120s}"),
        "safety_cuts": np.str_(f"{'; '.join(map(str, output.decision.cuts)):.240s}"),
        "tracking_ms": output.tracking_ms,
        "control_ms": output.control_ms,
        "sent_stamp": step.sent,
        "late": step.late,
        "begins": step.begins,
        "dry_run": step.accepted is None,
    }
    for name, boundary in (
        ("commanded", given.commanded),
        ("target", output.decision.target),
        ("accepted", sent),
    ):
        assert boundary.right is not None
        signals[f"{name}_left"], signals[f"{name}_right"] = boundary.left, boundary.right
    return signals
