"""Derivatives carried along ``advance`` against finite differences of ``advance`` itself."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    CosseratRod,
    MotionSensitivity,
    Plane,
    RodProperties,
    RodState,
)
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.sensitivity import DISPLACEMENT, MOTION_PARAMETERS
from tests.dlo_gym.rod.changed_properties import changed

N = 12
PROPERTIES = RodProperties(
    0.5,
    youngs_modulus=3e6,
    rest_curvature=(0.5, -0.3, 0.2),
    external_damping=2.0,
    internal_damping=0.01,
)

STEPS = {"length": 1e-5, "internal_damping": 1e-6, "external_damping": 1e-3}  # else 1e-4


def clamps(held: str, seed: int = 6) -> BoundaryPoses:
    boundary = random_boundary(np.random.default_rng(seed), 0.5)
    return boundary if held == "both" else BoundaryPoses(boundary.left)


def fast_moves(held: str) -> list[BoundaryDisplacement]:
    """Two of about 3 cm and 0.3 rad, and rest."""
    size = np.tile([0.02] * 3 + [0.2] * 3, 2 if held == "both" else 1)
    rng = np.random.default_rng(1)
    vectors = [size * rng.normal(size=len(size)) for _ in range(2)] + [np.zeros(len(size))]
    return [BoundaryDisplacement.from_vector(vector) for vector in vectors]


def check(sensitivity: MotionSensitivity, column: int, ends: list[RodState], h: float, tolerance):
    """Against central differences of positions, velocities and spins."""
    for name in ("positions", "velocities", "angular_velocities"):
        difference = (getattr(ends[0], name) - getattr(ends[1], name)) / (2.0 * h)
        largest = np.abs(difference).max()
        assert largest > 1e-6
        np.testing.assert_allclose(
            getattr(sensitivity, name)[..., column], difference, atol=tolerance * largest,
            err_msg=f"{name} by {sensitivity.columns[column]}",
        )  # fmt: skip


@pytest.mark.parametrize("held", ["both", "left"])
@pytest.mark.parametrize("order", [1, 2])
def test_parameters_and_displacements_along_fast_moves(order, held):
    boundary, moves = clamps(held), fast_moves(held)
    start = CosseratRod(PROPERTIES, N).settle(boundary).positions

    def settled(properties: RodProperties) -> CosseratRod:
        rod = CosseratRod(properties, N)
        rod.settle(boundary, start=start)
        rod.move(moves[-1])  # nowhere: Newton's method once more
        return rod

    def moved(rod: CosseratRod, first: BoundaryDisplacement = moves[0]) -> RodState:
        rod.advance(first, 0.1, order=order)
        rod.advance(moves[1], 0.07, order=order)
        return rod.advance(moves[2], 0.1, order=order)

    rod = settled(PROPERTIES)
    settled_state, sensitivity = rod.state, rod.motion_sensitivity()
    _, sensitivity = rod.advance_with_sensitivity(
        sensitivity, moves[0], 0.1, order=order, by_displacement=True
    )
    _, sensitivity = rod.advance_with_sensitivity(sensitivity, moves[1], 0.07, order=order)
    state, sensitivity = rod.advance_with_sensitivity(sensitivity, moves[2], 0.1, order=order)
    rod.restore(settled_state)
    plain = moved(rod)
    np.testing.assert_allclose(state.positions, plain.positions, atol=1e-12)
    np.testing.assert_allclose(state.velocities, plain.velocities, atol=1e-10)

    size = len(moves[0].vector)
    assert sensitivity.columns == (*MOTION_PARAMETERS, *DISPLACEMENT[:size])
    for column, name in enumerate(MOTION_PARAMETERS):
        h = STEPS.get(name, 1e-4)
        ends = [moved(settled(changed(PROPERTIES, name, sign * h))) for sign in (1.0, -1.0)]
        check(sensitivity, column, ends, h, 1e-6)
    for k in range(size):
        h, unit = 2e-6, np.eye(size)[k]
        ends = []
        for sign in (1.0, -1.0):
            vector = moves[0].vector + sign * h * unit
            ends.append(moved(settled(PROPERTIES), BoundaryDisplacement.from_vector(vector)))
        check(sensitivity, len(MOTION_PARAMETERS) + k, ends, h, 1e-6)


@pytest.mark.parametrize("held", ["both", "left"])
def test_parameters_where_energy_is_taken_back(held):
    """An undamped swing between clamps at rest, in which TR-BDF2 gains energy now and then."""
    properties = RodProperties(0.5, youngs_modulus=1e6, rest_curvature=(0.3, -0.2, 0.1))
    boundary = clamps(held, seed=0)
    vector = np.zeros(12 if held == "both" else 6)
    vector[:6] = [0.0, 0.1, 0.02, 0.5, 1.0, 0.0]
    move, rest = (BoundaryDisplacement.from_vector(scale * vector) for scale in (1.0, 0.0))
    start = CosseratRod(properties, 6).settle(boundary).positions

    def swung(p: RodProperties) -> RodState:
        rod = CosseratRod(p, 6)
        rod.settle(boundary, start=start)
        rod.move(rest)
        rod.advance(move, 0.1)
        return rod.advance(rest, 0.5)

    rod = CosseratRod(properties, 6)
    rod.settle(boundary, start=start)
    sensitivity = rod.motion_sensitivity(("log_EI", "log_weight", "length"))
    _, sensitivity = rod.advance_with_sensitivity(sensitivity, move, 0.1)
    _, sensitivity = rod.advance_with_sensitivity(sensitivity, rest, 0.5)
    for column, name in enumerate(sensitivity.columns):
        h = 1e-6 if name == "length" else 1e-5
        ends = [swung(changed(properties, name, sign * h)) for sign in (1.0, -1.0)]
        check(sensitivity, column, ends, h, 1e-6)


def test_from_a_given_state_and_by_its_own_change():
    """Parameters that leave the initial state alone, and a column that changes its velocities."""
    boundary, moves = clamps("left"), fast_moves("left")
    rod = CosseratRod(PROPERTIES, N)
    rod.settle(boundary)
    given = rod.advance(moves[0], 0.1)
    rng = np.random.default_rng(2)
    push, spin = rng.normal(size=(N + 1, 3)), rng.normal(size=(N, 3))
    push[0] = 0.0  # the clamp's
    sensitivity = rod.motion_sensitivity(("log_EI", "internal_damping"), equilibrium=False)
    assert not sensitivity.positions.any()
    zero = MotionSensitivity.zero(("push",), N)
    zero.velocities[:, :, 0], zero.angular_velocities[:, :, 0] = push, spin
    fields = ("positions", "turns", "velocities", "angular_velocities", "clamps")
    together = [
        np.concatenate([getattr(part, name) for part in (sensitivity, zero)], axis=-1)
        for name in fields
    ]
    sensitivity = MotionSensitivity((*sensitivity.columns, "push"), *together)
    _, sensitivity = rod.advance_with_sensitivity(sensitivity, moves[1], 0.1)

    def advanced(p: RodProperties, pushed: float) -> RodState:
        other = CosseratRod(p, N)
        other.restore(
            replace(
                given,
                velocities=given.velocities + pushed * push,
                angular_velocities=given.angular_velocities + pushed * spin,
            )
        )
        return other.advance(moves[1], 0.1)

    for column, name in enumerate(sensitivity.columns[:2]):
        h = STEPS.get(name, 1e-4)
        ends = [advanced(changed(PROPERTIES, name, sign * h), 0.0) for sign in (1.0, -1.0)]
        check(sensitivity, column, ends, h, 1e-6)
    ends = [advanced(PROPERTIES, sign * 1e-6) for sign in (1.0, -1.0)]
    check(sensitivity, 2, ends, 1e-6, 1e-6)


def test_internal_damping_of_a_rod_that_has_none_yet():
    boundary, moves = clamps("both"), fast_moves("both")
    undamped = replace(PROPERTIES, internal_damping=0.0)
    rod = CosseratRod(undamped, N)
    start = rod.settle(boundary)
    _, sensitivity = rod.advance_with_sensitivity(rod.motion_sensitivity(), moves[0], 0.1)

    def moved(eta: float):
        other = CosseratRod(replace(undamped, internal_damping=eta), N)
        other.restore(start)
        return other.advance(moves[0], 0.1).positions

    h = 1e-7
    difference = (-3.0 * moved(0.0) + 4.0 * moved(h) - moved(2.0 * h)) / (2.0 * h)
    np.testing.assert_allclose(
        sensitivity.of("internal_damping"), difference, atol=1e-4 * np.abs(difference).max()
    )


def test_gauss_newton_finds_the_parameters_of_a_motion():
    """From 20 to 60 % off, over a clip that starts at rest; quadratically, as exact ones do."""
    boundary = clamps("both")
    names = ("log_EI", "log_GJ", "external_damping", "internal_damping")

    def path(t: float):
        sway, swing = np.sin(4.4 * t), 1.0 - np.cos(5.6 * t)
        left = np.array([1.0, 1.0, 0.0, 0.0, 8.0, 0.0]) * sway
        return 0.04 * np.concatenate([left, np.array([-1.0, 0.5, 1.0, 0.0, 0.0, 6.0]) * swing])

    times = 0.05 * np.arange(21)
    moves = [
        BoundaryDisplacement.from_vector(path(end) - path(start)) for start, end in pairwise(times)
    ]

    def clip(guess):
        rod = CosseratRod(
            RodProperties(
                0.5, EI=2e-4 * np.exp(guess[0]), GJ=1.5e-4 * np.exp(guess[1]),
                external_damping=guess[2], internal_damping=guess[3],
            ),
            N,
        )  # fmt: skip
        rod.settle(boundary)
        sensitivity, seen, slopes = rod.motion_sensitivity(names), [], []
        for move in moves:
            state, sensitivity = rod.advance_with_sensitivity(sensitivity, move, 0.05)
            seen.append(state.positions)
            slopes.append(sensitivity.positions)
        return np.ravel(seen), np.reshape(slopes, (-1, len(names)))

    true, guess = np.array([0.0, 0.0, 1.0, 0.005]), np.array([0.2, -0.3, 0.4, 0.003])
    measured, _ = clip(true)
    for _ in range(6):
        positions, slopes = clip(guess)
        guess = guess - np.linalg.lstsq(slopes, positions - measured, rcond=None)[0]
    np.testing.assert_allclose(guess, true, atol=1e-8)


@pytest.mark.parametrize(
    "rod",
    [
        CosseratRod(replace(PROPERTIES, yield_curvature=3.0), N),
        CosseratRod(replace(PROPERTIES, creep=0.2), N),
        CosseratRod(PROPERTIES, N, obstacles=[Plane.through((0.0, 0.0, -3.0), (0.0, 0.0, 1.0))]),
    ],
    ids=["yields", "creeps", "touches"],
)
def test_what_is_not_smooth_is_refused(rod):
    rod.settle(clamps("both"))
    with pytest.raises(ValueError, match="neither yields nor creeps"):
        rod.motion_sensitivity()
    zero = MotionSensitivity.zero(("log_EI",), N)
    with pytest.raises(ValueError, match="neither yields nor creeps"):
        rod.advance_with_sensitivity(zero, BoundaryDisplacement.zero(), 0.1)


def test_bad_arguments_are_named():
    rod = CosseratRod(PROPERTIES, N)
    with pytest.raises(ValueError, match="settle"):
        rod.motion_sensitivity()
    rod.settle(clamps("both"))
    with pytest.raises(ValueError, match="parameters: expected distinct ones of .* got .*log_EA"):
        rod.motion_sensitivity(("log_EA",))
    with pytest.raises(ValueError, match="sensitivity: expected that of 12 elements, got 5"):
        rod.advance_with_sensitivity(
            MotionSensitivity.zero((), 5), BoundaryDisplacement.zero(), 0.1
        )
    with pytest.raises(ValueError, match="duration"):
        rod.advance_with_sensitivity(
            rod.motion_sensitivity(), BoundaryDisplacement.zero(), 0.0, by_displacement=True
        )
    with pytest.raises(ValueError, match="clamps: expected"):
        replace(MotionSensitivity.zero(("log_EI",), N), clamps=np.zeros((6, 1)))
    with pytest.raises(ValueError, match="column: expected one of"):
        rod.motion_sensitivity().of("density")
    with pytest.raises(ValueError, match="by_clamps: expected False"):
        rod.motion_sensitivity(equilibrium=False, by_clamps=True)
    rod.advance(fast_moves("both")[0], 0.1)
    with pytest.raises(ValueError, match="equilibrium: expected False"):
        rod.motion_sensitivity()
    for formula in (rod.sensitivity, rod.parameter_sensitivity):
        with pytest.raises(ValueError, match=f"{formula.__name__}: expected a rod at rest"):
            formula()
    rod.move(BoundaryDisplacement.zero())
    assert np.isfinite(rod.sensitivity()).all()


def test_of_two_columns_of_one_name_none_is_taken():
    rod, moves = CosseratRod(PROPERTIES, N), fast_moves("left")
    rod.settle(clamps("left"))
    sensitivity = rod.motion_sensitivity(("log_EI",))
    for move in moves[:2]:
        _, sensitivity = rod.advance_with_sensitivity(sensitivity, move, 0.1, by_displacement=True)
    with pytest.raises(ValueError, match=r"once, got 'left_dx'.*one of \[1, 7\]"):
        sensitivity.of("left_dx")
    np.testing.assert_array_equal(sensitivity.of("log_EI"), sensitivity.positions[:, :, 0])
