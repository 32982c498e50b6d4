"""A minute of what ``make soak`` does for half an hour."""

import numpy as np
import pytest

from benchmarks.soak_robot import soak
from tests.sim2real.emulated import write_cell

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def test_memory_stays_flat_and_nothing_needs_a_person(tmp_path):
    config = write_cell(tmp_path / "cell.toml")
    *_, result = soak(config, minutes=1.0)
    assert result.steps > 100
    assert max(result.arrived) < 1e-4
    assert {name: result.growth(name) for name in result.memory} == {
        name: pytest.approx(0.0, abs=0.05) for name in result.memory
    }
    assert np.isfinite(result.late).all()
