"""The paper's cable around a metal bar, and a knot pulled tight: nothing passes through."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks import contact_scenes as scenes
from dlo_gym.exceptions import RodDiverged
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodState
from dlo_gym.rod import _kernels_distance as distances

WAYS: dict[str, Callable[[CosseratRod, BoundaryDisplacement], RodState]] = {
    "quasi-static": lambda rod, way: rod.move(way),
    "in motion": lambda rod, way: rod.advance(way, 0.1, dt=0.025),
}


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("way", WAYS)
def test_cable_led_once_around_a_bar_is_wrapped_and_stays_so(way, friction):
    rod = scenes.hung_over_bar(friction)
    before = scenes.winding(rod.state.positions)
    for displacement in scenes.once_around(rod):
        state = WAYS[way](rod, displacement)
    assert scenes.winding(state.positions) - before == pytest.approx(1.0, abs=0.01)
    rng = np.random.default_rng(0)
    step = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)
    for _ in range(20):
        vector = step * rng.uniform(-1.0, 1.0, 12)
        vector[[2, 8]] += 0.002  # towards the bar: slack
        state = WAYS[way](rod, BoundaryDisplacement.from_vector(vector))
        assert state.contact is not None
        assert state.contact.gaps.min() > -0.1 * scenes.CABLE.radius
    assert scenes.winding(state.positions) - before == pytest.approx(1.0, abs=0.1)


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


def check_knot(state: RodState, former: float) -> float:
    """Check that the strands lie apart and none has passed another; returns the writhe."""
    writhe = scenes.writhe(state.positions)
    assert abs(writhe - former) < 0.2
    assert least_distance(state.positions, 8) > 0.99 * 2.0 * scenes.STRING.radius
    return writhe


@pytest.mark.slow
def test_knot_is_pulled_tight_without_passing_through_itself():
    rod = scenes.loose_knot()
    writhe = check_knot(rod.state, scenes.writhe(rod.state.positions))
    for displacement in scenes.into_line(rod):
        writhe = check_knot(rod.move(displacement), writhe)
    pressed, tightest = [], 0.0
    while rod.state.boundary.distance < 0.8 * scenes.STRING.length:
        before = rod.state
        try:
            state = rod.move(scenes.pulled_apart(0.005))
        except RodDiverged as diverged:
            np.testing.assert_array_equal(diverged.last_good.positions, before.positions)
            np.testing.assert_array_equal(rod.state.positions, before.positions)
            break
        writhe = check_knot(state, writhe)
        tightest = state.boundary.distance / scenes.STRING.length
        assert state.contact is not None
        pressed.append(np.linalg.norm(state.contact.self_forces, axis=1).sum())
    print(f"pulled to {tightest:.3f} of the length, strands press with {pressed[-1]:.2f} N")
    assert tightest > 0.7
    assert pressed[-1] > 2.0 * pressed[0]
    assert writhe == pytest.approx(-3.1, abs=0.15)  # of a trefoil: three crossings
