"""From samples to a calibrated cell: start, outliers, joint adjustment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, inverse
from sim2real.calibration.adjustment import Adjustment, CellGeometry, adjust
from sim2real.calibration.board import BoardSpec, Detection
from sim2real.calibration.hand_eye import (
    Degenerate,
    HandEye,
    check_rotations,
    rms_px,
    solve_eye_to_hand,
)
from sim2real.calibration.normal_equations import Noise
from sim2real.calibration.residuals import (
    Residual,
    Verdict,
    ViewResidual,
    judge,
    summarise,
    view_residuals,
)
from sim2real.calibration.samples import Sample

_REJECT_FACTOR = 3.5
_REJECT_FLOOR_PX = 0.8
_MOST_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class CellCalibration:
    """A calibrated cell and how good it is.

    Attributes:
        adjustment: cameras, bases, boards, deviations, noise.
        hand_eyes: the closed forms by (side, camera).
        views: residuals of every view that showed the board.
        residuals: over the kept views, by camera, and "all".
        anchor: the arm whose base the world is fixed to.
        verdict: "good", "usable" or "bad".
        reasons: why it is no better, and what to know besides; each with what to do.
    """

    adjustment: Adjustment
    hand_eyes: Mapping[tuple[str, str], HandEye]
    views: tuple[ViewResidual, ...]
    residuals: Mapping[str, Residual]
    anchor: str
    verdict: Verdict
    reasons: tuple[str, ...]

    @property
    def geometry(self) -> CellGeometry:
        return self.adjustment.geometry


def calibrate_cell(
    board: BoardSpec,
    samples: Sequence[Sample],
    cameras: Mapping[str, CameraModel],
    T_world_base: Mapping[str, Array],
    rng: np.random.Generator,
    *,
    refine_intrinsics: bool = False,
    lens_views: Mapping[str, Sequence[Detection]] | None = None,
    noise: Noise | None = None,
) -> CellCalibration:
    """Calibrates fixed cameras and the second base against the first.

    Args:
        board: that the arms carried in turn.
        samples: of one arm or both, in any order.
        cameras: intrinsics to start from; their poses are not used.
        T_world_base: (4, 4) by arm. The left one (the right one if only that has samples) stays;
            the other's is found if a camera saw the board in both grippers.
        rng: draws the subsets that vote on outliers.
        refine_intrinsics: whether to refine K and distortion together with the rest.
        lens_views: by camera, further views of the board held by hand, for the refinement.
        noise: to assume; estimated when omitted.

    Raises:
        Degenerate: if the samples cannot determine a camera; says what to add.
    """
    sides = sorted({sample.side for sample in samples})
    hand_eyes = _start(board, samples, cameras, rng)
    start, linked = _geometry(cameras, T_world_base, hand_eyes, sides)
    kept = [_only_inliers(index, sample, hand_eyes) for index, sample in _indexed(samples)]
    anchor = sides[0]
    free = [side for side in sides if side != anchor and side in linked]
    notes = [
        f"the {side} base stays as the cell file has it: no camera saw the board in both grippers"
        for side in sides
        if side not in linked
    ]
    adjustment = None
    for _ in range(_MOST_ROUNDS):
        for side in sides:
            _check_arm(side, kept)
        try:
            adjustment = adjust(
                board,
                kept,
                start,
                free_bases=free,
                refine_intrinsics=refine_intrinsics,
                lens_views=lens_views,
                noise=noise,
            )
        except ValueError as error:
            raise Degenerate(str(error)) from error
        again = _keep(board, samples, adjustment)
        if _views_of(again) == _views_of(kept):
            break
        kept, start = again, adjustment.geometry
    assert adjustment is not None
    views = view_residuals(board, samples, adjustment.geometry, _views_of(kept))
    residuals = summarise(views)
    verdict, reasons = judge(views, residuals, adjustment.deviations)
    return CellCalibration(
        adjustment, hand_eyes, views, residuals, anchor, verdict, (*reasons, *notes)
    )


def _start(
    board: BoardSpec,
    samples: Sequence[Sample],
    cameras: Mapping[str, CameraModel],
    rng: np.random.Generator,
) -> dict[tuple[str, str], HandEye]:
    hand_eyes, problems = {}, {}
    for side in sorted({sample.side for sample in samples}):
        own = [sample for sample in samples if sample.side == side]
        for name, camera in cameras.items():
            detections = [sample.detections.get(name, Detection.nothing()) for sample in own]
            T_base_tcp = np.stack([sample.T_base_tcp for sample in own])
            try:
                hand_eyes[side, name] = solve_eye_to_hand(
                    camera, board, T_base_tcp, detections, rng
                )
            except Degenerate as error:
                problems[side, name] = str(error)
    for name in cameras:
        if not any((side, name) in hand_eyes for side in ("left", "right")):
            why = "; ".join(
                f"{side} arm: {text}" for (side, other), text in problems.items() if other == name
            )
            raise Degenerate(f"camera {name!r} cannot be calibrated: {why or 'it has no samples'}")
    return hand_eyes


def _geometry(
    cameras: Mapping[str, CameraModel],
    T_world_base: Mapping[str, Array],
    hand_eyes: Mapping[tuple[str, str], HandEye],
    sides: Sequence[str],
) -> tuple[CellGeometry, set[str]]:
    """Where everything is to start with, and which arms' bases are tied to the first one's."""
    bases = {side: np.array(T, dtype=np.float64) for side, T in T_world_base.items()}
    linked = {sides[0]}
    for side in sides[1:]:
        shared = [name for name in cameras if (sides[0], name) in hand_eyes]
        shared = [name for name in shared if (side, name) in hand_eyes]
        if shared:
            best = max(shared, key=lambda name: int(hand_eyes[side, name].inliers.sum()))
            T_anchor_camera = hand_eyes[sides[0], best].T_base_camera
            T_anchor_base = T_anchor_camera @ inverse(hand_eyes[side, best].T_base_camera)
            bases[side] = bases[sides[0]] @ T_anchor_base
            linked.add(side)
    placed = {}
    for name, camera in cameras.items():
        side = next(side for side in sides if (side, name) in hand_eyes)
        T_world_camera = bases[side] @ hand_eyes[side, name].T_base_camera
        placed[name] = replace(camera, T_world_camera=T_world_camera)
    boards = {}
    for side in sides:
        own = [hand_eye for (other, _), hand_eye in hand_eyes.items() if other == side]
        if own:
            boards[side] = max(own, key=lambda one: int(one.inliers.sum())).T_tcp_board
    return CellGeometry(placed, bases, boards), linked


def _indexed(samples: Sequence[Sample]) -> list[tuple[int, Sample]]:
    """Each sample with its index among those of its arm."""
    counts = {"left": -1, "right": -1}
    indexed = []
    for sample in samples:
        counts[sample.side] += 1
        indexed.append((counts[sample.side], sample))
    return indexed


def _only_inliers(
    index: int, sample: Sample, hand_eyes: Mapping[tuple[str, str], HandEye]
) -> Sample:
    return replace(
        sample,
        detections={
            name: detection
            for name, detection in sample.detections.items()
            if (sample.side, name) in hand_eyes and hand_eyes[sample.side, name].inliers[index]
        },
    )


def _views_of(samples: Sequence[Sample]) -> set[tuple[int, str]]:
    return {(k, name) for k, sample in enumerate(samples) for name in sample.detections}


def _keep(board: BoardSpec, samples: Sequence[Sample], adjustment: Adjustment) -> list[Sample]:
    """The samples with the views that fit, judged without the poses' corrections.

    The median sets the limit, so that the wrong views do not widen it.
    """
    geometry = adjustment.geometry
    residuals = {
        (k, name): rms_px(
            geometry.cameras[name], board, geometry.T_camera_board(name, sample), detection
        )
        for k, sample in enumerate(samples)
        if sample.side in geometry.T_tcp_board
        for name, detection in sample.detections.items()
        if detection.spans_a_plane(board)
    }
    limit = max(_REJECT_FLOOR_PX, _REJECT_FACTOR * float(np.median(list(residuals.values()))))
    return [
        replace(
            sample,
            detections={
                name: detection
                for name, detection in sample.detections.items()
                if residuals.get((k, name), np.inf) <= limit
            },
        )
        for k, sample in enumerate(samples)
    ]


def _check_arm(side: str, kept: Sequence[Sample]) -> None:
    poses = [sample.T_base_tcp for sample in kept if sample.side == side and sample.detections]
    if len(poses) < 3:
        raise Degenerate(f"{side} arm: {len(poses)} poses fit each other, at least 5 are needed")
    check_rotations(np.stack(poses))
