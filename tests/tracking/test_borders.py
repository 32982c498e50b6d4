import numpy as np
import pytest

from tracking.borders import centre_between_borders

CENTRE, RADIUS = 40.3, 3.0
# What a cable looks like from its upper to its lower border, on a background of 100.
SHADES = {
    "even": (lambda s: np.full_like(s, 220.0), 0.1),
    "lit from above": (lambda s: 250.0 - 65.0 * (1.0 + s), 0.45),
    "bright to dark through the background": (lambda s: 100.0 - 50.0 * s, 0.35),
}


def shaded_cable(shade, noise=1.0):
    """An image (80, 300, 3) of a level cable, antialiased, with ``shade`` from -1 to 1 across."""
    fine = np.arange(80 * 16) / 16 - 0.5 + 1 / 32
    across = (fine - CENTRE) / RADIUS
    column = np.where(np.abs(across) <= 1.0, shade(across), 100.0).reshape(80, 16).mean(axis=1)
    image = np.repeat(column[:, None, None], 300, axis=1).repeat(3, axis=2)
    image = image + np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def points_at(row):
    points = np.column_stack([np.arange(30.0, 270.0, 10.0), np.full(24, row)])
    return points, np.tile([1.0, 0.0], (len(points), 1))


@pytest.mark.parametrize("look", SHADES)
@pytest.mark.parametrize("start", [-2.0, 0.0, 2.0])
def test_the_centre_is_found_whatever_the_shading(look, start):
    shade, tolerance = SHADES[look]
    points, directions = points_at(CENTRE + start)
    found = centre_between_borders(shaded_cable(shade), points, directions, RADIUS, 10.0)
    np.testing.assert_allclose(found[:, 1], CENTRE, atol=tolerance)
    np.testing.assert_allclose(found[:, 0], points[:, 0])


def test_a_blank_image_moves_nothing():
    image = np.full((80, 300, 3), 100, np.uint8)
    points, directions = points_at(40.0)
    found = centre_between_borders(image, points, directions, RADIUS, 10.0)
    np.testing.assert_allclose(found, points)


def test_a_single_crossing_edge_moves_nothing_much():
    image = shaded_cable(SHADES["even"][0])
    image[:, 148:152] = 20
    points, directions = points_at(CENTRE)
    found = centre_between_borders(image, points, directions, RADIUS, 10.0)
    np.testing.assert_allclose(found[:, 1], CENTRE, atol=0.15)
