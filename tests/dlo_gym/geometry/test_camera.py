"""Projection and rays of the one camera model."""

import cv2
import numpy as np
import pytest

from dlo_gym.geometry import CameraModel, View

DISTORTION = (-0.2, 0.08, 1e-3, -2e-3, 0.01)


def camera(distortion=None, **options) -> CameraModel:
    return CameraModel.looking_at(
        "side", (0.05, -1.05, 0.42), (0.0, 0.0, 0.27), distortion=distortion, **options
    )


def points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform([-0.5, -0.3, 0.0], [0.5, 0.3, 0.6], (n, 3))


@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_project_agrees_with_opencv(distortion):
    model = camera(distortion)
    rotation = model.T_camera_world[:3, :3]
    expected, _ = cv2.projectPoints(
        points(), cv2.Rodrigues(rotation)[0], model.T_camera_world[:3, 3], model.K, model.distortion
    )
    np.testing.assert_allclose(model.project(points()), expected[:, 0], atol=1e-7)


@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_rays_pass_through_what_was_projected(distortion):
    model = camera(distortion)
    directions = points() - model.centre
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(model.rays(model.project(points())), directions, atol=1e-8)


def test_target_is_at_the_image_centre_and_up_is_up():
    model = camera()
    np.testing.assert_allclose(model.project([0.0, 0.0, 0.27]), [959.5, 539.5])
    assert model.project([0.0, 0.0, 0.30])[1] < 539.5
    assert model.project([0.1, 0.0, 0.27])[0] > 959.5


def test_points_behind_the_camera_are_nan_and_keep_their_index():
    pixels = camera().project([[0.0, 0.0, 0.3], [0.0, -2.0, 0.3]])
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1]).all()
    np.testing.assert_array_equal(camera().sees(pixels), [True, False])


@pytest.mark.parametrize("factor", [0.5, 1 / 3])
def test_scaled_camera_sees_the_resized_image(factor):
    model, small = camera(), camera().scaled(factor)
    assert (small.width, small.height) == (round(1920 * factor), round(1080 * factor))
    # The image's corner (-0.5, -0.5) stays the corner.
    expected = (model.project(points()) + 0.5) * factor - 0.5
    np.testing.assert_allclose(small.project(points()), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "image size"),
        ({"K": np.eye(2)}, "K must"),
        ({"K": np.diag([-1.0, 1.0, 1.0])}, "focal"),
        ({"K": np.eye(3) + np.diag([0.1, 0.0], 1)}, "skew"),
        ({"distortion": np.zeros(4)}, "distortion"),
        ({"T_world_camera": 2 * np.eye(4)}, "rigid"),
    ],
)
def test_impossible_cameras_are_named(change, message):
    good = {"name": "top", "width": 64, "height": 48, "K": np.eye(3), "T_world_camera": np.eye(4)}
    with pytest.raises(ValueError, match=f"'top'.*{message}"):
        CameraModel(**{**good, **change})


def test_view_refuses_an_image_of_another_size():
    with pytest.raises(ValueError, match=r"side.*\(1080, 1920, 3\).*\(4, 4, 3\)"):
        View(np.zeros((4, 4, 3), np.uint8), camera())
