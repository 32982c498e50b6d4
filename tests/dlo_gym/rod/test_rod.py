"""The rod's own promises: equilibrium, moves, exact state, sensitivities, refusals."""

import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import exp_so3, frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import hanging, random_boundary

LENGTH = 0.5
STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)


def settled(seed: int, **options) -> CosseratRod:
    rod = CosseratRod(RodProperties(LENGTH), **options)
    rod.settle(random_boundary(np.random.default_rng(seed), LENGTH))
    return rod


def random_step(rng: np.random.Generator, scale: float = 1.0) -> BoundaryDisplacement:
    return BoundaryDisplacement.from_vector(scale * STEP * rng.uniform(-1.0, 1.0, 12))


@pytest.mark.parametrize("seed", range(5))
def test_clamps_balance_the_weight(seed):
    rod = settled(seed)
    state, properties = rod.state, rod.properties
    weight = np.array([0.0, 0.0, -9.81 * properties.linear_density * LENGTH])
    force = state.wrench_left[:3] + state.wrench_right[:3] + weight
    np.testing.assert_allclose(force, 0.0, atol=1e-7)
    # Moments about the world origin.
    masses = np.full(rod.n_nodes, 1.0)
    masses[[0, -1]] = 0.5
    moment = state.wrench_left[3:] + state.wrench_right[3:]
    moment = moment + np.cross(state.positions[0], state.wrench_left[:3])
    moment += np.cross(state.positions[-1], state.wrench_right[:3])
    moment += np.cross(masses @ state.positions / masses.sum(), weight)
    np.testing.assert_allclose(moment, 0.0, atol=1e-7)


def test_state_holds_the_clamps_exactly():
    state = settled(0).state
    assert state.boundary.right is not None
    np.testing.assert_array_equal(state.positions[0], state.boundary.left[:3, 3])
    np.testing.assert_array_equal(state.positions[-1], state.boundary.right[:3, 3])
    np.testing.assert_allclose(state.directors[0], state.boundary.left[:3, :3], atol=1e-3)


def test_rotating_everything_about_the_vertical_rotates_the_answer():
    rng = np.random.default_rng(1)
    rod = settled(2)
    turn = pose(exp_so3([0.0, 0.0, 1.1]), [0.4, -0.3, 0.2])
    boundary = rod.state.boundary
    turned_rod = CosseratRod(RodProperties(LENGTH))
    turned_rod.settle(BoundaryPoses(turn @ boundary.left, turn @ boundary.right))
    for _ in range(10):
        vector = random_step(rng).vector
        turned = (vector.reshape(4, 3) @ turn[:3, :3].T).ravel()
        positions = rod.move(BoundaryDisplacement.from_vector(vector)).positions
        state = turned_rod.move(BoundaryDisplacement.from_vector(turned))
        expected = positions @ turn[:3, :3].T + turn[:3, 3]
        np.testing.assert_allclose(state.positions, expected, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_moves_in_steps_end_where_settling_from_there_ends(seed):
    rod = settled(seed)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        rod.move(random_step(rng))
    end = rod.state
    again = CosseratRod(RodProperties(LENGTH)).settle(end.boundary, start=end.positions + 1e-3)
    np.testing.assert_allclose(again.positions, end.positions, atol=1e-6)


def test_large_move_is_sub_stepped_to_the_same_place():
    rng = np.random.default_rng(4)
    rod = settled(5)
    start, displacement = rod.state, random_step(rng, 8.0)
    at_once = rod.move(displacement).positions
    rod.restore(start)
    boundary = start.boundary
    for i in range(1, 33):
        target = start.boundary.displaced(displacement.scaled(i / 32))
        rod.move(boundary.displacement_to(target))
        boundary = target
    np.testing.assert_allclose(rod.state.positions, at_once, atol=1e-7)


@pytest.mark.parametrize("held", ["both", "left"])
def test_sensitivity_matches_finite_differences(held):
    boundary = random_boundary(np.random.default_rng(6), LENGTH)
    if held == "left":
        boundary = BoundaryPoses(boundary.left)
    rod = CosseratRod(RodProperties(LENGTH, youngs_modulus=1e7))
    rod.settle(boundary)
    state, sensitivity = rod.state, rod.sensitivity()
    assert sensitivity.shape == (51, 3, 12)
    h = 1e-5
    for column in range(12 if held == "both" else 6):
        twist = np.zeros(12 if held == "both" else 6)
        twist[column] = h
        ends = []
        for sign in (1.0, -1.0):
            rod.restore(state)
            ends.append(rod.move(BoundaryDisplacement.from_vector(sign * twist)).positions)
        np.testing.assert_allclose(
            sensitivity[:, :, column], (ends[0] - ends[1]) / (2 * h), atol=1e-6
        )
    if held == "left":
        assert not sensitivity[:, :, 6:].any()


def test_restore_is_exact_to_the_last_bit():
    rod = settled(7)
    for seed in range(5):
        rod.move(random_step(np.random.default_rng(seed)))
    saved = rod.state
    displacement = random_step(np.random.default_rng(9))
    first = rod.move(displacement)
    rod.settle(random_boundary(np.random.default_rng(11), LENGTH))
    rod.restore(saved)
    np.testing.assert_array_equal(rod.state.positions, saved.positions)
    np.testing.assert_array_equal(rod.state.wrench_left, saved.wrench_left)
    second = rod.move(displacement)
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.quaternions, second.quaternions)
    assert first.energy == second.energy
    other = CosseratRod(RodProperties(LENGTH))
    other.restore(saved)
    np.testing.assert_array_equal(other.move(displacement).positions, first.positions)


def test_long_sequences_keep_the_rod_whole():
    rod = settled(8)
    rng = np.random.default_rng(8)
    state = rod.state
    moved = 0
    for _ in range(500):
        try:
            state = rod.move(random_step(rng, 2.0))
            moved += 1
        except ValueError:  # overstretched: refused, and the rod stays as it was
            np.testing.assert_array_equal(rod.state.positions, state.positions)
    assert moved > 400
    assert np.abs(state.strain).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(state.quaternions, axis=1), 1.0, atol=1e-12)


def test_stiffness_may_vary_along_the_rod():
    stiffness = np.full(50, 1e6)
    stiffness[:25] = 1e8
    clamp = pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), np.zeros(3))
    state = CosseratRod(RodProperties(LENGTH, youngs_modulus=stiffness)).settle(
        BoundaryPoses(clamp)
    )
    bend = np.linalg.norm(state.curvature, axis=1)
    assert bend[:24].max() < 0.5 * bend[24]


def test_overstretching_is_refused_with_both_lengths():
    rod = settled(0)
    state = rod.state
    with pytest.raises(ValueError, match=r"overstretched.*2\.\d+ m apart.*0\.5000 m long"):
        rod.move(BoundaryDisplacement(np.zeros(6), np.array([2.0, 0, 0, 0, 0, 0])))
    np.testing.assert_array_equal(rod.state.positions, state.positions)
    far = pose(np.eye(3), [0.6, 0.0, 0.0])
    with pytest.raises(ValueError, match="overstretched"):
        rod.settle(BoundaryPoses(pose(np.eye(3), np.zeros(3)), far))


def test_properties_per_element_may_be_a_list():
    listed = RodProperties(LENGTH, youngs_modulus=[1e6] * 50, density=[1e3] * 50)
    boundary = random_boundary(np.random.default_rng(0), LENGTH)
    np.testing.assert_array_equal(
        CosseratRod(listed).settle(boundary).positions,
        CosseratRod(RodProperties(LENGTH)).settle(boundary).positions,
    )


@pytest.mark.parametrize("seed", range(30))
def test_starting_curve_has_the_length_and_leaves_along_the_clamps(seed):
    boundary = random_boundary(np.random.default_rng(seed), LENGTH)
    curve = hanging(boundary, LENGTH, 51)
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    assert abs(steps.sum() - LENGTH) < 0.05 * LENGTH
    np.testing.assert_allclose(curve[0], boundary.left[:3, 3], atol=1e-12)


def test_a_wrong_shape_is_refused_and_the_rod_stays_as_it_was(monkeypatch):
    rod = settled(3)
    before = rod.state
    displacement = random_step(np.random.default_rng(3), 4.0)
    after = rod.move(displacement)
    rod.restore(before)
    # A limit on the bend between elements that the start keeps and the end does not.
    bends = [np.linalg.norm(state.curvature, axis=1).max() / 100 for state in (before, after)]
    monkeypatch.setattr(rod, "_bounds", rod._bounds._replace(bend=float(np.mean(bends))))
    if bends[0] > bends[1]:
        rod.restore(after)
        displacement, before = displacement.scaled(-1.0), after
    with pytest.raises(
        RodDiverged, match=r"lost at \d+ % of a move by.*elements bend by"
    ) as caught:
        rod.move(displacement)
    np.testing.assert_array_equal(rod.state.positions, before.positions)
    np.testing.assert_array_equal(caught.value.last_good.positions, before.positions)
    assert rod.state.energy == before.energy


def test_divergence_is_not_judged_by_finite_values_alone():
    rod = settled(4)
    start = rod.state.positions
    broken = start + np.random.default_rng(0).normal(scale=0.3, size=start.shape)
    try:
        state = rod.settle(rod.state.boundary, start=broken)
    except RodDiverged:
        np.testing.assert_array_equal(rod.state.positions, start)
    else:  # whatever was found is a rod: whole, smooth and in balance
        assert np.abs(state.strain).max() < 0.05
        weight = 9.81 * rod.properties.linear_density * LENGTH
        assert abs(state.wrench_left[2] + state.wrench_right[2] - weight) < 1e-7
