"""Loads that change on a rod at rest."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    CosseratRod,
    Plane,
    RodProperties,
    contact_moves,
)
from dlo_gym.rod.initial_shapes import random_boundary

BOUNDARY = random_boundary(np.random.default_rng(0), 0.5)
FORCES = 5e-4 * (np.random.default_rng(1).normal(size=(21, 3)) + np.array([0.0, 1.0, 0.0]))


def shifted(by: float) -> BoundaryPoses:
    return BoundaryPoses(*[pose(np.eye(3), [0.0, by, 0.0]) @ clamp for clamp in BOUNDARY.clamps])


@pytest.mark.parametrize("shift", [-10.0, 10.0])
def test_new_loads_are_followed_wherever_the_origin_is(shift, monkeypatch):
    def descended(*_):
        raise AssertionError("the rod descended instead of following")

    ends = []
    for offset in (0.0, shift):
        rod = CosseratRod(
            RodProperties(0.5), 20, obstacles=[Plane.through([0.0, 0.0, -50.0], [0.0, 0.0, 1.0])]
        )
        rod.settle(shifted(offset))
        monkeypatch.setattr(contact_moves, "_snap", descended)
        rod.apply_forces(FORCES)
        ends.append(rod.move(BoundaryDisplacement.zero()).positions - [0.0, offset, 0.0])
        monkeypatch.undo()
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-8)


def test_the_state_at_once_counts_new_loads():
    rod = CosseratRod(RodProperties(0.5), 20)
    before = rod.settle(BOUNDARY)
    rod.apply_forces(FORCES)
    after = rod.state
    np.testing.assert_array_equal(after.positions, before.positions)
    expected = before.energy - float((FORCES * before.positions).sum())
    assert after.energy == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(
        after.wrench_left[:3], before.wrench_left[:3] - FORCES[0], atol=1e-12
    )
