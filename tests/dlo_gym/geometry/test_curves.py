"""Arc length, resampling and parallel transport on curves with closed forms."""

import numpy as np
import pytest

from dlo_gym.geometry import curves


def helix(n: int, radius: float = 0.05, pitch: float = 0.02, turns: float = 2.0) -> np.ndarray:
    t = np.linspace(0.0, 2 * np.pi * turns, n)
    return np.column_stack([radius * np.cos(t), radius * np.sin(t), pitch * t])


def test_arc_length_of_a_helix():
    expected = 4 * np.pi * np.hypot(0.05, 0.02)
    np.testing.assert_allclose(curves.arc_length(helix(5001))[-1], expected, rtol=1e-5)


def test_resampled_points_are_equally_spaced_on_the_curve():
    uneven = helix(400)[np.sort(np.random.default_rng(0).choice(400, 150, replace=False))]
    points = curves.resample(uneven, 51)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=2e-3)
    np.testing.assert_allclose(points[[0, -1]], uneven[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), 0.05, atol=1e-4)


def test_repeated_points_do_no_harm_and_one_point_is_refused():
    doubled = np.repeat(helix(30), 2, axis=0)
    np.testing.assert_allclose(curves.resample(doubled, 20), curves.resample(helix(30), 20))
    with pytest.raises(ValueError, match="two distinct points"):
        curves.resample(np.zeros((5, 3)), 4)


def test_parallel_transport_round_a_circle_comes_back():
    angle = np.linspace(0.0, 2 * np.pi, 200)
    tangents = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    first = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    frames = curves.parallel_transport(tangents, first)
    np.testing.assert_allclose(frames[:, :, 2], tangents, atol=1e-12)
    np.testing.assert_allclose(frames[-1], frames[0], atol=1e-9)


def test_parallel_transport_round_a_spherical_triangle_turns_by_its_area():
    def leg(a, b):
        t = np.linspace(0.0, np.pi / 2, 50)[:, None]
        return np.cos(t) * a + np.sin(t) * b

    x, y, z = np.eye(3)
    tangents = np.concatenate([leg(x, y), leg(y, z), leg(z, x)])
    first = np.column_stack([y, z, x])
    last = curves.parallel_transport(tangents, first)[-1]
    np.testing.assert_allclose(last[:, 0] @ first[:, 1], 1.0, atol=1e-9)  # an octant: pi / 2


def test_the_angle_swept_round_an_axis_counts_turns_and_their_sense():
    points, origin = helix(200) + np.array([1.0, 2.0, 3.0]), [1.0, 2.0, -7.0]
    up = np.array([0.0, 0.0, 3.0])
    assert curves.swept_angle(points, origin, up) == pytest.approx(4 * np.pi)
    assert curves.swept_angle(points, origin, -up) == pytest.approx(-4 * np.pi)
    assert curves.swept_angle(points[::-1], origin, up) == pytest.approx(-4 * np.pi)
    assert curves.swept_angle(points, [9.0, 2.0, 3.0], up) == pytest.approx(0.0, abs=1e-12)
    across = np.array([[-1.0, 0.1, 0.0], [1.0, 0.1, 5.0]])
    half_turn = -2 * np.arctan(10.0)
    assert curves.swept_angle(across, [0, 0, 0], up) == pytest.approx(half_turn)
