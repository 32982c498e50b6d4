"""A cell of simulated arms as one device."""

import time

import numpy as np
import pytest

from dlo_gym.rod.boundary import BoundaryDisplacement
from sim2real.cell import SPACING
from sim2real.config import CellConfig
from tests.sim2real.simulated_cell import make_cell, opengl_missing, write_cell

if reason := opengl_missing():
    pytest.skip(reason, allow_module_level=True)


def test_a_command_that_comes_early_is_held_back(tmp_path):
    """Else a loop that was late would send two steps' motion within one period."""
    config = CellConfig.load(write_cell(tmp_path))
    period = config.control.period_s
    lift = np.array([0.0, 0.0, 0.001, 0.0, 0.0, 0.0])
    with make_cell(config, moves=False) as cell:
        cell.open()
        cell.engage()
        sent = []
        for _ in range(4):
            target = cell.commanded.displaced(BoundaryDisplacement(lift, lift))
            cell.send(target, 1.5 * period)
            sent.append(time.monotonic())
    assert np.diff(sent).min() >= 0.95 * SPACING * period
