"""Derivatives of an equilibrium by the rod's parameters against rods of other parameters."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, Capsule, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.sensitivity import PARAMETERS
from tests.dlo_gym.rod.changed_properties import changed

PROPERTIES = RodProperties(0.5, youngs_modulus=3e6, rest_curvature=(0.5, -0.3, 0.2))


def compare(sensitivity, positions_of, properties, step, tolerance):
    """``positions_of`` a rod of other properties, by central differences."""
    for column, name in enumerate(PARAMETERS):
        h = 0.1 * step if name == "length" else step
        ends = [positions_of(changed(properties, name, sign * h)) for sign in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / (2.0 * h)
        largest = np.abs(difference).max()
        assert largest > 1e-5, name
        np.testing.assert_allclose(
            sensitivity[:, :, column], difference, atol=tolerance * largest, err_msg=name
        )


@pytest.mark.parametrize("held", ["both", "left"])
@pytest.mark.parametrize("material", ["elastic", "yielding"])
def test_parameter_sensitivity_matches_rods_of_other_parameters(material, held):
    boundary = random_boundary(np.random.default_rng(6), 0.5)
    if held == "left":
        boundary = BoundaryPoses(boundary.left)
    properties = PROPERTIES
    if material == "yielding":
        properties = replace(properties, yield_curvature=2.0, hardening=0.3)
    rod = CosseratRod(properties, 30)
    state = rod.settle(boundary)
    assert (np.abs(state.plastic_curvature).max() > 0.1) == (material == "yielding")

    def settled(p: RodProperties):
        return CosseratRod(p, 30).settle(boundary, start=state.positions).positions

    compare(rod.parameter_sensitivity(), settled, properties, 1e-4, 1e-4)


def test_parameter_sensitivity_on_a_bar():
    obstacles = [Capsule.between([0.0, -0.2, 0.03], [0.0, 0.2, 0.03], 0.01)]
    ends = [
        pose(frame_along([1.0, 0.0, slope], [0.0, 1.0, 0.0]), [x, 0.0, -0.02])
        for x, slope in ((-0.2, 0.3), (0.2, -0.3))
    ]
    s = np.linspace(0.0, 1.0, 51)[:, None]
    start = ends[0][:3, 3] + s * [0.4, 0.0, 0.0] + 0.15 * np.sin(np.pi * s) * [0.0, 0.0, 1.0]
    rod = CosseratRod(PROPERTIES, obstacles=obstacles)
    state = rod.settle(BoundaryPoses(*ends), start)
    assert state.contact is not None
    assert np.linalg.norm(state.contact.forces) > 0.01

    def followed(p: RodProperties):
        other = CosseratRod(p, obstacles=obstacles)
        other.restore(state)
        return other.move(BoundaryDisplacement.zero()).positions

    compare(rod.parameter_sensitivity(), followed, PROPERTIES, 1e-5, 1e-5)


def test_parameter_sensitivity_of_a_rod_that_touches_itself():
    properties = RodProperties(0.5, 0.004, youngs_modulus=1e7)

    def new(p: RodProperties) -> CosseratRod:
        return CosseratRod(p, 60, gravity=(0.0, 0.0, -1.0), self_contact=True)

    along = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    rod = new(properties)
    state = rod.settle(BoundaryPoses(*[pose(along, [x, 0.0, 0.0]) for x in (-0.2, 0.2)]))
    vector = np.zeros(12)
    vector[6], vector[9] = -0.0015, np.deg2rad(10.0)
    for _ in range(120):
        state = rod.move(BoundaryDisplacement.from_vector(vector))
    assert state.contact is not None
    assert np.linalg.norm(state.contact.self_forces) > 0.01

    def followed(p: RodProperties):
        other = new(p)
        other.restore(state)
        return other.move(BoundaryDisplacement.zero()).positions

    compare(rod.parameter_sensitivity(), followed, properties, 1e-5, 1e-5)
