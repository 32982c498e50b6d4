"""Motion as docs/validation.md shows it: frequencies, order in time, energy, MuJoCo."""

import numpy as np
import pytest

from benchmarks.validation import dynamics
from benchmarks.validation.case import order


@pytest.mark.parametrize(
    ("periods", "tolerance"),
    [
        (lambda: dynamics.bending_period(0), 2e-3),
        (lambda: dynamics.bending_period(1), 6e-3),
        (dynamics.twist_period, 1e-3),
        (dynamics.chain_period, 2e-3),
    ],
    ids=["bending 1", "bending 2", "twist", "chain"],
)
def test_small_vibrations_have_the_continuous_rods_periods(periods, tolerance):
    exact, ours = periods()
    assert ours == pytest.approx(exact, rel=tolerance)


@pytest.mark.parametrize("method", [1, 2])
def test_error_falls_with_the_order_in_time(method):
    counts = (40, 80, 160)
    assert order(counts, dynamics.errors_in_dt(counts, method)) > method - 0.3


def test_energy_is_kept_the_better_the_finer_the_step_and_never_gained():
    coarse, fine = dynamics.energies(0.01, 2, 0.5), dynamics.energies(0.0025, 2, 0.5)
    for energy in (coarse, fine):
        assert np.diff(energy).max() < 1e-9
    assert 1.0 - fine[-1] < 0.5 * (1.0 - coarse[-1])
    assert fine[-1] > 0.9


@pytest.mark.parametrize("thin", [False, True], ids=["PyElastica", "MuJoCo"])
def test_moves_as_the_peer_moves(thin):
    ours, theirs, at_rest = dynamics.trajectories(0, thin)
    distances = np.linalg.norm(ours - theirs, axis=2)
    inertia = np.linalg.norm(theirs - at_rest, axis=2).max()
    assert distances.max() < 1e-3
    assert distances.max() < 0.1 * inertia
