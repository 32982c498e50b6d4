"""Clamp poses and their displacements."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary

BOUNDARY = random_boundary(np.random.default_rng(0), 0.5)


def test_displacement_to_undoes_displaced():
    vector = np.random.default_rng(1).uniform(-0.5, 0.5, 12)
    moved = BOUNDARY.displaced(BoundaryDisplacement.from_vector(vector))
    np.testing.assert_allclose(BOUNDARY.displacement_to(moved).vector, vector, atol=1e-12)


def test_rotation_is_about_the_clamps_own_origin_in_world_axes():
    twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.4])
    moved = BOUNDARY.displaced(BoundaryDisplacement(twist, np.zeros(6)))
    np.testing.assert_allclose(moved.left[:3, 3], BOUNDARY.left[:3, 3])
    expected = exp_so3([0.0, 0.0, 0.4]) @ BOUNDARY.left[:3, :3]
    np.testing.assert_allclose(moved.left[:3, :3], expected, atol=1e-12)


def test_ten_thousand_moves_keep_the_clamps_rigid():
    rng = np.random.default_rng(2)
    poses = BOUNDARY
    for _ in range(10_000):
        poses = poses.displaced(BoundaryDisplacement.from_vector(rng.uniform(-0.1, 0.1, 12)))
    error = poses.left[:3, :3].T @ poses.left[:3, :3] - np.eye(3)
    assert np.abs(error).max() < 2e-15  # without the correction 1e-14 and growing


def test_bad_displacements_and_poses_are_named():
    with pytest.raises(ValueError, match="displacement left.*6 finite"):
        BoundaryDisplacement(np.full(6, np.nan), np.zeros(6))
    with pytest.raises(ValueError, match="6 or 12"):
        BoundaryDisplacement.from_vector(np.zeros(7))
    with pytest.raises(ValueError, match="clamp right.*rigid"):
        BoundaryPoses(np.eye(4), 2 * np.eye(4))
    with pytest.raises(ValueError, match=r"clamp left.*one pose of shape \(4, 4\)"):
        BoundaryPoses(np.tile(np.eye(4), (2, 1, 1)))
    one_armed = BoundaryPoses(pose(np.eye(3), np.zeros(3)))
    with pytest.raises(ValueError, match="right clamp"):
        one_armed.displaced(BoundaryDisplacement.zero())
