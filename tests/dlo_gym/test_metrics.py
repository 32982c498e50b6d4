import numpy as np
import pytest

from dlo_gym.metrics import distance_to_centerline, occlusion_ratio, ptp_2d, ptp_3d


def test_point_to_point_errors():
    truth = np.zeros((2, 4, 3))
    np.testing.assert_allclose(
        ptp_3d(truth + np.array([3.0, 0.0, 4.0]), truth), np.full((2, 4), 5.0)
    )
    pixels = np.zeros((4, 2))
    np.testing.assert_allclose(ptp_2d(pixels + np.array([0.0, 19.2]), pixels, 1920), np.ones(4))


def test_distance_to_centerline_ignores_sliding_along_it():
    curve = np.column_stack([np.linspace(0, 100, 11), np.zeros(11)])
    slid = curve[1:-1] + np.array([3.0, 2.0])
    np.testing.assert_allclose(distance_to_centerline(slid, curve, 200), np.ones(9))
    beyond = np.array([[103.0, 4.0]])
    np.testing.assert_allclose(distance_to_centerline(beyond, curve, 100), [5.0])


def test_distance_to_a_repeated_point_is_finite():
    assert distance_to_centerline([[3.0, 4.0]], np.zeros((3, 2)), 100)[0] == pytest.approx(5.0)


def test_occlusion_ratio():
    assert occlusion_ratio([True, False, True, True]) == 0.25
    assert np.isnan(occlusion_ratio(np.zeros((0, 51), dtype=bool)))


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: ptp_3d(np.zeros((4, 3)), np.zeros((5, 3))), "shape"),
        (lambda: ptp_2d(np.zeros((4, 3)), np.zeros((4, 3)), 10), "2"),
        (lambda: ptp_2d(np.zeros((4, 2)), np.zeros((4, 2)), 0), "image_width"),
        (lambda: distance_to_centerline(np.zeros(2), np.zeros((4, 2)), 10), "points"),
        (lambda: distance_to_centerline(np.zeros((4, 2)), np.zeros((1, 2)), 10), "centerline"),
    ],
)
def test_bad_arguments_are_named(call, named):
    with pytest.raises(ValueError, match=named):
        call()
