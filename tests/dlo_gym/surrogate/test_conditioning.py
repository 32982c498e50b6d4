import dataclasses

import numpy as np
import pytest

from dlo_gym.geometry.se3 import pose
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.surrogate.conditioning import groups, guess_terms, scaled_groups

ROD = RodProperties(0.5, 0.003, 1e6, 1e3, 0.5, (3.0, 4.0, 0.0))


def test_groups_of_the_paper_s_rod():
    area, inertia = np.pi * 0.003**2, np.pi / 4 * 0.003**4
    weight = 9.81 * 1e3 * area
    expected = [
        np.log10(1e6 * inertia / (weight * 0.5**3)),
        2 / 3,
        weight * 0.5 / (1e6 * area),
        2.5,
    ]
    np.testing.assert_allclose(groups(ROD), expected, rtol=1e-12)


@pytest.mark.parametrize("factor", [0.6, 2.0])
def test_rods_of_equal_groups_have_similar_equilibria(factor):
    """Radius and Young's modulus grow with the length: all groups, and r / L, stay."""
    similar = dataclasses.replace(
        ROD, length=0.5 * factor, radius=0.003 * factor, youngs_modulus=1e6 * factor,
        rest_curvature=(3.0 / factor, 4.0 / factor, 0.0),
    )  # fmt: skip
    np.testing.assert_allclose(groups(similar), groups(ROD), rtol=1e-12)
    held = random_boundary(np.random.default_rng(0), 0.5)
    scaled = BoundaryPoses(*(pose(c[:3, :3], factor * c[:3, 3]) for c in (held.left, held.right)))
    shape = CosseratRod(ROD).settle(held).positions
    start = factor * shape
    settled = CosseratRod(similar).settle(scaled, start=start).positions
    np.testing.assert_allclose(settled, start, atol=1e-6)


def test_a_rod_that_is_not_uniform_counts_by_its_means():
    stiffness = np.array([1e6, 4e6])
    uneven = RodProperties(
        0.5, youngs_modulus=stiffness, rest_curvature=np.tile([1.0, 0, 0], (1, 1))
    )
    even = RodProperties(0.5, youngs_modulus=1.6e6, rest_curvature=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(groups(uneven), groups(even), rtol=1e-12)


def test_groups_are_scaled_over_the_range_and_stop_at_its_edge():
    low, high = np.array([-4.0, 0.5, 0.0, 1.0]), np.array([0.0, 1.0, 0.1, 1.0])
    np.testing.assert_allclose(scaled_groups(low, low, high), [-1.0, -1.0, -1.0, 0.0])
    np.testing.assert_allclose(scaled_groups(high + 5.0, low, high), [1.0, 1.0, 1.0, 0.0])
    np.testing.assert_allclose(
        guess_terms(np.array([0.5, 0.1, 0.2, 0.3]))[:4], [1, 0.5, 0.25, 0.125]
    )
