"""Bending, stretch and torsion against closed forms, as docs/validation.md shows them."""

import numpy as np
import pytest

from benchmarks.validation import statics
from benchmarks.validation.case import order
from benchmarks.validation.statics import HORIZONTAL, LENGTH
from dlo_gym.rod import BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import arc


@pytest.fixture(scope="module")
def cantilevers():
    return statics.loaded_cantilevers()


@pytest.mark.parametrize("load", statics.TIP_LOADS)
def test_cantilever_under_tip_load_is_the_elastica(cantilevers, load):
    reference, ours = cantilevers[f"tip load {load:g} EI/L²"]
    np.testing.assert_allclose(ours, reference, atol=1e-4)


@pytest.mark.parametrize("load", statics.LINE_LOADS)
def test_cantilever_under_own_weight_is_the_heavy_elastica(cantilevers, load):
    reference, ours = cantilevers[f"own weight {load:g} EI/L³"]
    np.testing.assert_allclose(ours, reference, atol=1e-4)


def test_the_reference_bends_a_little_as_a_beam_does():
    # Tip deflections P L^3 / 3 EI and w L^4 / 8 EI.
    assert statics.elastica(1e-3, 0.0)[-1, 1] == pytest.approx(-1e-3 / 3.0, rel=1e-5)
    assert statics.elastica(0.0, 1e-3)[-1, 1] == pytest.approx(-1e-3 / 8.0, rel=1e-5)


def test_error_falls_with_the_square_of_the_element_length():
    counts = (10, 20, 40, 80)
    assert 1.9 < order(counts, statics.tip_errors(counts)) < 2.1


def test_hanging_rod_without_stiffness_is_the_catenary():
    chain, positions = statics.hanging_chain()
    np.testing.assert_allclose(positions, chain, atol=2e-4 * LENGTH)


def test_own_weight_stretches_a_vertical_rod():
    properties = RodProperties(LENGTH)
    weight = properties.linear_density * 9.81 * LENGTH
    stretch = weight * LENGTH / (2.0 * properties.stretching_stiffness)
    lowest = statics.hung(properties).positions[-1]
    np.testing.assert_allclose(lowest, [0.0, 0.0, 1.0 - LENGTH - stretch], atol=1e-6)


def test_pulling_stretches_by_force_over_axial_stiffness():
    properties = RodProperties(LENGTH)
    state = statics.pulled(properties, 0.05)
    np.testing.assert_allclose(state.strain[:, 2], 0.05, rtol=1e-6)
    force = 0.05 * properties.stretching_stiffness
    np.testing.assert_allclose(state.wrench_left[:3], [-force, 0.0, 0.0], atol=1e-7)


def test_twisting_the_far_end_takes_the_torsion_torque():
    properties = RodProperties(LENGTH, youngs_modulus=1e8)
    angle = 0.3
    state = statics.twisted(properties, angle)
    torque = properties.twisting_stiffness * angle / LENGTH
    np.testing.assert_allclose(state.wrench_right[3:], [torque, 0.0, 0.0], atol=1e-6 * torque)
    np.testing.assert_allclose(state.curvature[:, 2], angle / LENGTH, rtol=1e-6)


def test_free_rod_takes_its_rest_curvature():
    curvature = 6.0
    properties = RodProperties(LENGTH, rest_curvature=(curvature, 0.0, 0.0))
    rod = CosseratRod(properties, 60, gravity=(0.0, 0.0, 0.0), clamp="node")
    state = rod.settle(BoundaryPoses(HORIZONTAL))
    np.testing.assert_allclose(state.curvature, [[curvature, 0.0, 0.0]] * 59, atol=1e-6)
    expected = arc(HORIZONTAL, LENGTH, curvature * LENGTH, 61)
    np.testing.assert_allclose(state.positions, expected, atol=4e-4 * LENGTH)
    assert state.energy < 1e-9
