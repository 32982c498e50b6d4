"""Springs between the rod's nodes and places."""

import numpy as np
import pytest

from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.sensitivity import DISPLACEMENT


@pytest.fixture
def rod():
    return CosseratRod(RodProperties(0.5), 20)


def test_springs_balance_the_forces_that_would_hold_the_nodes(rod):
    boundary = random_boundary(np.random.default_rng(0), 0.5)
    rest = rod.settle(boundary).positions
    forces = 0.02 * np.random.default_rng(1).normal(size=rest.shape)
    forces[[0, -1]] = 0.0
    rod.apply_forces(forces)
    pulled = rod.settle(boundary, rest).positions
    rod.apply_forces(np.zeros_like(forces))
    rod.attract(pulled + forces / 50.0, 50.0)
    np.testing.assert_allclose(rod.settle(boundary, rest).positions, pulled, atol=1e-7)
    rod.attract(pulled, 0.0)
    np.testing.assert_allclose(rod.settle(boundary, rest).positions, rest, atol=1e-7)


def test_springs_count_at_once(rod):
    state = rod.settle(random_boundary(np.random.default_rng(0), 0.5))
    rod.attract(state.positions + np.array([0.0, 0.0, 0.01]), 50.0)
    stored = 21 * 0.5 * 50.0 * 0.01**2
    assert rod.state.energy - state.energy == pytest.approx(stored, abs=1e-12)


def test_a_rod_that_springs_pull_does_not_advance(rod):
    state = rod.settle(random_boundary(np.random.default_rng(0), 0.5))
    rod.attract(state.positions, 50.0)
    with pytest.raises(ValueError, match=r"advance: .*springs.* attract"):
        rod.advance(BoundaryDisplacement.zero(), 0.1)
    rod.attract(state.positions, 0.0)
    rod.advance(BoundaryDisplacement.zero(), 0.1)


def test_bad_springs_are_refused(rod):
    with pytest.raises(ValueError, match="targets: expected finite"):
        rod.attract(np.zeros((3, 3)), 1.0)
    with pytest.raises(ValueError, match="stiffness: expected"):
        rod.attract(np.zeros((21, 3)), -1.0)


def test_derivatives_by_the_clamps_are_those_of_a_move(rod):
    rod.settle(random_boundary(np.random.default_rng(0), 0.5))
    sensitivity = rod.motion_sensitivity((), by_clamps=True)
    assert sensitivity.columns == DISPLACEMENT
    np.testing.assert_array_equal(sensitivity.positions, rod.sensitivity())
    saved, directors = rod.state, rod.state.directors
    for column, step in enumerate(1e-5 * np.eye(12)):
        turned = rod.move(BoundaryDisplacement.from_vector(step)).directors
        rod.restore(saved)
        skew = np.swapaxes(directors, 1, 2) @ turned
        turns = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1) / 1e-5
        np.testing.assert_allclose(sensitivity.turns[..., column], turns, rtol=1e-3, atol=5e-3)
