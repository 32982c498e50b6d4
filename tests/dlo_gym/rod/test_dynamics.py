"""Motion: frequencies of the continuous rod, order in the time step, energy, PyElastica."""

import numpy as np
import pytest
from scipy.special import j0

from benchmarks.pyelastica_peer import PyElasticaRod
from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary

LENGTH = 0.5
HORIZONTAL = BoundaryPoses(pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), np.zeros(3)))
ONE_STILL = BoundaryDisplacement(np.zeros(6))
BOTH_STILL = BoundaryDisplacement.zero()
WEIGHTLESS = (0.0, 0.0, 0.0)


def period_of(signal: np.ndarray, dt: float) -> float:
    """Mean period [s] of a signal that oscillates about zero."""
    before = np.flatnonzero(signal[1:] * signal[:-1] < 0.0)
    crossings = before + signal[before] / (signal[before] - signal[before + 1])
    return 2.0 * dt * float(np.diff(crossings).mean())


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


def test_cantilever_vibrates_at_its_first_frequency():
    properties = RodProperties(LENGTH, radius=0.002, youngs_modulus=1e8)
    stiffness, line = properties.bending_stiffness, properties.linear_density
    exact = 2.0 * np.pi / (1.8751040687**2 * np.sqrt(stiffness / (line * LENGTH**4)))
    rod = released(properties, 40, np.array([0.0, 0.0, 0.02 * stiffness / LENGTH**2]))
    dt = exact / 100.0
    heights = [rod.advance(ONE_STILL, dt, dt=dt).positions[-1, 2] for _ in range(300)]
    assert abs(period_of(np.array(heights), dt) / exact - 1.0) < 0.002


def test_clamped_free_rod_twists_at_a_quarter_wave():
    properties = RodProperties(LENGTH, radius=0.005, youngs_modulus=1e7)
    spin = 0.5 * properties.linear_density * properties.radius**2
    exact = 4.0 * LENGTH / np.sqrt(properties.twisting_stiffness / spin)
    rod = CosseratRod(properties, 40, gravity=WEIGHTLESS, clamp="node")
    state = rod.settle(HORIZONTAL)
    angle = 0.05 * np.sin(0.5 * np.pi * (np.arange(40) + 0.5) / 40)
    turn = np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])
    w, x, y, z = state.quaternions.T
    c, s = turn[:, 0], turn[:, 3]
    twisted = np.column_stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s])
    rod.restore(type(state)(**{**vars(state), "quaternions": twisted}))
    dt = exact / 100.0
    spins = [rod.advance(ONE_STILL, dt, dt=dt).angular_velocities[-1, 2] for _ in range(300)]
    assert abs(period_of(np.array(spins), dt) / exact - 1.0) < 0.002


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
def test_error_falls_with_the_order_of_the_method(order):
    rod = released(RodProperties(LENGTH), 20, np.array([2e-4, 1e-4, 3e-4]))
    start = rod.state

    def run(steps: int, order: int) -> tuple[np.ndarray, np.ndarray]:
        rod.restore(start)
        state = rod.advance(ONE_STILL, 0.4, dt=0.4 / steps, order=order)
        return state.positions, state.velocities

    orders = orders_in_dt(run, order)
    assert orders[0] > order - 0.3


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


def test_a_hanging_thread_swings_as_a_heavy_chain():
    down = BoundaryPoses(pose(frame_along([0.0, 0.0, -1.0], [0.0, 1.0, 0.0]), np.zeros(3)))
    rod = CosseratRod(RodProperties(LENGTH, radius=2e-4, youngs_modulus=1e5), 40)
    weight = 9.81 * rod.properties.linear_density * LENGTH
    rod.apply_forces(np.tile([1e-3 * weight / 40, 0.0, 0.0], (41, 1)))
    rod.settle(down)
    rod.apply_forces(np.zeros((41, 3)))
    first_mode = j0(2.404826 * np.sqrt(1.0 - np.arange(41) / 40))
    side = np.array([
        first_mode @ rod.advance(ONE_STILL, 0.01, dt=0.01).positions[:, 0] for _ in range(600)
    ])  # fmt: skip
    exact = 2.0 * np.pi / (0.5 * 2.404826 * np.sqrt(9.81 / LENGTH))
    assert abs(period_of(side, 0.01) / exact - 1.0) < 0.01


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


@pytest.mark.parametrize("seed", range(3))
def test_moves_as_pyelastica_moves(seed):
    rng = np.random.default_rng(seed)
    properties = RodProperties(LENGTH, external_damping=5.0)
    rod = CosseratRod(properties)
    start = rod.settle(random_boundary(rng, LENGTH))
    while True:
        size = np.tile([0.05] * 3 + [0.4] * 3, 2)
        displacement = BoundaryDisplacement.from_vector(size * rng.uniform(-1.0, 1.0, 12))
        if start.boundary.displaced(displacement).distance < 0.48:
            break
    peer = PyElasticaRod(properties, start, displacement, duration=0.25, damping=5.0)
    peer.advance(0.25)
    state = rod.advance(displacement, 0.25, dt=0.002)
    distances = np.linalg.norm(peer.positions - state.positions, axis=1)
    print(f"during: mean {1e3 * distances.mean():.3f} mm, max {1e3 * distances.max():.3f} mm")
    assert distances.max() < 0.5e-3
    assert np.linalg.norm(state.positions - start.positions, axis=1).max() > 0.02
    peer.advance(0.25)
    state = rod.advance(BOTH_STILL, 0.25, dt=0.002)
    distances = np.linalg.norm(peer.positions - state.positions, axis=1)
    print(f"after: mean {1e3 * distances.mean():.3f} mm, max {1e3 * distances.max():.3f} mm")
    assert distances.max() < 0.5e-3


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
    second = go_on(rod)
    other = CosseratRod(properties, 30)
    other.restore(middle)
    third = go_on(other)
    for state in (second, third):
        for name in ("positions", "quaternions", "velocities", "angular_velocities", "stress"):
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"duration": 0.1, "dt": 0.0}, "dt: expected a positive"),
        ({"duration": -0.1, "dt": 0.01}, "duration: expected a positive"),
        ({"duration": 0.1, "dt": 0.01, "order": 3}, "order: expected 1 or 2, got 3"),
        ({"duration": 0.1, "dt": 0.01, "tolerance": 0.0}, "tolerance"),
    ],
)
def test_impossible_steps_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        swung(0, RodProperties(LENGTH)).advance(BOTH_STILL, **options)


def test_lost_motion_restores_the_state(monkeypatch):
    rod = swung(1, RodProperties(LENGTH))
    before = rod.state
    monkeypatch.setattr(rod, "_bounds", rod._bounds._replace(bend=1e-6))
    with pytest.raises(RodDiverged, match="lost .* s into an advance of 0.1 s") as caught:
        rod.advance(BOTH_STILL, 0.1, dt=0.05)
    np.testing.assert_array_equal(rod.state.positions, before.positions)
    np.testing.assert_array_equal(caught.value.last_good.positions, before.positions)
    assert rod.state.time == before.time
