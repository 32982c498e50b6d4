"""Interpolated poses against motions whose pose is known at every time."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, log_so3, pose
from sim2real.pose_history import interpolate_poses

STAMPS = np.array([10.0, 10.008, 10.016, 10.05, 10.1])
SPIN, VELOCITY = np.array([0.4, -1.1, 0.7]), np.array([0.1, 0.2, -0.3])


def screw(times):
    """Constant spin and velocity, which linear interpolation and slerp follow exactly."""
    t = np.asarray(times)[..., None] - 10.0
    start = exp_so3([0.5, 2.0, -1.0])
    return pose(start @ exp_so3(t * SPIN), [0.3, 0.0, 0.4] + t * VELOCITY)


def test_constant_motion_is_met_exactly():
    times = np.linspace(10.0, 10.1, 37).reshape(-1, 1)
    found = interpolate_poses(STAMPS, screw(STAMPS), times)
    assert found.shape == (37, 1, 4, 4)
    np.testing.assert_allclose(found, screw(times), atol=1e-12)


def test_given_poses_come_back():
    rng = np.random.default_rng(0)
    poses = pose(exp_so3(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)))
    np.testing.assert_allclose(interpolate_poses(STAMPS, poses, STAMPS), poses, atol=1e-12)


def test_takes_the_shorter_way_round():
    poses = pose(exp_so3([[0, 0, 3.0], [0, 0, -3.0]]), np.zeros((2, 3)))
    middle = interpolate_poses([0.0, 0.1], poses, 0.05)
    assert middle.shape == (4, 4)
    assert np.linalg.norm(log_so3(middle[:3, :3])) == pytest.approx(np.pi)


def test_error_of_a_curved_motion_is_of_second_order():
    def circle(t):
        return pose(exp_so3(np.outer(t, [0, 0, 2.0])), np.column_stack([np.cos(t), np.sin(t), t]))

    times = np.linspace(0.05, 0.95, 200)
    errors = []
    for n in (11, 21):
        stamps = np.linspace(0.0, 1.0, n)
        errors.append(
            np.abs(interpolate_poses(stamps, circle(stamps), times) - circle(times)).max()
        )
    assert errors[0] < 0.1**2 / 8 * 1.01
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_carries_the_motion_on_for_a_moment_only():
    poses = screw(STAMPS)
    for time in (9.99, 10.115):
        np.testing.assert_allclose(
            interpolate_poses(STAMPS, poses, time), screw(np.array(time)), atol=1e-12
        )
    for time in (9.97, 10.125, np.nan):
        with pytest.raises(ValueError, match=r"query: expected times from 9\.980 to 10\.120"):
            interpolate_poses(STAMPS, poses, [10.0, time])
    with pytest.raises(ValueError, match="query"):
        interpolate_poses(STAMPS, poses, 10.101, extrapolation=0.0)


def test_refuses_to_guess_inside_a_gap():
    stamps = [0.0, 0.01, 0.6, 0.61]
    poses = screw(stamps)
    interpolate_poses(stamps, poses, [0.005, 0.01, 0.6, 0.605])
    with pytest.raises(ValueError, match=r"gap of 0\.590 s"):
        interpolate_poses(stamps, poses, [0.005, 0.3])
    interpolate_poses(stamps, poses, 0.3, max_gap=1.0)


@pytest.mark.parametrize(
    ("stamps", "n", "message"),
    [
        ([0.0, 0.1], 3, "shapes"),
        ([0.0], 1, "n >= 2"),
        ([0.0, 0.0], 2, "strictly increase"),
        ([0.1, 0.0], 2, "strictly increase"),
        ([0.0, np.nan], 2, "strictly increase"),
    ],
)
def test_wrong_histories_are_refused(stamps, n, message):
    with pytest.raises(ValueError, match=message):
        interpolate_poses(stamps, np.tile(np.eye(4), (n, 1, 1)), 0.0)


def test_poses_must_be_rigid():
    with pytest.raises(ValueError, match="poses"):
        interpolate_poses([0.0, 0.1], np.tile(2 * np.eye(4), (2, 1, 1)), 0.0)
