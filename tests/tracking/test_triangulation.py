import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlo_gym.geometry import CameraModel
from dlo_gym.geometry.curves import arc_length
from tracking.triangulation import (
    bending_modes,
    fit_curve,
    ray_projectors,
    sight_across,
    triangulate,
)

DISTORTION = (-0.2, 0.05, 1e-3, -5e-4, 0.01)


def ring(m, distortion=None):
    """m cameras around the origin."""
    angles = 0.3 + 2.0 * np.arange(m) / m
    return [
        CameraModel.looking_at(
            f"c{i}", (np.cos(a), np.sin(a), 0.4 + 0.2 * i), (0, 0, 0), distortion=distortion
        )
        for i, a in enumerate(angles)
    ]


def projectors_of(cameras, points):
    rays = [camera.rays(camera.project(points)) for camera in cameras]
    return ray_projectors(np.array(rays)), np.array([camera.centre for camera in cameras])


@given(seed=st.integers(0, 2**32 - 1), m=st.integers(2, 5), distorted=st.booleans())
@settings(max_examples=25, deadline=None)
def test_project_then_triangulate_gives_the_points_back(seed, m, distorted):
    points = np.random.default_rng(seed).uniform(-0.2, 0.2, (12, 3))
    cameras = ring(m, DISTORTION if distorted else None)
    np.testing.assert_allclose(triangulate(*projectors_of(cameras, points)), points, atol=1e-7)


def test_the_projector_annihilates_its_ray():
    rays = np.random.default_rng(0).standard_normal((4, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    projectors = ray_projectors(rays)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", projectors, rays), 0.0, atol=1e-15)
    np.testing.assert_allclose(projectors @ projectors, projectors, atol=1e-15)


def test_the_solution_is_the_point_nearest_to_all_rays():
    points = np.zeros((1, 3))
    projectors, centres = projectors_of(ring(3), points + np.array([0.01, 0.02, -0.01]))
    projectors[0] = projectors_of(ring(3), points)[0][0]  # rays that do not meet

    def cost(point):
        differences = point - centres
        return np.einsum("mi,mij,mj->", differences, projectors[:, 0], differences)

    best = triangulate(projectors, centres)[0]
    for step in 1e-4 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(best + step) > cost(best)


def test_weights_favour_a_view_and_zero_takes_it_out():
    points = np.zeros((1, 3))
    projectors, centres = projectors_of(ring(3), points)
    projectors[2] = projectors_of(ring(3), points + 0.05)[0][2]  # this view is wrong
    wrong = np.linalg.norm(triangulate(projectors, centres))
    weighted = np.linalg.norm(triangulate(projectors, centres, np.array([[1.0], [1.0], [0.05]])))
    without = np.linalg.norm(triangulate(projectors, centres, np.array([[1.0], [1.0], [0.0]])))
    assert without < 1e-9 < weighted < 0.2 * wrong


@pytest.mark.parametrize("weights", [[[1.0], [0.0]], [[0.0], [0.0]]])
def test_what_one_view_alone_sees_has_no_depth(weights):
    projectors, centres = projectors_of(ring(2), np.zeros((1, 3)))
    assert np.isnan(triangulate(projectors, centres, np.array(weights))).all()


def arc(n=41, length=0.4, angle=2.0):
    s = np.linspace(-0.5, 0.5, n) * angle
    radius = length / angle
    return radius * np.column_stack([np.sin(s), 0 * s, 1.0 - np.cos(s)])


def sights_of(cameras, truth, seen, slide=0):
    """Sights of the true curve where seen; with nodes slid along it by ``slide`` nodes."""
    sights = []
    for camera, mask in zip(cameras, seen, strict=True):
        pixels = camera.project(truth)
        tangents = np.gradient(pixels, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        shifted = np.clip(np.arange(len(truth)) + slide, 0, len(truth) - 1)
        sights.append(sight_across(camera, pixels[shifted], tangents[shifted], mask.astype(float)))
    return sights


@pytest.fixture
def curve():
    truth = arc()
    bump = np.sin(np.linspace(0.0, np.pi, len(truth))) ** 2
    predicted = truth + 0.006 * bump[:, None] * np.array([0.3, 0.8, -0.5])
    fixed = np.zeros(len(truth), dtype=bool)
    fixed[[0, 1, -2, -1]] = True
    h = float(np.diff(arc_length(truth)).mean())
    return truth, predicted, fixed, h


def fitted(curve, sights, iterations=4):
    truth, predicted, fixed, h = curve
    uncertainty = np.full(len(truth), 0.01)
    return fit_curve(predicted, predicted, sights, h, uncertainty, fixed, iterations=iterations)


def test_a_curve_seen_in_two_views_is_recovered(curve):
    truth = curve[0]
    seen = np.ones((2, len(truth)), dtype=bool)
    fit = fitted(curve, sights_of(ring(2, DISTORTION), truth, seen))
    assert np.linalg.norm(fit.centerline - truth, axis=1).max() < 3e-4


def test_nodes_slid_along_the_curve_in_one_view_do_not_bend_the_depth(curve):
    """Where the paper's node-by-node triangulation errs by millimetres."""
    truth = curve[0]
    cameras = ring(2)
    seen = np.ones((1, len(truth)), dtype=bool)
    sights = sights_of(cameras[:1], truth, seen) + sights_of(cameras[1:], truth, seen, slide=1)
    fit = fitted(curve, sights)
    error = np.linalg.norm(fit.centerline - truth, axis=1).mean()
    pixels = [cameras[0].project(truth), cameras[1].project(np.roll(truth, -1, axis=0))]
    rays = np.array([camera.rays(p) for camera, p in zip(cameras, pixels, strict=True)])
    centres = np.array([camera.centre for camera in cameras])
    slid = triangulate(ray_projectors(rays), centres)[2:-2]
    baseline = np.linalg.norm(slid - truth[2:-2], axis=1).mean()
    assert error < 1e-3 < baseline


def test_a_gap_is_filled_smoothly_and_is_less_certain(curve):
    truth, predicted, _, _ = curve
    seen = np.ones((2, len(truth)), dtype=bool)
    seen[:, 15:25] = False
    fit = fitted(curve, sights_of(ring(2), truth, seen))
    gap = np.linalg.norm(fit.centerline - truth, axis=1)[15:25].max()
    assert gap < 0.25 * np.linalg.norm(predicted - truth, axis=1)[15:25].max()
    deviation = fit.deviation()
    assert deviation[20] > 2.0 * deviation[10]
    assert (deviation[[0, 1, -2, -1]] == 0.0).all()


def test_the_length_and_the_held_nodes_are_kept(curve):
    truth, predicted, fixed, h = curve
    seen = np.ones((2, len(truth)), dtype=bool)
    fit = fitted(curve, sights_of(ring(2), truth, seen))
    np.testing.assert_array_equal(fit.centerline[fixed], predicted[fixed])
    steps = np.linalg.norm(np.diff(fit.centerline, axis=0), axis=1)[2:-2]
    np.testing.assert_allclose(steps, h, rtol=2e-2)


def test_without_sights_the_prediction_stays(curve):
    truth, _, fixed, h = curve
    fit = fit_curve(truth, truth, [], h, np.full(len(truth), 0.01), fixed)
    np.testing.assert_allclose(fit.centerline, truth, atol=1e-6)


def test_a_rod_stretched_by_its_weight_is_not_forced_to_its_length(curve):
    truth, predicted, fixed, h = curve
    cameras = ring(2)
    sights = sights_of(cameras, truth, [np.ones(len(truth), dtype=bool)] * 2)
    uncertainty = np.full(len(truth), 0.01)
    fit = fit_curve(predicted, predicted, sights, h / 1.01, uncertainty, fixed, iterations=4)
    error = np.linalg.norm(fit.centerline - truth, axis=1)
    assert error.max() < 1e-3
    assert arc_length(fit.centerline)[-1] == pytest.approx(arc_length(truth)[-1], rel=2e-3)


def test_modes_bend_without_stretching_or_moving_the_clamps():
    truth = arc()
    n, h = len(truth), 0.4 / 40
    fixed = np.isin(np.arange(n), [0, 1, n - 2, n - 1])
    modes = bending_modes(truth, h, fixed, 6, curvature=2.0)
    assert modes.shape == (6, n, 3)
    assert (modes[:, fixed] == 0.0).all()
    tangents = np.diff(truth, axis=0) / h
    stretch = (np.diff(modes, axis=1) * tangents).sum(axis=2) / h
    assert np.abs(stretch).max() < 0.02
    curvature = np.diff(modes, n=2, axis=1) / h**2
    np.testing.assert_allclose(np.sqrt((curvature**2).sum(axis=(1, 2)) / n), 2.0, rtol=0.1)
    gram = modes.reshape(6, -1) @ modes.reshape(6, -1).T
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-9
