"""`dlo robot verify-calibration`: fresh samples against the calibration in the cell file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, inverse, log_so3, pose
from sim2real.calibration.adjustment import CellGeometry, Deviation, adjust
from sim2real.calibration.board import BoardSpec
from sim2real.calibration.calibrate import CalibrationRefused, load_samples
from sim2real.calibration.cell_file import changed_since_calibration
from sim2real.calibration.hand_eye import Degenerate, board_pose
from sim2real.calibration.residuals import (
    Residual,
    Verdict,
    ViewResidual,
    judge,
    summarise,
    view_residuals,
)
from sim2real.calibration.samples import Sample, SampleFolder
from sim2real.calibration.solve import calibrate_cell
from sim2real.config import CellConfig

FEWEST_SAMPLES = 3


class MovedLimits(NamedTuple):
    """By how much something may have moved, beyond twice what the samples leave open."""

    mm: float
    deg: float


MOVED_GOOD = MovedLimits(0.5, 0.05)
MOVED_USABLE = MovedLimits(1.5, 0.15)


@dataclass(frozen=True, eq=False)
class Verification:
    """How fresh samples fit a stored calibration.

    Attributes:
        residuals: by camera, and "all"; the board's place in each gripper is found anew.
        views: residuals of every view.
        moved: by how much ``camera/<name>`` and ``base/<side>`` seem to have moved, from a new
            calibration of the fresh samples; empty if these are too few or too alike for one.
        verdict: "good", "usable" or "bad".
        reasons: why it is no better.
    """

    residuals: Mapping[str, Residual]
    views: tuple[ViewResidual, ...]
    moved: Mapping[str, Deviation]
    verdict: Verdict
    reasons: tuple[str, ...]


def verify_calibration(cell: Path, /, *, samples: Path, seed: int = 0) -> None:
    """Measure whether the calibration in a cell file still holds; exit status 1 if it does not.

    Collect fresh samples first, into a folder of their own, with the board gripped anew:
    `dlo robot calibrate CELL --samples FOLDER --collect left --poses 8`, then `--collect right`.

    Args:
        cell: cell file; it is not changed.
        samples: folder of fresh samples, at least 3 of an arm; 8 or more also tell what has moved.
        seed: of the votes on outliers.
    """
    config = CellConfig.load(cell)
    edited = changed_since_calibration(config)
    folder = SampleFolder.open(samples)
    assert config.calibration is not None
    console = Console()
    if folder.digest() == config.calibration.hash.partition(":")[2]:
        raise ValueError(
            f"samples: {samples} is what the calibration was made from; collect fresh ones"
        )
    with console.status("finding the board in the images"):
        taken, _ = load_samples(config, folder)
    result = verify(
        folder.board,
        taken,
        {model.name: model for model in config.camera_models},
        {side: config.arms[side].T_world_base for side in config.arms},
        np.random.default_rng(seed),
    )
    console.print(_table(result))
    if edited:
        console.print(
            "- cameras, bases or tool centre points in the file were changed after the calibration"
            f" of {config.calibration.date}",
            highlight=False,
            soft_wrap=True,
        )
    for reason in result.reasons:
        console.print(f"- {reason}", highlight=False, markup=False, soft_wrap=True)
    if result.verdict == "bad":
        raise CalibrationRefused("the calibration does not hold any more; calibrate again")


def verify(
    board: BoardSpec,
    samples: Sequence[Sample],
    cameras: Mapping[str, CameraModel],
    T_world_base: Mapping[str, Array],
    rng: np.random.Generator,
) -> Verification:
    """Holds samples against cameras and bases as calibrated.

    Args:
        board: that was carried.
        samples: fresh ones, at least 3 of an arm.
        cameras: as calibrated.
        T_world_base: (4, 4) by arm, as calibrated.
        rng: draws the subsets that vote on outliers.

    Raises:
        ValueError: if the samples are too few.
    """
    geometry = CellGeometry(dict(cameras), dict(T_world_base), {})
    usable = [sample for sample in samples if any(len(d) for d in sample.detections.values())]
    for side in sorted({sample.side for sample in samples}):
        own = [sample for sample in usable if sample.side == side]
        if len(own) < FEWEST_SAMPLES:
            raise ValueError(
                f"samples: expected at least {FEWEST_SAMPLES} of the {side} arm that show the"
                f" board, got {len(own)}"
            )
        geometry.T_tcp_board[side] = _board_in_gripper(board, own, geometry)
    if not usable:
        raise ValueError("samples: none shows the board")
    geometry = adjust(board, usable, geometry, fixed_cameras=True).geometry
    shown = {(k, name) for k, sample in enumerate(samples) for name in sample.detections}
    views = view_residuals(board, samples, geometry, shown)
    residuals = summarise(views)
    moved, uncertain = _moved(board, usable, cameras, T_world_base, rng)
    verdict, reasons = judge(views, residuals, {})
    for name, by in moved.items():
        beyond = [m - 2 * u for m, u in zip(by, uncertain[name], strict=True)]
        if all(b <= good for b, good in zip(beyond, MOVED_GOOD, strict=True)):
            continue
        held = all(b <= limit for b, limit in zip(beyond, MOVED_USABLE, strict=True))
        verdict = "bad" if not held or verdict == "bad" else "usable"
        said = f"{name.replace('/', ' ')} seems to have moved by {by.mm:.1f} mm, {by.deg:.2f} deg"
        reasons = (*reasons, f"{said}: calibrate again")
    unseen = sorted(set(cameras) - {view.camera for view in views})
    if unseen:
        verdict = "bad"
        reasons = (*reasons, f"camera {', '.join(unseen)}: never saw the board")
    return Verification(residuals, views, moved, verdict, reasons)


def _board_in_gripper(board: BoardSpec, samples: Sequence[Sample], geometry: CellGeometry) -> Array:
    """T_tcp_board (4, 4) about which the views of one arm's samples agree."""
    each = []
    for sample in samples:
        T_tcp_world = inverse(geometry.T_world_base[sample.side] @ sample.T_base_tcp)
        for name, detection in sample.detections.items():
            if name in geometry.cameras and detection.spans_a_plane(board):
                camera = geometry.cameras[name]
                seen = board_pose(camera, board, detection)
                each.append(T_tcp_world @ camera.T_world_camera @ seen)
    stack = np.stack(each)
    rotation = Rotation.from_matrix(stack[:, :3, :3]).mean().as_matrix()
    middle = np.median((stack @ np.append(board.centre, 1.0))[:, :3], axis=0)
    return pose(rotation, middle - rotation @ board.centre)


def _moved(
    board: BoardSpec,
    samples: Sequence[Sample],
    cameras: Mapping[str, CameraModel],
    T_world_base: Mapping[str, Array],
    rng: np.random.Generator,
) -> tuple[dict[str, Deviation], dict[str, Deviation]]:
    try:
        fresh = calibrate_cell(board, samples, cameras, T_world_base, rng)
    except Degenerate:
        return {}, {}
    uncertain = {
        name: deviation
        for name, deviation in fresh.adjustment.deviations.items()
        if not name.startswith("board/")
    }
    moved = {}
    for name in uncertain:
        kind, key = name.split("/", 1)
        if kind == "camera":
            former, now = cameras[key].T_world_camera, fresh.geometry.cameras[key].T_world_camera
        else:
            former, now = T_world_base[key], fresh.geometry.T_world_base[key]
        by = inverse(former) @ now
        turn = float(np.degrees(np.linalg.norm(log_so3(by[:3, :3]))))
        moved[name] = Deviation(1e3 * float(np.linalg.norm(by[:3, 3])), turn)
    return moved, uncertain


def _table(result: Verification) -> Table:
    table = Table("", "px", "mm", "deg", "views", title=f"calibration: {result.verdict}", box=None)
    for name, residual in result.residuals.items():
        n = sum(name in ("all", view.camera) for view in result.views)
        table.add_row(name, *(f"{value:.2f}" for value in residual), str(n))
    for name, by in result.moved.items():
        table.add_row(
            f"{name.replace('/', ' ')}, moved by", "", f"{by.mm:.2f}", f"{by.deg:.3f}", ""
        )
    return table
