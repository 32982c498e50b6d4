import numpy as np
import pytest

from dlo_gym.envs.actions import ClampAction
from dlo_gym.geometry.se3 import exp_so3, log_so3, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses

STEP, TURN = 0.01, np.deg2rad(4.5)


@pytest.fixture
def boundary():
    rng = np.random.default_rng(3)
    return BoundaryPoses(
        pose(exp_so3(rng.normal(size=3)), [-0.2, 0.0, 0.3]),
        pose(exp_so3(rng.normal(size=3)), [0.2, 0.0, 0.3]),
    )


def test_translations_are_along_world_axes(boundary):
    action = np.array([1.0, 0, 0, 0, 0, 0, -0.5, 0, 0, 0])
    moved = boundary.displaced(ClampAction(STEP, TURN).to_displacement(action, boundary))
    np.testing.assert_allclose(moved.left[:3, 3], [-0.19, 0.0, 0.3])
    np.testing.assert_allclose(moved.right[:3, 3], [0.2, -0.005, 0.3])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotations_are_about_the_clamps_own_axes(boundary, axis):
    action = np.zeros(12)
    action[9 + axis] = 1.0
    moved = boundary.displaced(ClampAction(STEP, TURN, True).to_displacement(action, boundary))
    in_clamp = log_so3(boundary.right[:3, :3].T @ moved.right[:3, :3])
    np.testing.assert_allclose(in_clamp, TURN * np.eye(3)[axis], atol=1e-12)
    np.testing.assert_allclose(moved.left, boundary.left, atol=1e-12)


def test_the_rods_axis_is_not_turned_unless_asked(boundary):
    rng = np.random.default_rng(0)
    displacement = ClampAction(STEP, TURN).to_displacement(rng.uniform(-1, 1, 10), boundary)
    assert abs(displacement.left[3:] @ boundary.left[:3, 2]) < 1e-15
    assert abs(displacement.right[3:] @ boundary.right[:3, 2]) < 1e-15


@pytest.mark.parametrize("axial", [False, True])
def test_actions_and_displacements_are_inverse(boundary, axial):
    meaning = ClampAction(STEP, TURN, axial)
    action = np.random.default_rng(1).uniform(-1, 1, meaning.size)
    back = meaning.to_action(meaning.to_displacement(action, boundary), boundary)
    np.testing.assert_allclose(back, action, atol=1e-12)


def test_too_large_a_displacement_is_cut_by_component(boundary):
    displacement = BoundaryDisplacement.from_vector(np.r_[0.02, 0.005, np.zeros(10)])
    action = ClampAction(STEP, TURN).to_action(displacement, boundary)
    np.testing.assert_allclose(action, np.r_[1.0, 0.5, np.zeros(8)])


@pytest.mark.parametrize("action", [np.zeros(9), np.zeros((2, 5)), np.full(10, np.nan), 0.0])
def test_an_illegal_action_is_refused(boundary, action):
    with pytest.raises(ValueError, match="action: expected 10 numbers"):
        ClampAction(STEP, TURN).to_displacement(action, boundary)


def test_a_free_end_is_refused(boundary):
    with pytest.raises(ValueError, match="two clamps"):
        ClampAction(STEP, TURN).to_displacement(np.zeros(10), BoundaryPoses(boundary.left))
