import cv2
import numpy as np
import pytest

from dlo_gym.geometry import CameraModel, View
from dlo_gym.geometry.curves import resample
from dlo_gym.rod import RodProperties
from dlo_gym.rod.rod import CosseratRod
from tests.tracking.drawing import LENGTH, N_NODES, RADIUS, clamps, draw_cable
from tracking.acquisition import acquire

H = LENGTH / (N_NODES - 1)
FIXED = np.isin(np.arange(N_NODES), [0, 1, N_NODES - 2, N_NODES - 1])
PALE, YELLOW = (120, 122, 128), (250, 220, 20)


@pytest.fixture(scope="module")
def curled():
    """A stiff rod with a bend of its own, far from the straight soft rod's equilibrium."""
    properties = RodProperties(LENGTH, RADIUS, youngs_modulus=1e7, rest_curvature=(2.5, 2.5, 0.0))
    return CosseratRod(properties).settle(clamps()).positions


def distance(curve, truth):
    """Distance (n,) [m] of a curve's nodes from a true centerline."""
    return np.linalg.norm(curve[:, None] - resample(truth, 1000), axis=2).min(axis=1)


def with_distractor(view, truth, colour=YELLOW):
    """Another cable of starker contrast that crosses the tracked one and lies beside it."""
    shift = np.linspace(-0.02, 0.035, len(truth))[:, None] * np.array([0.0, 1.0, 0.4])
    points = np.round(16 * view.camera.project(truth + shift)[8:-8]).astype(np.int32)
    image = view.image.copy()
    cv2.polylines(image, [points], False, colour, 4, cv2.LINE_AA, 4)
    return View(image, view.camera)


def test_a_rod_of_other_properties_is_found_beside_a_starker_cable(cameras, hanging, curled):
    assert distance(hanging, curled).max() > 0.012
    views = [with_distractor(draw_cable(c, curled, colour=PALE), curled) for c in cameras[:2]]
    found = acquire(views, hanging, FIXED, H, RADIUS)
    assert found is not None
    curve, deviation = found
    assert distance(curve, curled).max() < 6e-3
    assert distance(curve, curled).mean() < 3e-3
    np.testing.assert_array_equal(curve[FIXED], hanging[FIXED])
    np.testing.assert_allclose(np.linalg.norm(np.diff(curve, axis=0), axis=1), H, rtol=2e-2)
    assert (deviation[~FIXED] > 0).all()


def test_a_rod_where_it_was_expected_stays_there(cameras, hanging):
    found = acquire([draw_cable(c, hanging) for c in cameras[:2]], hanging, FIXED, H, RADIUS)
    assert found is not None
    assert distance(found[0], hanging).max() < 1.5e-3


def test_the_search_is_reproducible(cameras, hanging, curled):
    views = [draw_cable(c, curled) for c in cameras[:2]]
    first = acquire(views, hanging, FIXED, H, RADIUS, seed=3)
    second = acquire(views, hanging, FIXED, H, RADIUS, seed=3)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first[0], second[0])


def test_nothing_is_found_where_nothing_is(cameras, hanging):
    rng = np.random.default_rng(0)
    noise = [
        View(rng.normal(150, 4, (c.height, c.width, 3)).astype(np.uint8), c) for c in cameras[:2]
    ]
    assert acquire(noise, hanging, FIXED, H, RADIUS) is None


def test_a_camera_that_looks_away_does_not_matter(cameras, hanging, curled):
    away = CameraModel.looking_at("away", (0, -1, 0.4), (0, -2, 0.4)).scaled(0.5)
    blank = View(np.zeros((away.height, away.width, 3), np.uint8), away)
    assert acquire([blank], hanging, FIXED, H, RADIUS) is None
    views = [draw_cable(c, curled) for c in cameras[:2]]
    alone, beside = (acquire(v, hanging, FIXED, H, RADIUS) for v in (views, [*views, blank]))
    assert alone is not None
    assert beside is not None
    np.testing.assert_array_equal(alone[0], beside[0])
