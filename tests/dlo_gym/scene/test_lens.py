"""Sampling a distorted image from a pinhole image."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.scene.lens import Lens

CAMERA = CameraModel.looking_at(
    "cam", (0.0, -1.0, 0.4), (0.0, 0.0, 0.3), width=320, height=180, focal_length=230.0
)
BARREL = [-0.28, 0.09, 0.001, -0.002, -0.01]
PINCUSHION = [0.12, 0.03, 0.002, 0.001, 0.0]


def test_a_camera_without_distortion_is_its_own_pinhole():
    lens = Lens.of(CAMERA)
    image = np.zeros((180, 320, 3), dtype=np.uint8)
    assert lens.pinhole is CAMERA
    assert lens.apply(image) is image


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_every_pixel_is_sampled_where_its_ray_meets_the_pinhole_image(distortion):
    camera = replace(CAMERA, distortion=np.array(distortion))
    lens = Lens.of(camera)
    v, u = np.mgrid[0:180, 0:320]
    points = camera.centre + camera.rays(np.stack([u, v], axis=-1))
    expected = lens.pinhole.project(points)
    np.testing.assert_allclose(lens.map_x, expected[..., 0], atol=1e-3)
    np.testing.assert_allclose(lens.map_y, expected[..., 1], atol=1e-3)
    assert lens.pinhole.sees(expected).all()
    assert not lens.pinhole.is_distorted


def test_the_image_shows_a_point_where_the_distorted_camera_projects_it():
    camera = replace(CAMERA, distortion=np.array(BARREL))
    lens = Lens.of(camera)
    point = camera.centre + camera.rays([40.0, 30.0])
    u, v = lens.pinhole.project(point)
    y, x = np.mgrid[0 : lens.pinhole.height, 0 : lens.pinhole.width]
    blob = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18.0)
    image = lens.apply(blob.round().astype(np.uint8)).astype(float)
    rows, columns = np.mgrid[0:180, 0:320]
    weights = image / image.sum()
    centroid = [(columns * weights).sum(), (rows * weights).sum()]
    np.testing.assert_allclose(centroid, [40.0, 30.0], atol=0.1)


def test_a_distortion_that_folds_the_image_is_refused():
    with pytest.raises(ValueError, match=r"camera 'cam': distortion .* cannot be inverted"):
        Lens.of(replace(CAMERA, distortion=np.array([-2.0, 0.0, 0.0, 0.0, 0.0])))


def test_a_distortion_that_needs_a_huge_image_is_refused():
    wide = replace(CAMERA, K=np.array([[30.0, 0, 159.5], [0, 30.0, 89.5], [0, 0, 1.0]]))
    with pytest.raises(ValueError, match=r"camera 'cam': distortion .* needs a pinhole image of"):
        Lens.of(replace(wide, distortion=np.array([0.3, 0.2, 0.0, 0.0, 0.0])))
