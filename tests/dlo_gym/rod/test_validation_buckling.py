"""Loss of stability against closed forms, as docs/validation.md shows it."""

import numpy as np
import pytest

from benchmarks.validation import buckling
from benchmarks.validation.case import order
from dlo_gym.rod import RodProperties

THICK, THIN = RodProperties(0.5), RodProperties(0.5, radius=0.0005)


@pytest.mark.parametrize(("free_end", "tolerance"), [(False, 3e-3), (True, 2e-4)])
def test_straight_rod_buckles_at_eulers_load(free_end, tolerance):
    expected = buckling.euler_load(THICK, 2.0 if free_end else 0.5)
    counts = (10, 20, 40)
    loads = np.array([buckling.buckling_load(THICK, n, free_end=free_end) for n in counts])
    assert loads[-1] == pytest.approx(expected, rel=tolerance)
    assert 1.95 < order(counts, np.abs(loads - expected)) < 2.05


def test_stretch_and_shear_shift_the_load_as_the_reference_says():
    # Soft in shear and stretch, so that leaving either out would not pass.
    euler = buckling.euler_load(THIN, 0.5)
    soft = RodProperties(0.5, radius=0.0005, kGA=10.0 * euler, EA=30.0 * euler)
    expected = buckling.euler_load(soft, 0.5)
    assert expected < 0.95 * euler
    counts = np.array([20, 40])
    coarse, fine = (buckling.buckling_load(soft, n, free_end=False) for n in counts)
    assert (4.0 * fine - coarse) / 3.0 == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("shortening", [0.01, 0.1, 0.5])
def test_buckled_rod_is_the_clamped_elastica(shortening):
    exact = buckling.post_buckled_elastica(shortening)
    ours = buckling.post_buckled_rod(THIN, shortening)
    assert ours.load == pytest.approx(exact.load, rel=1e-3)
    assert ours.deflection == pytest.approx(exact.deflection, rel=1e-3)


def test_ring_leaves_its_plane_at_michells_twist():
    expected = buckling.michell_twist(THIN)
    counts = (20, 40, 80)
    twists = np.array([buckling.critical_ring_twist(THIN, n) for n in counts])
    assert twists[-1] == pytest.approx(expected, rel=5e-4)
    assert 1.9 < order(counts, np.abs(twists - expected)) < 2.15


def test_moved_ring_loses_two_turns_at_michells_twist():
    expected = buckling.michell_twist(THICK)
    fractions = np.array([0.5, 0.97, 1.03])
    left = buckling.ring_path(THICK, 40, fractions * expected)
    np.testing.assert_allclose(left[:2], fractions[:2] * expected, rtol=5e-3)
    assert fractions[2] * expected - left[2] == pytest.approx(4.0 * np.pi, rel=1e-2)


@pytest.mark.parametrize(
    ("n", "tension", "envelope"),
    [(100, 2e-2, 1e-2), pytest.param(400, 3e-3, 2e-3, marks=pytest.mark.slow)],
)
def test_long_twisted_rod_buckles_into_the_localised_helix(n, tension, envelope):
    exact, ours = buckling.helix_pair(n)
    assert ours.tension == pytest.approx(exact.tension, rel=tension)
    assert ours.torque == pytest.approx(exact.torque, rel=2e-4)
    assert ours.largest_angle == pytest.approx(exact.largest_angle, rel=1e-2)
    np.testing.assert_allclose(ours.envelope, exact.envelope, atol=envelope)
