"""The board: found where it is, true to scale on paper."""

import pickle
import re

import cv2
import numpy as np
import pytest
from PIL import Image

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import exp_so3, inverse, pose, transform_points
from sim2real.calibration.board import BoardSpec, Detection, board, save_board
from tests.sim2real.calibration_data import BOARD

CAMERA = CameraModel.looking_at(
    "above", (0.05, -0.1, 0.6), (0.12, 0.09, 0.0), width=1280, height=720, focal_length=930.0
)
# Seen from above the printed side is up: z into the board is down.
T_WORLD_BOARD = pose(exp_so3([np.pi, 0.0, 0.0]), [0.0, 0.18, 0.0])


def photographed(camera, T_world_board, *, noise=3.0, per_square=60):
    """The board on grey ground, by a plane's homography, in the middle of a pixel's light."""
    printed = np.pad(BOARD.image(per_square), per_square // 2, constant_values=255)
    scale = BOARD.square_length_m / per_square
    # Pixel (0, 0) of the print is the centre of a texel half a square outside the pattern.
    to_board = np.array(
        [
            [scale, 0, (0.5 - per_square / 2) * scale],
            [0, scale, (0.5 - per_square / 2) * scale],
            [0, 0, 1],
        ]
    )
    T = inverse(camera.T_world_camera) @ T_world_board
    H = camera.K @ T[:3, [0, 1, 3]] @ to_board
    # Four times finer and averaged, as a sensor's pixels do.
    finer = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]])
    size = (4 * camera.width, 4 * camera.height)
    fine = cv2.warpPerspective(printed, finer @ H, size, flags=cv2.INTER_AREA, borderValue=120)
    image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noisy = image + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, -0.3, 1.2)])
def test_corners_are_found_where_they_are(turn):
    about = pose(exp_so3(turn), BOARD.centre) @ pose(np.eye(3), -BOARD.centre)
    T_world_board = T_WORLD_BOARD @ about
    found = BOARD.detect(photographed(CAMERA, T_world_board))
    truth = CAMERA.project(transform_points(T_world_board, BOARD.corners))
    assert found.ids.tolist() == list(range(BOARD.n_corners))
    off = found.corners - truth[found.ids]
    assert np.sqrt(np.square(off).mean()) < 0.12
    assert np.abs(off.mean(axis=0)).max() < 0.05


def test_a_board_that_is_half_outside_keeps_the_ids_of_what_is_seen():
    T_world_board = pose(np.eye(3), [0.42, 0.0, 0.0]) @ T_WORLD_BOARD
    found = BOARD.detect(photographed(CAMERA, T_world_board))
    assert 6 <= len(found) < BOARD.n_corners
    truth = CAMERA.project(transform_points(T_world_board, BOARD.corners))
    assert np.abs(found.corners - truth[found.ids]).max() < 1.0


def test_nothing_is_found_where_nothing_is():
    empty = np.full((720, 1280, 3), 120, dtype=np.uint8)
    assert len(BOARD.detect(empty)) == 0
    other = BoardSpec(dictionary="APRILTAG_36h11")
    assert len(other.detect(photographed(CAMERA, T_WORLD_BOARD))) == 0


def test_corners_on_one_line_tell_no_pose():
    row = np.arange(BOARD.squares_x - 1)
    pixels = np.column_stack([10.0 * row, np.zeros(len(row))])
    assert not Detection(row, pixels).spans_a_plane(BOARD)
    assert Detection(np.arange(14), np.zeros((14, 2))).spans_a_plane(BOARD)


def test_png_carries_its_scale(tmp_path):
    save_board(BOARD, tmp_path / "board.png")
    with Image.open(tmp_path / "board.png") as image:
        width_m = image.width / image.info["dpi"][0] * 0.0254
        grey = np.asarray(image)
    assert width_m == pytest.approx((BOARD.squares_x + 1) * BOARD.square_length_m, rel=1e-4)
    found = BOARD.detect(np.repeat(grey[..., None], 3, axis=2))
    across = found.corners[6] - found.corners[0]
    pixels_per_m = image.info["dpi"][0] / 0.0254
    assert np.linalg.norm(across) / pixels_per_m == pytest.approx(6 * 0.030, rel=1e-3)


def test_pdf_has_the_size_of_the_board(tmp_path):
    board(out=tmp_path / "board.pdf", square_length_m=0.025, marker_length_m=0.018)
    content = (tmp_path / "board.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", content)
    assert box is not None
    size = np.array([float(side) for side in box.groups()]) / 72 * 0.0254
    np.testing.assert_allclose(size, [9 * 0.025, 7 * 0.025], rtol=1e-3)


def test_an_existing_file_and_an_unknown_kind_are_refused(tmp_path):
    (tmp_path / "mine.pdf").write_text("mine")
    with pytest.raises(FileExistsError, match="mine.pdf"):
        board(out=tmp_path / "mine.pdf")
    assert (tmp_path / "mine.pdf").read_text() == "mine"
    with pytest.raises(ValueError, match="expected a file .pdf or .png"):
        board(out=tmp_path / "board.svg")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("squares_x", 2),
        ("square_length_m", 30.0),
        ("marker_length_m", 0.031),
        ("dictionary", "4X4"),
    ],
)
def test_a_wrong_field_is_named(field, value):
    with pytest.raises(ValueError, match=f"{field}: expected"):
        BoardSpec(**{field: value})


def test_a_board_larger_than_its_dictionary_is_refused():
    with pytest.raises(ValueError, match="need 60 markers, 4X4_50 has 50"):
        BoardSpec(squares_x=12, squares_y=10)


def test_specs_compare_by_value_and_can_be_pickled():
    used = BoardSpec()
    used.detect(np.zeros((20, 20), dtype=np.uint8))
    assert pickle.loads(pickle.dumps(used)) == BoardSpec()
