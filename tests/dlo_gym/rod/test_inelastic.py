"""Plastic bending and creep against closed forms."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary

LENGTH = 0.5
HORIZONTAL = pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), np.zeros(3))
STILL = BoundaryDisplacement(np.zeros(6))
WEIGHTLESS = (0.0, 0.0, 0.0)


def arc_end(curvature: float) -> np.ndarray:
    """Pose at the end of an arc that starts at ``HORIZONTAL`` and bends about d1."""
    angle = curvature * LENGTH
    local = [0.0, -(1.0 - np.cos(angle)) / curvature, np.sin(angle) / curvature]
    return HORIZONTAL @ pose(exp_so3([angle, 0.0, 0.0]), local)


def bent(rod: CosseratRod, curvatures: np.ndarray):
    """Settle as an arc of the first curvature, then move through the others; the last state."""
    boundary = BoundaryPoses(HORIZONTAL, arc_end(curvatures[0]))
    state = rod.settle(boundary)
    for curvature in curvatures[1:]:
        target = BoundaryPoses(HORIZONTAL, arc_end(curvature))
        state = rod.move(state.boundary.displacement_to(target))
    return state


def test_moment_of_an_arc_bends_at_the_yield_point_and_springs_back_elastically():
    yield_curvature, hardening = 2.0, 0.25
    properties = RodProperties(LENGTH, yield_curvature=yield_curvature, hardening=hardening)
    stiffness = properties.bending_stiffness
    rod = CosseratRod(properties, 40, gravity=WEIGHTLESS, clamp="node")
    elastic = bent(rod, np.linspace(0.5, 1.9, 8))
    np.testing.assert_array_equal(elastic.plastic_curvature, 0.0)
    state = bent(rod, np.linspace(0.5, 5.0, 24))
    moment = stiffness * (yield_curvature + hardening * (5.0 - yield_curvature))
    assert abs(np.linalg.norm(state.wrench_right[3:]) / moment - 1.0) < 1e-3
    stays = (1.0 - hardening) * (5.0 - yield_curvature)
    np.testing.assert_allclose(state.plastic_curvature[:, 0], stays, rtol=2e-3)
    back = 5.0 - moment / stiffness
    for curvature in np.linspace(5.0, back, 12)[1:]:
        target = BoundaryPoses(HORIZONTAL, arc_end(curvature))
        state = rod.move(state.boundary.displacement_to(target))
    assert np.linalg.norm(state.wrench_right[3:]) < 5e-3 * moment
    np.testing.assert_allclose(state.plastic_curvature[:, 0], stays, rtol=2e-3)


def test_cantilever_keeps_the_closed_form_deflection():
    yield_curvature, hardening = 0.02, 0.2
    properties = RodProperties(LENGTH, yield_curvature=yield_curvature, hardening=hardening)
    stiffness = properties.bending_stiffness
    load = 1.5 * stiffness * yield_curvature / LENGTH
    rod = CosseratRod(properties, 100, gravity=WEIGHTLESS, clamp="node")
    rod.settle(BoundaryPoses(HORIZONTAL))
    for share in np.linspace(0.1, 1.0, 10):
        forces = np.zeros((101, 3))
        forces[-1, 2] = share * load
        rod.apply_forces(forces)
        rod.move(STILL)
    rod.apply_forces(np.zeros((101, 3)))
    state = rod.move(STILL)
    s = np.linspace(0.0, LENGTH / 3.0, 2001)  # where the moment is beyond yield
    resists = stiffness * hardening / (1.0 - hardening)
    stays = (load * (LENGTH - s) - stiffness * yield_curvature) / resists
    exact = np.trapezoid(stays * (LENGTH - s), s)
    assert abs(state.positions[-1, 2] / exact - 1.0) < 5e-3


def test_other_obstacles_leave_what_the_last_move_bent():
    properties = RodProperties(LENGTH, yield_curvature=0.02, hardening=0.2)
    rod = CosseratRod(properties, 20, gravity=WEIGHTLESS, clamp="node")
    rod.settle(BoundaryPoses(HORIZONTAL))
    forces = np.zeros((21, 3))
    forces[-1, 2] = 1.5 * properties.bending_stiffness * 0.02 / LENGTH
    rod.apply_forces(forces)
    loaded = rod.move(STILL)
    rod.apply_forces(0.0 * forces)
    sprung_back = rod.move(STILL).positions
    assert sprung_back[-1, 2] > 1e-4
    rod.restore(loaded)
    rod.set_obstacles([])
    np.testing.assert_allclose(rod.state.positions, sprung_back, atol=1e-8)


def test_plastic_cycles_dissipate():
    properties = RodProperties(LENGTH, yield_curvature=3.0, hardening=0.1)
    rod = CosseratRod(properties, 30, gravity=WEIGHTLESS, clamp="node")
    state = bent(rod, np.array([1.0, 2.0]))
    begin, work = state.energy, 0.0
    for curvature in np.concatenate([np.linspace(2.0, 6.0, 20), np.linspace(6.0, 2.0, 20)]):
        target = BoundaryPoses(HORIZONTAL, arc_end(curvature))
        displacement = state.boundary.displacement_to(target)
        later = rod.move(displacement)
        forces = 0.5 * (state.wrench_right + later.wrench_right)
        assert displacement.right is not None
        work += float(forces @ displacement.right)
        state = later
    dissipated = work - (state.energy - begin)
    # Two ways through the yield range: 2 x M_y x plastic strain, less what did not flow back.
    assert dissipated > 0.5 * properties.bending_stiffness * 3.0 * 2.0 * LENGTH


def test_plastic_rod_is_restored_exactly_in_mid_motion():
    properties = RodProperties(
        LENGTH, yield_curvature=2.0, hardening=0.1, creep=0.5, relaxation_time=0.5,
        internal_damping=0.002,
    )  # fmt: skip
    rod = CosseratRod(properties, 30)
    rng = np.random.default_rng(0)
    rod.settle(random_boundary(rng, LENGTH))
    displacement = BoundaryDisplacement.from_vector(rng.uniform(-0.03, 0.03, 12))
    rod.move(displacement)
    middle = rod.advance(displacement, 0.2, dt=0.02)
    assert np.abs(middle.plastic_curvature).max() > 0.0

    def go_on(rod: CosseratRod):
        rod.advance(displacement.scaled(-1.0), 0.1, dt=0.03, tolerance=1e-4)
        return rod.move(displacement)

    first = go_on(rod)
    rod.restore(middle)
    second = go_on(rod)
    other = CosseratRod(properties, 30)
    other.restore(middle)
    third = go_on(other)
    for state in (second, third):
        for name in ("positions", "quaternions", "plastic_curvature", "stress"):
            np.testing.assert_array_equal(getattr(state, name), getattr(first, name))
        assert state.energy == first.energy


def test_energy_of_an_inelastic_rod_never_grows():
    properties = RodProperties(
        LENGTH, yield_curvature=2.0, hardening=0.1, creep=0.5, relaxation_time=0.5
    )
    rod = CosseratRod(properties, 30)
    rod.settle(random_boundary(np.random.default_rng(1), LENGTH))
    rod.apply_forces(np.tile([0.0, 1e-3, 0.0], (31, 1)))
    rod.restore(rod.state)
    before = rod.state
    for _ in range(100):
        after = rod.advance(BoundaryDisplacement.zero(), 0.02, dt=0.02)
        rise = after.energy + after.kinetic_energy - before.energy - before.kinetic_energy
        assert rise < 1e-12 * abs(before.energy) + 1e-14
        before = after


def test_loaded_cantilever_creeps_as_a_standard_linear_solid():
    share, relaxation = 0.4, 2.0
    properties = RodProperties(LENGTH, youngs_modulus=1e9, creep=share, relaxation_time=relaxation)
    rod = CosseratRod(properties, 40, gravity=WEIGHTLESS, clamp="node")
    forces = np.zeros((41, 3))
    forces[-1, 2] = 0.03 * properties.bending_stiffness / LENGTH**2
    rod.apply_forces(forces)
    start = rod.settle(BoundaryPoses(HORIZONTAL)).positions[-1, 2]
    for time in (1.0, 3.0, 20.0):
        tip = rod.advance(STILL, time - rod.state.time, dt=0.1).positions[-1, 2]
        grown = share / (1.0 - share) * (1.0 - np.exp(-time * (1.0 - share) / relaxation))
        assert abs(tip / start - 1.0 - grown) < 0.01 * share / (1.0 - share)


def test_sensitivity_of_a_yielding_rod_matches_finite_differences():
    properties = RodProperties(LENGTH, yield_curvature=2.0, hardening=0.2)
    rod = CosseratRod(properties, 30)
    rng = np.random.default_rng(6)
    start = rod.settle(random_boundary(rng, LENGTH))
    vector = rng.uniform(-0.02, 0.02, 12)
    end = rod.move(BoundaryDisplacement.from_vector(vector))
    assert np.abs(end.plastic_curvature).max() > 0.1
    sensitivity, h = rod.sensitivity(), 1e-6
    for column in range(3):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(12)
            step[column] = sign * h
            rod.restore(start)
            ends.append(rod.move(BoundaryDisplacement.from_vector(vector + step)).positions)
        difference = (ends[0] - ends[1]) / (2.0 * h)
        np.testing.assert_allclose(sensitivity[:, :, column], difference, atol=2e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"yield_curvature": 0.0}, "yield_curvature"),
        ({"hardening": 1.0}, "hardening: expected 0 <= hardening < 1, got 1.0"),
        ({"creep": -0.1}, "creep"),
        ({"relaxation_time": 0.0}, "relaxation_time"),
        ({"EI": -1.0}, "EI"),
        ({"GJ": np.ones(7)}, "GJ: .* 50, got 7"),
        ({"mass_per_length": 0.0}, "mass_per_length"),
        ({"external_damping": -1.0}, "external_damping"),
        ({"internal_damping": np.nan}, "internal_damping"),
        ({"radius": 0.02}, r"radius: expected at most an element's length, 0.01 m, got 0.02 m"),
    ],
)
def test_impossible_materials_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        CosseratRod(RodProperties(LENGTH, **options), 50)


def test_stiffness_given_directly_replaces_what_the_modulus_says():
    plain = RodProperties(LENGTH, radius=0.002, youngs_modulus=3e6, density=1200.0)
    direct = RodProperties(
        LENGTH, radius=0.002, youngs_modulus=1e9, density=1.0,
        EI=plain.bending_stiffness, GJ=plain.twisting_stiffness, EA=plain.stretching_stiffness,
        kGA=plain.shearing_stiffness, mass_per_length=np.full(50, plain.linear_density),
    )  # fmt: skip
    boundary = random_boundary(np.random.default_rng(0), LENGTH)
    np.testing.assert_array_equal(
        CosseratRod(direct).settle(boundary).positions,
        CosseratRod(plain).settle(boundary).positions,
    )
