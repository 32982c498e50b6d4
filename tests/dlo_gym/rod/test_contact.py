"""Contact and friction against statics, and what must not happen: passing through, creeping."""

import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import exp_so3, frame_along, pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    Box,
    Capsule,
    CosseratRod,
    Plane,
    RodProperties,
    RodState,
    Sphere,
)
from dlo_gym.rod import _kernels_distance as distances
from dlo_gym.rod.obstacles import placed

LENGTH, RADIUS = 0.5, 0.003
ALONG_X = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)


def weight(rod: CosseratRod) -> float:
    return float(rod.properties.linear_density * 9.81 * rod.properties.length)


def lying(**options) -> CosseratRod:
    """A rod on a table, held at its left end."""
    rod = CosseratRod(RodProperties(LENGTH), obstacles=[Plane()], **options)
    rod.settle(BoundaryPoses(pose(ALONG_X, [0.0, 0.0, RADIUS])))
    return rod


def bridge(obstacles, height: float, **options) -> CosseratRod:
    """A slack rod between clamps 0.4 m apart, at rest over the origin; it hangs above when asked
    to start so."""
    rod = CosseratRod(RodProperties(LENGTH), obstacles=obstacles, **options)
    clamps = [
        pose(frame_along([1.0, 0.0, slope], [0.0, 1.0, 0.0]), [x, 0.0, height])
        for x, slope in ((-0.2, 0.3), (0.2, -0.3))
    ]
    s = np.linspace(0.0, 1.0, rod.n_nodes)[:, None]
    start = clamps[0][:3, 3] + s * (clamps[1][:3, 3] - clamps[0][:3, 3])
    start = start + 0.12 * np.sin(np.pi * s) * [0.0, 0.0, 1.0]
    rod.settle(BoundaryPoses(*clamps), start)
    return rod


def test_table_carries_the_weight_of_a_rod_that_lies_on_it():
    rod = lying()
    state = rod.state
    assert state.contact is not None
    carried = -state.contact.on_obstacles[0]
    np.testing.assert_allclose(carried + state.wrench_left[:3], [0, 0, weight(rod)], atol=1e-8)
    assert carried[2] > 0.95 * weight(rod)
    assert -0.01 * RADIUS < state.contact.gaps.min() < 0.0


def test_a_rod_that_friction_holds_does_not_creep():
    rod = lying(friction=0.5)
    loads = np.zeros((rod.n_nodes, 3))
    loads[1:, 1] = 0.3 * weight(rod) / rod.n_elements
    rod.apply_forces(loads)
    first = rod.move(BoundaryDisplacement(np.zeros(6))).positions
    for _ in range(20):
        rod.apply_forces(0.5 * loads)
        rod.move(BoundaryDisplacement(np.zeros(6)))
        rod.apply_forces(loads)
        state = rod.move(BoundaryDisplacement(np.zeros(6)))
    np.testing.assert_allclose(state.positions, first, atol=1e-9)
    rod.apply_forces(0.0 * loads)
    state = rod.move(BoundaryDisplacement(np.zeros(6)))
    np.testing.assert_allclose(state.positions[:, 1], 0.0, atol=1e-6)


def test_dragging_a_rod_along_a_table_takes_friction_times_weight():
    rod = lying(friction=0.4)
    for _ in range(4):
        state = rod.move(BoundaryDisplacement(np.array([-0.002, 0, 0, 0, 0, 0])))
    np.testing.assert_allclose(-state.wrench_left[0], 0.4 * weight(rod), rtol=0.02)


OBSTACLES = {
    "box": [Box(pose(exp_so3([0.0, 0.3, 0.2]), np.zeros(3)), (0.04, 0.3, 0.03))],
    "bar": [Capsule.between([0.0, -0.3, 0.0], [0.0, 0.3, 0.0], 0.004)],
}


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("scale", [1.0, 4.0])
@pytest.mark.parametrize("body", OBSTACLES)
def test_nothing_is_passed_through_in_random_moves(body, scale, friction):
    rod = bridge(OBSTACLES[body], 0.1, friction=friction)
    (obstacle,) = OBSTACLES[body]
    rng = np.random.default_rng(0)
    down = np.tile([0.0, 0.0, -0.002, 0.0, 0.0, 0.0], 2)
    deepest, touched = 0.0, 0
    for _ in range(40 if scale == 1.0 else 15):
        vector = scale * STEP * rng.uniform(-1.0, 1.0, 12) + down
        try:
            state = rod.move(BoundaryDisplacement.from_vector(vector))
        except ValueError:  # overstretched: refused
            continue
        assert state.contact is not None
        touched += state.contact.gaps.min() < 0.0
        # A finer look than the solver's own contact points.
        s = np.linspace(0.0, 1.0, 21)[:, None, None]
        points = ((1.0 - s) * state.positions[:-1] + s * state.positions[1:]).reshape(-1, 3)
        deepest = min(deepest, float(obstacle.signed_distance(points).min()) - RADIUS)
        # It began above, and both bodies reach far to the sides.
        assert points[np.argmin(np.abs(points[:, 0])), 2] > 0.0
    assert touched > 10
    assert deepest > -0.1 * RADIUS


def test_symmetric_contact_of_a_symmetric_setup():
    rod = CosseratRod(RodProperties(LENGTH), obstacles=[Plane()])
    state = rod.settle(BoundaryPoses(*[pose(ALONG_X, [x, 0.0, 0.03]) for x in (-0.244, 0.244)]))
    assert state.contact is not None
    forces = state.contact.forces[0]
    assert np.linalg.norm(forces) > 0.01
    np.testing.assert_allclose(forces, forces[::-1] * [-1, 1, 1], atol=1e-6)
    mirrored = state.positions[::-1] * [-1, 1, 1]
    np.testing.assert_allclose(state.positions, mirrored, atol=1e-7)


def test_clamp_inside_an_obstacle_is_refused_with_both_named():
    rod = lying()
    before = rod.state
    with pytest.raises(ValueError, match=r"clamp left.*obstacles\[0\].*Plane.*0\.005"):
        rod.move(BoundaryDisplacement(np.array([0, 0, -0.005, 0, 0, 0])))
    np.testing.assert_array_equal(rod.state.positions, before.positions)
    with pytest.raises(ValueError, match="clamp left"):
        rod.settle(BoundaryPoses(pose(ALONG_X, [0.0, 0.0, -0.1])))


def test_settling_from_inside_an_obstacle_pushes_the_rod_out():
    bar = Capsule.between([0.25, -0.1, 0.0], [0.25, 0.1, 0.0], 0.01)
    rod = CosseratRod(RodProperties(LENGTH), obstacles=[bar])
    state = rod.settle(BoundaryPoses(pose(ALONG_X, [0.0, 0.0, 0.002])))
    assert state.contact is not None
    assert state.contact.gaps.min() > -0.01 * RADIUS


def test_a_rod_in_motion_rests_among_other_obstacles():
    rod = bridge([], 0.3)
    swing = np.array([0.02, 0.0, 0.0, 0.0, 0.2, 0.0])
    rod.advance(BoundaryDisplacement(swing, swing), 0.1)
    assert np.abs(rod.state.velocities).max() > 0.1
    rod.set_obstacles([Plane()])
    state = rod.state
    for still in (state.velocities, state.angular_velocities, state.memory.clamp_spins):
        assert not still.any()
    np.testing.assert_allclose(
        rod.move(BoundaryDisplacement.zero()).positions, state.positions, atol=1e-9
    )


def test_pushing_obstacle_takes_the_rod_along():
    rod = lying()
    pusher = Sphere.at([0.4, 0.03, 0.01], 0.01)
    rod.set_obstacles([Plane(), pusher])
    for _ in range(10):
        pusher = placed(pusher, pose(np.eye(3), pusher.pose[:3, 3] + [0.0, -0.005, 0.0]))
        state = rod.move(BoundaryDisplacement(np.zeros(6)), obstacles=[Plane(), pusher])
    assert state.contact is not None
    assert -0.02 * RADIUS < state.contact.gaps[1].min() < 0.0
    assert state.positions[:, 1].min() < -0.03
    assert state.contact.on_obstacles[1][1] > 0.0
    with pytest.raises(ValueError, match="own bodies"):
        rod.move(BoundaryDisplacement(np.zeros(6)), obstacles=[pusher])


def test_rod_rests_on_a_table_that_moves_and_goes_with_it():
    rod = lying(friction=0.6)
    tip = rod.state.positions[-1]
    shift = np.array([0.01, 0.0, 0.0])
    state = rod.move(
        BoundaryDisplacement(np.r_[shift, 0, 0, 0]),
        obstacles=[Plane(pose(np.eye(3), shift))],
    )
    np.testing.assert_allclose(state.positions[-1], tip + shift, atol=1e-6)
    assert np.abs(state.contact.forces[0, :, :2]).max() < 1e-6  # no friction was called on


def wrapped_once(**options) -> CosseratRod:
    """A rod that goes once around a bar and down to both clamps, as in a cable on a metal bar."""
    bar_radius = 0.015
    turn = bar_radius + RADIUS
    angle, tail = 3.0 * np.pi, 0.5 * (LENGTH - 3.0 * np.pi * turn)
    s = np.linspace(-tail, LENGTH - tail, 61)
    turned = np.clip(s / turn, 0.0, angle)
    along = np.column_stack([0.0 * turned - np.sin(turned), 0.0 * turned, np.cos(turned)])
    curve = (s - turn * turned)[:, None] * along + np.column_stack(
        [
            turn * np.cos(turned),
            2.5 * RADIUS * (turned - 0.5 * angle) / np.pi,
            turn * np.sin(turned),
        ]
    )
    bar = Capsule.between([0.0, -0.2, 0.0], [0.0, 0.2, 0.0], bar_radius)
    rod = CosseratRod(RodProperties(LENGTH), 60, obstacles=[bar], **options)
    ends = [
        pose(frame_along(t, [0.0, 1.0, 0.0]), p)
        for t, p in zip(along[[0, -1]], curve[[0, -1]], strict=True)
    ]
    rod.settle(BoundaryPoses(*ends), curve)
    return rod


def winding(state: RodState) -> float:
    """Turns of the centerline around the y axis."""
    angles = np.unwrap(np.arctan2(state.positions[:, 2], state.positions[:, 0]))
    return float((angles[-1] - angles[0]) / (2.0 * np.pi))


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_rod_wrapped_around_a_bar_stays_wrapped(friction):
    rod = wrapped_once(friction=friction, self_contact=True)
    rng = np.random.default_rng(1)
    turns = winding(rod.state)
    assert turns > 1.5
    for _ in range(40):
        vector = STEP * rng.uniform(-1.0, 1.0, 12)
        try:
            state = rod.move(BoundaryDisplacement.from_vector(vector))
        except (ValueError, RodDiverged):
            continue
        assert state.contact is not None
        assert state.contact.gaps.min() > -0.1 * RADIUS
    assert abs(winding(state) - turns) < 0.3


def least_distance(positions: np.ndarray, apart: int) -> float:
    """Between elements at least ``apart`` elements from each other along the rod [m]."""
    n = len(positions) - 1
    return min(
        distances.segment_distance(positions[e], positions[e + 1], positions[f], positions[f + 1])[
            0
        ]
        for e in range(n)
        for f in range(e + apart, n)
    )


def test_twisted_rod_loops_but_does_not_pass_through_itself():
    radius = 0.004
    rod = CosseratRod(
        RodProperties(LENGTH, radius, youngs_modulus=1e7),
        60,
        gravity=(0.0, 0.0, -1.0),
        self_contact=True,
    )
    clamps = [pose(ALONG_X, [x, 0.0, 0.0]) for x in (-0.2, 0.2)]
    rod.settle(BoundaryPoses(*clamps))
    forces = []
    for _ in range(130):
        vector = np.zeros(12)
        vector[6], vector[9] = -0.0015, np.deg2rad(10.0)
        state = rod.move(BoundaryDisplacement.from_vector(vector))
        assert state.contact is not None
        forces.append(np.linalg.norm(state.contact.self_forces))
        np.testing.assert_allclose(state.contact.self_forces.sum(axis=0), 0.0, atol=1e-9)
        if forces[-1] > 0.0:
            assert least_distance(state.positions, 6) > 0.97 * 2.0 * radius
    assert max(forces) > 0.1


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_sensitivity_matches_finite_differences_in_contact(friction):
    rod = bridge(OBSTACLES["bar"], 0.1, friction=friction)
    for _ in range(25):
        rod.move(
            BoundaryDisplacement.from_vector([0, 0, -0.005, 0, 0, 0, 1e-3, 0, -0.005, 0, 0, 0])
        )
    state, sensitivity = rod.state, rod.sensitivity()
    assert state.contact is not None
    assert np.linalg.norm(state.contact.forces) > 0.01
    compare(rod, state, sensitivity, 1e-7, 1e-3)


def test_sensitivity_matches_finite_differences_in_self_contact():
    rod = CosseratRod(
        RodProperties(LENGTH, 0.004, youngs_modulus=1e7),
        60,
        gravity=(0.0, 0.0, -1.0),
        self_contact=True,
    )
    rod.settle(BoundaryPoses(*[pose(ALONG_X, [x, 0.0, 0.0]) for x in (-0.2, 0.2)]))
    for _ in range(120):
        vector = np.zeros(12)
        vector[6], vector[9] = -0.0015, np.deg2rad(10.0)
        rod.move(BoundaryDisplacement.from_vector(vector))
    state, sensitivity = rod.state, rod.sensitivity()
    assert state.contact is not None
    assert np.linalg.norm(state.contact.self_forces) > 0.01
    compare(rod, state, sensitivity, 1e-7, 1e-3)


def compare(rod, state, sensitivity, h, tolerance):
    for column in range(12):
        twist = np.zeros(12)
        twist[column] = h
        ends = []
        for sign in (1.0, -1.0):
            rod.restore(state)
            ends.append(rod.move(BoundaryDisplacement.from_vector(sign * twist)).positions)
        measured = (ends[0] - ends[1]) / (2.0 * h)
        scale = np.abs(sensitivity[:, :, column]).max()
        np.testing.assert_allclose(sensitivity[:, :, column], measured, atol=tolerance * scale)


def test_restore_is_exact_with_friction_and_other_obstacles_in_between():
    rod = wrapped_once(friction=0.3, self_contact=True)
    rng = np.random.default_rng(3)
    for _ in range(5):
        rod.move(BoundaryDisplacement.from_vector(STEP * rng.uniform(-0.5, 0.5, 12)))
    saved = rod.state
    displacement = BoundaryDisplacement.from_vector(STEP * rng.uniform(-0.5, 0.5, 12))
    first = rod.move(displacement)
    rod.move(BoundaryDisplacement.from_vector(STEP * rng.uniform(-0.5, 0.5, 12)))
    rod.restore(saved)
    np.testing.assert_array_equal(rod.state.contact.forces, saved.contact.forces)
    np.testing.assert_array_equal(rod.state.wrench_left, saved.wrench_left)
    second = rod.move(displacement)
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.quaternions, second.quaternions)
    np.testing.assert_array_equal(first.contact.anchors, second.contact.anchors)


def test_obstacle_out_of_reach_changes_nothing():
    clamps = bridge([], 0.5).state.boundary
    free = CosseratRod(RodProperties(LENGTH))
    watched = CosseratRod(RodProperties(LENGTH), obstacles=[Plane()], self_contact=True, friction=1)
    shift = BoundaryDisplacement.from_vector(STEP * np.random.default_rng(5).uniform(-1, 1, 12))
    for rod in (free, watched):
        rod.settle(clamps)
        rod.move(shift)
    np.testing.assert_allclose(watched.state.positions, free.state.positions, atol=1e-8)
    assert free.state.contact is None


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_falling_rod_comes_to_rest_on_the_table_and_gains_no_energy(friction):
    rod = CosseratRod(
        RodProperties(LENGTH, internal_damping=0.01), obstacles=[Plane()], friction=friction
    )
    masses = np.ones((rod.n_nodes, 1)) / rod.n_elements
    masses[[0, -1]] *= 0.5
    rod.apply_forces(weight(rod) * masses * [0.0, 0.0, 1.0])  # straight as if there was no weight
    rod.settle(BoundaryPoses(pose(ALONG_X, [0.0, 0.0, 0.05])))
    rod.apply_forces(np.zeros((rod.n_nodes, 3)))
    energy, fastest = np.inf, 0.0
    for _ in range(40):
        state = rod.advance(BoundaryDisplacement(np.zeros(6)), 0.05, dt=0.005)
        assert state.contact is not None
        assert state.contact.gaps.min() > -0.1 * RADIUS
        assert state.energy + state.kinetic_energy <= energy + 1e-9
        energy = state.energy + state.kinetic_energy
        fastest = max(fastest, np.abs(state.velocities).max())
    assert fastest > 0.1
    np.testing.assert_allclose(state.velocities, 0.0, atol=1e-3)
    carried = -state.contact.on_obstacles[0, 2]
    assert carried > 0.5 * weight(rod)
    np.testing.assert_allclose(carried + state.wrench_left[2], weight(rod), rtol=1e-3)
