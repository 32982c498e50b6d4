"""Intrinsics of one camera from views of the board."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array
from sim2real.calibration.board import BoardSpec, Detection

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_FEWEST_VIEWS = 5
_GRID = (8, 5)  # cells across and down, in which coverage is counted


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera's intrinsics and how well the views determine them.

    Attributes:
        K: (3, 3) [pixels].
        distortion: (5,) k1 k2 p1 p2 k3.
        deviations: (9,) standard deviations, in the order of ``PARAMETERS``.
        residual_px: root mean square over the kept views' corners.
        view_residuals_px: (n,) of every view, rejected ones too; NaN where nothing was seen.
        kept: (n,) views that were used.
        coverage: share of the image's cells, 8 across and 5 down, with a corner in them.
        warnings: what the views leave open, each with what to do.
    """

    K: Array
    distortion: Array
    deviations: Array
    residual_px: float
    view_residuals_px: Array
    kept: NDArray[np.bool_]
    coverage: float
    warnings: tuple[str, ...]


def calibrate_intrinsics(
    board: BoardSpec,
    views: Sequence[Detection],
    image_size: tuple[int, int],
    *,
    largest_residual_px: float = 1.0,
) -> Intrinsics:
    """Calibrates one camera; views that do not fit the others are left out.

    Args:
        board: that was seen.
        views: what was detected in each image; empty ones keep their place.
        image_size: width and height [pixels].
        largest_residual_px: a view is rejected whose root mean square is above this and above
            three times the views' median.

    Raises:
        ValueError: if fewer than 5 views show enough of the board.
    """
    kept = np.array([view.spans_a_plane(board) for view in views], dtype=bool)
    residuals = np.full(len(views), np.nan)
    while True:
        if kept.sum() < _FEWEST_VIEWS:
            raise ValueError(
                f"views: expected at least {_FEWEST_VIEWS} that show the board and fit each"
                f" other, got {int(kept.sum())} of {len(views)}"
            )
        fit = _fit(
            board, [view for view, keep in zip(views, kept, strict=True) if keep], image_size
        )
        residuals[kept] = fit.view_residuals
        limit = max(largest_residual_px, 3.0 * float(np.median(fit.view_residuals)))
        worst = kept & (residuals > limit)
        if not worst.any():
            break
        # One at a time: the worst view may be what makes the others look bad.
        kept[np.nanargmax(np.where(worst, residuals, np.nan))] = False
    seen = np.concatenate([v.corners for v, keep in zip(views, kept, strict=True) if keep])
    coverage = float(coverage_grid(seen, image_size).astype(bool).mean())
    return Intrinsics(
        fit.K,
        fit.distortion,
        fit.deviations,
        fit.residual,
        residuals,
        kept,
        coverage,
        intrinsics_warnings(fit.K, fit.deviations, coverage, seen),
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    K: Array
    distortion: Array
    deviations: Array
    residual: float
    view_residuals: Array


def _fit(board: BoardSpec, views: Sequence[Detection], image_size: tuple[int, int]) -> _Fit:
    objects = [board.corners[view.ids].astype(np.float32) for view in views]
    images = [view.corners.astype(np.float32) for view in views]
    rms, K, distortion, _, _, deviations, _, per_view = cv2.calibrateCameraExtended(
        objects, images, image_size, np.eye(3), np.zeros(5)
    )
    return _Fit(
        np.array(K, dtype=np.float64),
        np.ravel(distortion)[:5].astype(np.float64),
        np.ravel(deviations)[:9].astype(np.float64),
        float(rms),
        np.ravel(per_view).astype(np.float64),
    )


def coverage_grid(corners: Array, image_size: tuple[int, int]) -> Array:
    """How many corners (n, 2) [pixels] fall into each cell of the image (5, 8)."""
    width, height = image_size
    counts = np.histogram2d(
        corners[:, 1],
        corners[:, 0],
        bins=(_GRID[1], _GRID[0]),
        range=((-0.5, height - 0.5), (-0.5, width - 0.5)),
    )
    return counts[0]


def intrinsics_warnings(
    K: Array, deviations: Array, coverage: float, corners: Array
) -> tuple[str, ...]:
    """What a set of views leaves open: weak parameters, uncovered parts of the image.

    Args:
        K: (3, 3) [pixels].
        deviations: (9,) in the order of ``PARAMETERS``.
        coverage: share of the image's cells with a corner.
        corners: (n, 2) all corners seen [pixels].
    """
    warnings = []
    focal = deviations[:2] / K[[0, 1], [0, 1]]
    if focal.max() > 0.005:
        warnings.append(
            f"focal length is uncertain by {100 * focal.max():.1f} %: add views with the board"
            " tilted by 30 to 45 degrees, near and far"
        )
    if deviations[2:4].max() > 5.0:
        warnings.append(
            f"principal point is uncertain by {deviations[2:4].max():.1f} px: add views tilted"
            " about both of the board's axes"
        )
    # A parameter is weak if, where corners were seen, it could shift them by a pixel.
    normalised = (corners - K[:2, 2]) / K[[0, 1], [0, 1]]
    radius = float(np.quantile(np.linalg.norm(normalised, axis=1), 0.99))
    effect = deviations[4:] * K[0, 0] * radius ** np.array([3, 5, 2, 2, 7])
    weak = [name for name, shift in zip(PARAMETERS[4:], effect, strict=True) if shift > 1.0]
    if weak:
        warnings.append(
            f"{', '.join(weak)} cannot be told apart from the rest by these views: add views with"
            " the board in the image's corners"
        )
    if coverage < 0.6:
        warnings.append(
            f"the board covered {100 * coverage:.0f} % of the image: add views near its borders"
        )
    return tuple(warnings)
