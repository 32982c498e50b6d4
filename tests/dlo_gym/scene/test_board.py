"""A plate in a gripper is drawn where its pose says."""

import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.se3 import inverse, pose, transform_points
from dlo_gym.scene.arms import SIDES, T_CLAMP_TCP, DualArm
from dlo_gym.scene.board import BoardPlate
from dlo_gym.scene.builder import SceneConfig, build_spec, default_cameras
from dlo_gym.scene.renderer import SceneRenderer

ARMS = DualArm()
SIZE = (0.2, 0.15)
# Four black squares on white, one per corner of the picture, at different distances from it.
CENTRES = np.array([[0.03, 0.03], [0.17, 0.03], [0.16, 0.11], [0.03, 0.12]])


def picture(pixels_per_m=4000):
    image = np.full((round(SIZE[1] * pixels_per_m), round(SIZE[0] * pixels_per_m)), 255, np.uint8)
    for x, y in np.round(CENTRES * pixels_per_m).astype(int):
        image[y - 40 : y + 40, x - 40 : x + 40] = 0
    return image


def facing(side, camera, middle=(0.0, -0.1, 0.32)):
    """T_tcp_board of a plate that faces the camera while the arms are at home."""
    clamps = ARMS.forward_kinematics(ARMS.home)
    clamp = clamps.left if side == "left" else clamps.right
    assert clamp is not None
    rotation = camera.T_world_camera[:3, :3]  # z into the plate, away from the camera
    T_world_board = pose(rotation, np.array(middle) - rotation @ [*np.array(SIZE) / 2, 0.0])
    return inverse(clamp @ T_CLAMP_TCP[SIDES.index(side)]) @ T_world_board, T_world_board


@pytest.mark.parametrize("side", SIDES)
def test_the_picture_is_where_its_pose_says_and_not_mirrored(side):
    camera = default_cameras(0.5)[0]
    T_tcp_board, T_world_board = facing(side, camera)
    plate = BoardPlate(side, picture(), SIZE, T_tcp_board)
    with SceneRenderer(SceneConfig(cameras=(camera,), boards=(plate,))) as scene:
        below = np.column_stack([np.linspace(-0.2, 0.2, 51), np.zeros(51), np.full(51, -1.0)])
        scene.update(below, ARMS.forward_kinematics(ARMS.home), joint_angles=ARMS.home)
        try:
            grey = cv2.cvtColor(scene.render(camera.name).image, cv2.COLOR_RGB2GRAY)
        except RenderingUnavailable as error:
            pytest.skip(str(error))
    expected = camera.project(
        transform_points(T_world_board, np.column_stack([CENTRES, 0 * CENTRES[:, 0]]))
    )
    for u, v in expected:
        window = grey[round(v) - 12 : round(v) + 13, round(u) - 12 : round(u) + 13].astype(float)
        weight = np.clip(window.max() - window - 0.1 * np.ptp(window), 0.0, None)
        assert np.ptp(window) > 100
        y, x = np.mgrid[round(v) - 12 : round(v) + 13, round(u) - 12 : round(u) + 13]
        found = [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()]
        np.testing.assert_allclose(found, [u, v], atol=0.15)


def test_without_boards_the_scene_is_as_before():
    spec = build_spec(SceneConfig())
    assert not any("board" in geom.name for geom in spec.geoms)


def test_one_board_per_arm():
    plate = BoardPlate("left", picture(), SIZE, np.eye(4))
    with pytest.raises(ValueError, match="boards: expected at most one per arm, got left, left"):
        SceneConfig(boards=(plate, plate))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("side", "middle"),
        ("picture", np.zeros((4, 4))),
        ("size", (0.2, 0.0)),
        ("T_tcp_board", 2 * np.eye(4)),
        ("margin", -0.1),
    ],
)
def test_a_wrong_field_is_named(field, value):
    fields = {"side": "left", "picture": picture(), "size": SIZE, "T_tcp_board": np.eye(4)}
    with pytest.raises(ValueError, match=f"{field}: expected"):
        BoardPlate(**(fields | {field: value}))
