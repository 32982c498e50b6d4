"""The rod against closed forms and boundary value problems of the continuous rod."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import arc, catenary

LENGTH = 0.5
HORIZONTAL = pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), [0.1, 0.2, 0.3])


def elastica(tip_load: float, line_load: float) -> np.ndarray:
    """Planar cantilever on a unit length: EI theta'' = (P + w (L - s)) cos(theta), loads over EI.

    Returns the deflected curve (101, 2) of an inextensible, unshearable rod."""

    def rates(s, y):
        return [y[1], (tip_load + line_load * (1.0 - s)) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

    def ends(a, b):
        return [a[0], b[1], a[2], a[3]]

    s = np.linspace(0.0, 1.0, 101)
    solution = solve_bvp(rates, ends, s, np.zeros((4, 101)), tol=1e-9, max_nodes=100_000)
    assert solution.success
    return solution.sol(s)[2:].T


def cantilever(properties: RodProperties, n: int, tip_load: float, gravity: float) -> np.ndarray:
    """Curve (n + 1, 2) in the plane of x and z from the clamp, over the length."""
    rod = CosseratRod(properties, n, gravity=(0.0, 0.0, -gravity), clamp="node")
    forces = np.zeros((n + 1, 3))
    forces[-1, 2] = -tip_load
    rod.apply_forces(forces)
    state = rod.settle(BoundaryPoses(HORIZONTAL))
    return (state.positions - HORIZONTAL[:3, 3])[:, [0, 2]] / LENGTH


@pytest.mark.parametrize("load", [0.2, 2.0, 8.0])
def test_cantilever_under_tip_load_is_the_elastica(load):
    properties = RodProperties(LENGTH, radius=0.001, youngs_modulus=1e8)
    tip_load = load * properties.bending_stiffness / LENGTH**2
    curve = cantilever(properties, 100, tip_load, 0.0)
    np.testing.assert_allclose(curve, elastica(load, 0.0), atol=3e-4)


@pytest.mark.parametrize("load", [0.5, 5.0, 20.0])
def test_cantilever_under_own_weight_is_the_heavy_elastica(load):
    properties = RodProperties(LENGTH, radius=0.001, youngs_modulus=1e8)
    gravity = load * properties.bending_stiffness / (LENGTH**3 * properties.linear_density)
    curve = cantilever(properties, 100, 0.0, gravity)
    np.testing.assert_allclose(curve, elastica(0.0, load), atol=3e-4)


def test_error_falls_with_the_square_of_the_element_length():
    properties = RodProperties(LENGTH, radius=0.0002, youngs_modulus=1e10)
    exact = elastica(4.0, 0.0)[-1]
    tip_load = 4.0 * properties.bending_stiffness / LENGTH**2
    counts = np.array([10, 20, 40, 80])
    errors = [np.linalg.norm(cantilever(properties, n, tip_load, 0.0)[-1] - exact) for n in counts]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 1.9 < order < 2.1


def test_hanging_rod_without_stiffness_is_the_catenary():
    # Fingers that hold the ends along the chain's own tangents leave nothing to bend there.
    start, end = np.array([-0.18, 0.03, 0.4]), np.array([0.17, -0.02, 0.46])
    chain = catenary(start, end, LENGTH, 201)
    tangents = np.diff(chain, axis=0)[[0, -1]]
    clamps = [
        pose(frame_along(tangent, [0.0, 1.0, 0.0]), point)
        for tangent, point in zip(tangents, (start, end), strict=True)
    ]
    properties = RodProperties(LENGTH, radius=5e-5, youngs_modulus=1e11, density=4e6)
    assert properties.bending_stiffness / (properties.linear_density * 9.81 * LENGTH**3) < 2e-5
    rod = CosseratRod(properties, 200, clamp="node")
    state = rod.settle(BoundaryPoses(*clamps))
    np.testing.assert_allclose(state.positions, chain, atol=1e-3 * LENGTH)


def test_own_weight_stretches_a_vertical_rod():
    down = pose(frame_along([0.0, 0.0, -1.0], [0.0, 1.0, 0.0]), [0.0, 0.0, 1.0])
    properties = RodProperties(LENGTH)
    rod = CosseratRod(properties, 50)
    lowest = rod.settle(BoundaryPoses(down)).positions[-1]
    weight = properties.linear_density * 9.81 * LENGTH
    stretch = weight * LENGTH / (2.0 * properties.stretching_stiffness)
    np.testing.assert_allclose(lowest, [0.0, 0.0, 1.0 - LENGTH - stretch], atol=1e-6)


def test_pulling_stretches_by_force_over_axial_stiffness():
    properties = RodProperties(LENGTH)
    rod = CosseratRod(properties, 20, gravity=(0.0, 0.0, 0.0))
    forces = np.zeros((21, 3))
    forces[-1, 0] = 0.05 * properties.stretching_stiffness
    rod.apply_forces(forces)
    state = rod.settle(BoundaryPoses(HORIZONTAL))
    np.testing.assert_allclose(state.strain[:, 2], 0.05, rtol=1e-6)
    np.testing.assert_allclose(state.wrench_left[:3], [-forces[-1, 0], 0.0, 0.0], atol=1e-7)


def test_twisting_the_far_end_takes_the_torsion_torque():
    properties = RodProperties(LENGTH, youngs_modulus=1e8)
    straight_end = HORIZONTAL.copy()
    straight_end[:3, 3] += [LENGTH * (1 - 1e-9), 0.0, 0.0]
    rod = CosseratRod(properties, 40, gravity=(0.0, 0.0, 0.0), clamp="node")
    rod.settle(BoundaryPoses(HORIZONTAL, straight_end))
    angle = 0.3
    state = rod.move(BoundaryDisplacement(np.zeros(6), np.array([0, 0, 0, angle, 0, 0])))
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
