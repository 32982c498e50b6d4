"""Friction as docs/validation.md shows it: Coulomb's threshold and the capstan."""

import numpy as np
import pytest

from benchmarks.validation import contact
from dlo_gym.rod.contact import SLIP


@pytest.mark.parametrize("friction", contact.INCLINE_FRICTIONS)
def test_rod_on_an_incline_slides_from_the_angle_of_friction_on(friction):
    slope = contact.sliding_slope(friction)
    assert np.tan(slope) == pytest.approx(friction, rel=3e-3)
    rod = contact.on_incline(friction)
    assert contact.slid(rod, 0.98 * slope) < SLIP
    assert contact.slid(rod, 1.05 * slope) > 1.0


@pytest.mark.parametrize("friction", [0.1, 0.3])
@pytest.mark.parametrize("degrees", [90, 180, 360, 540])
def test_tension_grows_around_a_bar_as_the_capstan_equation_says(degrees, friction):
    angle = np.deg2rad(degrees)
    result = contact.capstan(friction, angle)
    assert result.ratio == pytest.approx(np.exp(friction * angle), rel=0.03)
    assert result.exponent == pytest.approx(friction, rel=3e-3)
    assert result.deepest < 0.02
