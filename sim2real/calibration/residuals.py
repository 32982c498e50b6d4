"""How far views are from what a calibration predicts, and what to call that."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import log_so3
from sim2real.calibration.adjustment import CellGeometry, Deviation
from sim2real.calibration.board import BoardSpec
from sim2real.calibration.hand_eye import board_pose, rms_px
from sim2real.calibration.samples import Sample

Verdict = Literal["good", "usable", "bad"]


class Limits(NamedTuple):
    """What a calibration may be off and still be called so."""

    residual_px: float
    residual_mm: float
    residual_deg: float
    deviation_mm: float
    deviation_deg: float
    rejected_share: float


GOOD = Limits(1.0, 0.7, 0.6, 0.7, 0.07, 0.2)
USABLE = Limits(2.0, 1.5, 1.2, 1.5, 0.15, 0.4)


@dataclass(frozen=True, eq=False)
class ViewResidual:
    """How far one view is from what the calibration predicts.

    Attributes:
        sample: index of the sample.
        camera: that saw it.
        px: root mean square over the corners.
        mm: of the board's middle, across the viewing direction.
        deg: of the board's orientation.
        kept: whether the view was used.
    """

    sample: int
    camera: str
    px: float
    mm: float
    deg: float
    kept: bool


class Residual(NamedTuple):
    """Root mean squares over the kept views."""

    px: float
    mm: float
    deg: float


def view_residuals(
    board: BoardSpec,
    samples: Sequence[Sample],
    geometry: CellGeometry,
    kept: set[tuple[int, str]],
) -> tuple[ViewResidual, ...]:
    """How far each view is from where the geometry puts its board."""
    residuals = []
    for k, sample in enumerate(samples):
        if sample.side not in geometry.T_tcp_board:
            continue
        for name, detection in sample.detections.items():
            if name not in geometry.cameras or not detection.spans_a_plane(board):
                continue
            camera = geometry.cameras[name]
            expected = geometry.T_camera_board(name, sample)
            seen = board_pose(camera, board, detection)
            centre = np.append(board.centre, 1.0)
            where, there = (seen @ centre)[:3], (expected @ centre)[:3]
            ray = there / np.linalg.norm(there)
            off = where - there
            across = off - (off @ ray) * ray
            turn = log_so3(expected[:3, :3].T @ seen[:3, :3])
            residuals.append(
                ViewResidual(
                    k,
                    name,
                    rms_px(camera, board, expected, detection),
                    1e3 * float(np.linalg.norm(across)),
                    float(np.degrees(np.linalg.norm(turn))),
                    (k, name) in kept,
                )
            )
    return tuple(residuals)


def summarise(views: Sequence[ViewResidual]) -> dict[str, Residual]:
    """Root mean squares over the kept views, by camera and over "all"."""
    kept = [view for view in views if view.kept]
    groups = {name: [v for v in kept if v.camera == name] for name in {v.camera for v in views}}
    return {
        name: Residual(
            *(
                float(np.sqrt(np.mean(np.square([getattr(view, unit) for view in group]))))
                if group
                else float("nan")
                for unit in ("px", "mm", "deg")
            )
        )
        for name, group in {**dict(sorted(groups.items())), "all": kept}.items()
    }


def judge(
    views: Sequence[ViewResidual],
    residuals: Mapping[str, Residual],
    deviations: Mapping[str, Deviation],
) -> tuple[Verdict, tuple[str, ...]]:
    """A verdict, and for every figure that is not good a sentence."""
    checks = [
        (f"camera {name!r}: residual {value:.2f} {unit}", value, f"residual_{unit}", _RESIDUAL_HELP)
        for name, residual in residuals.items()
        if name != "all"
        for unit, value in residual._asdict().items()
    ]
    checks += [
        (
            f"{name.replace('/', ' ')}: uncertain by {value:.2f} {unit}",
            value,
            f"deviation_{unit}",
            _DEVIATION_HELP,
        )
        for name, deviation in deviations.items()
        if not name.startswith("board/")
        for unit, value in deviation._asdict().items()
    ]
    for name in sorted({view.camera for view in views}):
        own = [view for view in views if view.camera == name]
        share = 1.0 - sum(view.kept for view in own) / len(own)
        said = f"camera {name!r}: {100 * share:.0f} % of the views rejected"
        checks.append((said, share, "rejected_share", _REJECTED_HELP))
    verdict: Verdict = "good"
    reasons = []
    for said, value, limit, advice in checks:
        good, usable = getattr(GOOD, limit), getattr(USABLE, limit)
        if value <= good:
            continue
        is_usable = value <= usable
        bound = usable if not is_usable else good
        unit = f"{100 * bound:.0f} %" if limit == "rejected_share" else f"{bound:g}"
        reasons.append(f"{said}, {'usable' if not is_usable else 'good'} is up to {unit}: {advice}")
        verdict = "bad" if not is_usable or verdict == "bad" else "usable"
    return verdict, tuple(reasons)


_RESIDUAL_HELP = (
    "check that the board is flat, measured and firm in the gripper, that the arm stood still and"
    " that its tool centre point is the controller's"
)
_DEVIATION_HELP = "add poses, turned by 25 to 35 degrees about different axes"
_REJECTED_HELP = "see in the report which, and why they differ"
