"""Derivatives by the rod's parameters against rods settled with other parameters."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.sensitivity import PARAMETERS

PROPERTIES = RodProperties(0.5, youngs_modulus=3e6, rest_curvature=(0.5, -0.3, 0.2))


def changed(name: str, step: float) -> RodProperties:
    p = PROPERTIES
    if name == "log_EI":
        return replace(p, EI=p.bending_stiffness * np.exp(step))
    if name == "log_GJ":
        return replace(p, GJ=p.twisting_stiffness * np.exp(step))
    if name == "log_weight":
        return replace(p, mass_per_length=p.linear_density * np.exp(step))
    if name == "length":
        return replace(p, length=p.length + step)
    rest = np.array(p.rest_curvature)
    rest[["rest_curvature_1", "rest_curvature_2", "rest_twist"].index(name)] += step
    return replace(p, rest_curvature=rest)


@pytest.mark.parametrize("held", ["both", "left"])
@pytest.mark.parametrize("name", PARAMETERS)
def test_parameter_sensitivity_matches_rods_of_other_parameters(name, held):
    boundary = random_boundary(np.random.default_rng(6), 0.5)
    if held == "left":
        boundary = BoundaryPoses(boundary.left)
    rod = CosseratRod(PROPERTIES, 30)
    state = rod.settle(boundary)
    state = rod.move(BoundaryDisplacement.from_vector(np.zeros(12 if held == "both" else 6)))
    sensitivity = rod.parameter_sensitivity()[:, :, PARAMETERS.index(name)]
    h, ends = 1e-4, []
    for sign in (1.0, -1.0):
        other = CosseratRod(changed(name, sign * h), 30)
        ends.append(other.settle(boundary, start=state.positions).positions)
    difference = (ends[0] - ends[1]) / (2.0 * h)
    assert np.abs(difference).max() > 1e-5
    np.testing.assert_allclose(sensitivity, difference, atol=1e-3 * np.abs(difference).max())
