"""Motion: damping, order with moving clamps, energy, momentum, exact state, refusals.

Frequencies and peers: test_validation_dynamics.py."""

import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    CosseratRod,
    RodProperties,
    RodState,
)
from dlo_gym.rod.initial_shapes import random_boundary

LENGTH = 0.5
HORIZONTAL = BoundaryPoses(pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), np.zeros(3)))
ONE_STILL = BoundaryDisplacement(np.zeros(6))
BOTH_STILL = BoundaryDisplacement.zero()
WEIGHTLESS = (0.0, 0.0, 0.0)


def released(properties: RodProperties, n: int, load: np.ndarray) -> CosseratRod:
    """A cantilever bent by a force (3,) [N] on its free end, just let go."""
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    forces = np.zeros((n + 1, 3))
    forces[-1] = load
    rod.apply_forces(forces)
    rod.settle(HORIZONTAL)
    rod.apply_forces(np.zeros_like(forces))
    rod.restore(rod.state)  # its energy without the loads
    return rod


def swung(seed: int, properties: RodProperties, n: int = 30) -> CosseratRod:
    """Let go from an equilibrium under sideways loads, between two clamps."""
    rng = np.random.default_rng(seed)
    rod = CosseratRod(properties, n)
    forces = np.zeros((n + 1, 3))
    weight = 9.81 * properties.linear_density * properties.length
    forces[1:-1] = weight / n * rng.normal(size=3)
    boundary = random_boundary(rng, properties.length)
    rod.apply_forces(forces)
    rod.settle(boundary)
    rod.apply_forces(np.zeros_like(forces))
    rod.restore(rod.state)  # its energy without the loads
    return rod


def test_internal_damping_takes_the_closed_form_share_of_each_swing():
    properties = RodProperties(
        LENGTH, radius=0.002, youngs_modulus=1e8, internal_damping=0.01, external_damping=0.1
    )
    stiffness, line = properties.bending_stiffness, properties.linear_density
    omega = 1.8751040687**2 * np.sqrt(stiffness / (line * LENGTH**4))
    rod = released(properties, 30, np.array([0.0, 0.0, 0.02 * stiffness / LENGTH**2]))
    dt = 2.0 * np.pi / omega / 200.0
    z = np.array([rod.advance(ONE_STILL, dt, dt=dt).positions[-1, 2] for _ in range(800)])
    peaks = np.abs(z[1:-1][(np.abs(z[1:-1]) > np.abs(z[:-2])) & (np.abs(z[1:-1]) > np.abs(z[2:]))])
    decay = -np.polyfit(np.arange(len(peaks) - 1), np.log(peaks[1:]), 1)[0] * omega / np.pi
    assert abs(decay / (0.5 * (0.1 + 0.01 * omega**2)) - 1.0) < 0.02


def orders_in_dt(run, order: int) -> np.ndarray:
    """Measured orders of positions and velocities of ``run(steps, order)``."""
    exact, counts = run(400, 2), np.array([20, 40, 80])
    errors = np.array([
        [np.abs(a - b).max() for a, b in zip(run(count, order), exact, strict=True)]
        for count in counts
    ])  # fmt: skip
    orders = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    print(f"order {order}: measured {orders}, errors at {counts[-1]} steps {errors[-1]}")
    return orders


@pytest.mark.parametrize("order", [1, 2])
def test_error_with_moving_clamps_and_damping_falls_with_the_order(order):
    properties = RodProperties(
        LENGTH, youngs_modulus=1e7, external_damping=0.5, internal_damping=0.005
    )
    rod = swung(3, properties)
    start = rod.state
    vector = np.array([0.02, 0.0, 0.03, 0.1, 0.2, 0.3, 0.0, -0.02, 0.0, -0.2, 0.1, 0.0])

    def run(steps: int, order: int) -> tuple[np.ndarray, np.ndarray]:
        rod.restore(start)
        rod.advance(BOTH_STILL, 0.05, dt=0.05 / steps, order=order)
        displacement = BoundaryDisplacement.from_vector(vector)
        state = rod.advance(displacement, 0.1, dt=0.1 / steps, order=order)
        return state.positions, state.velocities

    orders = orders_in_dt(run, order)
    assert orders.min() > order - 0.25


@pytest.mark.parametrize("seed", range(8))
def test_energy_never_grows_between_still_clamps(seed):
    rng = np.random.default_rng(seed)
    properties = RodProperties(
        length=rng.uniform(0.2, 2.0),
        radius=rng.uniform(0.001, 0.006),
        youngs_modulus=10.0 ** rng.uniform(5.0, 9.0),
    )
    rod = swung(seed, properties)
    state = rod.state
    for order, dt in ((2, 0.01), (2, 0.1), (1, 0.03), (2, 0.03)):
        rod.restore(state)
        now = state
        for _ in range(100):
            later = rod.advance(BOTH_STILL, dt, dt=dt, order=order)
            rise = later.energy + later.kinetic_energy - now.energy - now.kinetic_energy
            assert rise < 1e-12 * abs(now.energy) + 1e-15
            now = later


def momenta(rod: CosseratRod, state: RodState) -> np.ndarray:
    """(6,) momentum [kg m/s] and angular momentum about the origin [kg m^2/s]."""
    line, n = rod.properties.linear_density, rod.n_elements
    element = line * rod.properties.length / n
    nodes = np.full((rod.n_nodes, 1), element)
    nodes[[0, -1]] *= 0.5
    inertia = 0.25 * element * rod.properties.radius**2 * np.array([1.0, 1.0, 2.0])
    spins = np.einsum("eij,ej->i", state.directors, inertia * state.angular_velocities)
    swing = (nodes * np.cross(state.positions, state.velocities)).sum(axis=0)
    return np.concatenate([(nodes * state.velocities).sum(axis=0), swing + spins])


@pytest.mark.parametrize("held", ["both", "left"])
@pytest.mark.parametrize(("external", "internal"), [(0.0, 0.0), (5.0, 0.01)])
def test_clamps_weight_and_damping_change_the_momentum(held, external, internal):
    properties = RodProperties(LENGTH, external_damping=external, internal_damping=internal)
    rod = CosseratRod(properties, 40)
    boundary = random_boundary(np.random.default_rng(0), LENGTH)
    rod.settle(boundary if held == "both" else BoundaryPoses(boundary.left))
    rates = np.array([0.2, 0, 0.1, 1.0, 0.5, -1.0, -0.1, 0.2, 0.2, -1.0, 0.4, 0.8])
    dt = 5e-4
    step = BoundaryDisplacement.from_vector(dt * rates[: 12 if held == "both" else 6])
    weight = properties.linear_density * LENGTH * rod.gravity
    masses = np.ones(rod.n_nodes)
    masses[[0, -1]] = 0.5
    for _ in range(100):
        rod.advance(step, dt, dt=dt)
    momentum, loads = [], []
    for _ in range(41):
        state = rod.advance(step, dt, dt=dt)
        momentum.append(momenta(rod, state))
        load = -external * momentum[-1]
        centre = masses @ state.positions / masses.sum()
        load += np.concatenate([weight, np.cross(centre, weight)])
        for end, wrench in ((0, state.wrench_left), (-1, state.wrench_right)):
            load[:3] += wrench[:3]
            load[3:] += wrench[3:] + np.cross(state.positions[end], wrench[:3])
        loads.append(load)
    impulse = np.trapezoid(loads, dx=dt, axis=0)
    scale = 40 * dt * np.abs(loads).max(axis=0)
    np.testing.assert_array_less(np.abs(momentum[-1] - momentum[0] - impulse) / scale, 1e-3)


def test_restore_in_mid_motion_is_exact():
    properties = RodProperties(LENGTH, internal_damping=0.002, external_damping=1.0)
    rod = swung(5, properties)
    vector = 0.02 * np.random.default_rng(5).uniform(-1.0, 1.0, 12)
    displacement = BoundaryDisplacement.from_vector(vector)
    middle = rod.advance(displacement, 0.1, dt=0.02, tolerance=1e-4)

    def go_on(rod: CosseratRod):
        rod.advance(displacement, 0.1, dt=0.03, tolerance=1e-5)
        return rod.move(displacement)

    first = go_on(rod)
    rod.restore(middle)
    np.testing.assert_array_equal(rod.state.wrench_left, middle.wrench_left)
    second = go_on(rod)
    other = CosseratRod(properties, 30)
    other.restore(middle)
    third = go_on(other)
    for state in (second, third):
        for name in (
            "positions", "quaternions", "velocities", "angular_velocities", "stress",
            "wrench_left", "wrench_right",
        ):  # fmt: skip
            np.testing.assert_array_equal(getattr(state, name), getattr(first, name))
        assert (state.energy, state.time) == (first.energy, first.time)


def test_motion_that_has_died_down_is_the_equilibrium():
    rod = swung(7, RodProperties(LENGTH, external_damping=8.0))
    end = rod.advance(BOTH_STILL, 6.0, dt=0.05)
    assert np.abs(end.velocities).max() < 1e-6
    np.testing.assert_allclose(rod.move(BOTH_STILL).positions, end.positions, atol=1e-6)


def test_tolerance_bounds_the_error():
    rod = swung(8, RodProperties(LENGTH, external_damping=1.0))
    start = rod.state
    exact = rod.advance(BOTH_STILL, 0.3, dt=0.001).positions
    errors = []
    for tolerance in (1e-3, 1e-4, 1e-5):
        rod.restore(start)
        positions = rod.advance(BOTH_STILL, 0.3, dt=0.1, tolerance=tolerance).positions
        errors.append(np.abs(positions - exact).max())
    print("errors [m] at tolerances 1e-3, 1e-4, 1e-5:", errors)
    assert errors[2] < 5e-4
    assert errors[2] < errors[1] < errors[0]


def test_held_nodes_have_the_clamps_velocity():
    rod = swung(9, RodProperties(LENGTH))
    vector = 0.01 * np.random.default_rng(9).uniform(-1.0, 1.0, 12)
    state = rod.advance(BoundaryDisplacement.from_vector(vector), 0.1, dt=0.02)
    assert state.boundary.right is not None
    np.testing.assert_allclose(state.velocities[0], vector[:3] / 0.1)
    np.testing.assert_allclose(state.velocities[-1], vector[6:9] / 0.1)
    np.testing.assert_allclose(state.positions[0], state.boundary.left[:3, 3], atol=1e-15)
    np.testing.assert_allclose(state.positions[-1], state.boundary.right[:3, 3], atol=1e-15)
    assert abs(state.time - 0.1) < 1e-15


def test_lost_motion_restores_the_state(monkeypatch):
    rod = swung(1, RodProperties(LENGTH))
    before = rod.state
    monkeypatch.setattr(rod, "_bounds", rod._bounds._replace(bend=1e-6))
    with pytest.raises(RodDiverged, match="lost .* s into an advance of 0.1 s") as caught:
        rod.advance(BOTH_STILL, 0.1, dt=0.05)
    np.testing.assert_array_equal(rod.state.positions, before.positions)
    np.testing.assert_array_equal(caught.value.last_good.positions, before.positions)
    assert rod.state.time == before.time
