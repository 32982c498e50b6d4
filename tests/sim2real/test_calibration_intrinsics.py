"""Intrinsics from synthetic views of a known camera."""

import numpy as np
import pytest

from sim2real.calibration.board import Detection
from sim2real.calibration.intrinsics import calibrate_intrinsics, coverage_grid
from tests.sim2real.calibration_data import BOARD, cell_cameras, views_by_hand

CAMERA = cell_cameras()["side"]
SIZE = (CAMERA.width, CAMERA.height)
TRUTH = np.concatenate([CAMERA.K[[0, 1, 0, 1], [0, 1, 2, 2]], CAMERA.distortion])


@pytest.fixture(scope="module")
def views():
    return views_by_hand(CAMERA, np.random.default_rng(0), 30)


def test_truth_lies_within_the_stated_deviations(views):
    found = calibrate_intrinsics(BOARD, views, SIZE)
    parameters = np.concatenate([found.K[[0, 1, 0, 1], [0, 1, 2, 2]], found.distortion])
    off = (parameters - TRUTH) / found.deviations
    assert np.abs(off).max() < 4.0
    assert 0.3 < np.sqrt(np.square(off).mean()) < 2.0
    assert np.abs(parameters[:2] / TRUTH[:2] - 1.0).max() < 0.005
    assert found.residual_px == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
    assert found.kept.all()
    assert found.coverage > 0.9


def test_a_view_that_does_not_fit_is_left_out_and_keeps_its_place(views):
    spoilt = list(views)
    wrong = spoilt[7].corners + np.random.default_rng(1).normal(0, 4.0, spoilt[7].corners.shape)
    spoilt[7] = Detection(spoilt[7].ids, wrong)
    spoilt.insert(3, Detection.nothing())
    found = calibrate_intrinsics(BOARD, spoilt, SIZE)
    assert np.flatnonzero(~found.kept).tolist() == [3, 8]
    assert np.isnan(found.view_residuals_px[3])
    assert found.view_residuals_px[8] > 2.0
    assert np.abs(found.K - CAMERA.K).max() < 6.0


def test_views_that_leave_parameters_open_are_told(views):
    # A board that never leaves the middle of the image, nor tilts, says little about the lens.
    rng = np.random.default_rng(2)
    pixels = np.mgrid[-3:4, -2:3].reshape(2, -1).T[:, ::1] * 12.0
    ids = np.array([(y + 2) * 7 + (x + 3) for x, y in np.mgrid[-3:4, -2:3].reshape(2, -1).T])
    order = np.argsort(ids)
    flat = [
        Detection(
            ids[order],
            pixels[order] * rng.uniform(0.9, 1.1)
            + np.array(SIZE) / 2
            + rng.uniform(-30, 30, 2)
            + rng.normal(0, 0.2, (35, 2)),
        )
        for _ in range(8)
    ]
    warnings = " ".join(calibrate_intrinsics(BOARD, flat, SIZE).warnings)
    assert "focal length is uncertain" in warnings
    assert "% of the image" in warnings
    assert calibrate_intrinsics(BOARD, views, SIZE).coverage > 0.6


def test_too_few_views_are_refused(views):
    with pytest.raises(ValueError, match="at least 5 .* got 4 of 6"):
        calibrate_intrinsics(BOARD, [*views[:4], Detection.nothing(), Detection.nothing()], SIZE)


def test_coverage_counts_corners_by_cell():
    counts = coverage_grid(np.array([[0.0, 0.0], [1279.0, 719.0], [1279.0, 0.0]]), (1280, 720))
    assert counts.shape == (5, 8)
    assert counts[0, 0] == counts[4, 7] == counts[0, 7] == 1
    assert counts.sum() == 3
