"""Settling over the whole range of rods, slender ones and flat energies included."""

import numpy as np
import pytest

from benchmarks.validation import buckling
from dlo_gym.exceptions import RodDiverged
from dlo_gym.rod import BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary


def random_rod(seed: int) -> tuple[CosseratRod, BoundaryPoses]:
    """10 to 400 elements, 0.2 to 2 m, 1 to 6 mm thick, 0.1 MPa to 1 GPa, and clamps for it."""
    rng = np.random.default_rng(seed)
    while True:
        length = np.exp(rng.uniform(np.log(0.2), np.log(2.0)))
        n = int(np.exp(rng.uniform(np.log(10), np.log(400.99))))
        radius, modulus = rng.uniform(0.001, 0.006), 10.0 ** rng.uniform(5.0, 9.0)
        if radius <= length / n:
            rod = CosseratRod(RodProperties(length, radius, modulus), n)
            return rod, random_boundary(rng, length)


@pytest.mark.slow
def test_one_in_a_hundred_rods_at_most_is_not_settled():
    lost = {}
    for seed in range(400):
        rod, boundary = random_rod(seed)
        try:
            state = rod.settle(boundary)
        except RodDiverged as error:
            lost[seed] = str(error)
            continue
        weight = 9.81 * rod.properties.linear_density * rod.properties.length
        carried = state.wrench_left[2] + state.wrench_right[2]
        assert carried == pytest.approx(weight, rel=1e-4, abs=1e-7)
    print(f"{len(lost)} of 400 not settled: {lost}")
    assert len(lost) <= 4


@pytest.mark.parametrize("seed", range(8))
def test_a_wire_of_a_ten_thousandth_of_its_length_settles(seed):
    rod = CosseratRod(RodProperties(0.5, radius=5e-5, youngs_modulus=1e11), 100)
    state = rod.settle(random_boundary(np.random.default_rng(seed), 0.5))
    weight = 9.81 * rod.properties.linear_density * 0.5
    assert state.wrench_left[2] + state.wrench_right[2] == pytest.approx(weight, rel=1e-5)
    assert np.abs(state.strain).max() < 1e-4


def test_straight_weightless_rod_is_twisted_into_a_helix_that_may_slide_along_it():
    """Where the helix stands along the rod hardly matters: the energy is flat to rounding."""
    tension = buckling.HELIX, buckling.HELIX_SHORTENING, buckling.HELIX_TWIST
    assert buckling.buckled_helix(*tension, 150).tension == pytest.approx(0.20113, abs=2e-5)
