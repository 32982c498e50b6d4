import os
import time
from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    CosseratRod,
    RodBatch,
    RodProperties,
)
from dlo_gym.rod.initial_shapes import random_boundary

STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)
PROPERTIES = [
    RodProperties(0.5),
    RodProperties(0.5, radius=0.002, youngs_modulus=1e7),
    RodProperties(0.5, yield_curvature=8.0, hardening=0.1),
    RodProperties(0.6, rest_curvature=(3.0, 0.0, 1.0), density=2e3),
    RodProperties(0.5, creep=0.3),
]
N_ELEMENTS = 20


def rods() -> list[CosseratRod]:
    return [CosseratRod(properties, N_ELEMENTS) for properties in PROPERTIES]


def boundaries() -> list[BoundaryPoses]:
    rng = np.random.default_rng(1)
    return [random_boundary(rng, 0.45) for _ in PROPERTIES]


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_every_rod_goes_where_it_goes_alone_to_the_last_bit(threads):
    batch, alone = RodBatch(rods(), threads=threads), rods()
    state = batch.settle(boundaries())
    singles = [rod.settle(b) for rod, b in zip(alone, boundaries(), strict=True)]
    rng = np.random.default_rng(2)
    for _ in range(15):
        for name in ("positions", "quaternions", "curvature", "strain", "energy"):
            expected = np.stack([getattr(single, name) for single in singles])
            np.testing.assert_array_equal(getattr(state, name), expected)
        wrenches = np.stack([[single.wrench_left, single.wrench_right] for single in singles])
        np.testing.assert_array_equal(state.wrenches, wrenches)
        assert not state.lost.any()
        twists = 2.0 * STEP * rng.uniform(-1.0, 1.0, (len(alone), 12))
        state = batch.move(twists)
        singles = [
            rod.move(BoundaryDisplacement.from_vector(twist))
            for rod, twist in zip(alone, twists, strict=True)
        ]


def test_a_lost_rod_stays_and_the_others_go_on(monkeypatch):
    batch = RodBatch(rods(), threads=2)
    before = batch.settle(boundaries())
    frail = batch.rods[2]
    monkeypatch.setattr(frail, "_bounds", frail._bounds._replace(bend=1e-9))
    twists = np.tile(STEP, (len(batch), 1))
    twists[4, :3] = [3.0, 0.0, 0.0]
    after = batch.move(twists)
    assert after.lost.tolist() == [False, False, True, False, True]
    assert isinstance(after.errors[2], RodDiverged)
    assert isinstance(after.errors[4], ValueError)
    assert "overstretched" in str(after.errors[4])
    moved = np.abs(after.positions - before.positions).max(axis=(1, 2)) > 1e-3
    assert moved.tolist() == [True, True, False, True, False]
    np.testing.assert_array_equal(after.energy[[2, 4]], before.energy[[2, 4]])
    monkeypatch.undo()
    # What follows is what follows without the failure, to the last bit.
    alone = rods()[2]
    alone.settle(boundaries()[2])
    twists[4] = STEP
    np.testing.assert_array_equal(
        batch.move(twists).positions[2],
        alone.move(BoundaryDisplacement.from_vector(twists[2])).positions,
    )


def test_a_rod_that_never_settled_is_nan():
    batch = RodBatch(rods(), threads=1)
    wanted = boundaries()
    far = wanted[1].clamps[1].copy()
    far[0, 3] += 2.0
    wanted[1] = replace(wanted[1], right=far)
    state = batch.settle(wanted)
    assert state.lost.tolist() == [False, True, False, False, False]
    assert np.isnan(state.positions[1]).all()
    assert np.isfinite(state.positions[[0, 2, 3, 4]]).all()
    again = batch.move(np.zeros((5, 12)))
    assert "call settle" in str(again.errors[1])


def test_shapes_are_the_same_where_no_rod_ever_settled():
    batch = RodBatch(rods(), threads=1)
    nowhere, settled = batch.state, batch.settle(boundaries())
    assert nowhere.lost.all()
    for name in ("positions", "quaternions", "curvature", "strain", "wrenches", "energy"):
        assert getattr(nowhere, name).shape == getattr(settled, name).shape
        assert np.isnan(getattr(nowhere, name)).all()


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="rods: expected distinct"):
        RodBatch([])
    with pytest.raises(ValueError, match=r"one number of elements, got \[20, 30\]"):
        RodBatch([CosseratRod(PROPERTIES[0], 20), CosseratRod(PROPERTIES[0], 30)])
    with pytest.raises(ValueError, match="threads: expected at least 1, got 0"):
        RodBatch(rods(), threads=0)
    batch = RodBatch(rods())
    with pytest.raises(ValueError, match="one per rod, 5, got 4"):
        batch.move(np.zeros((4, 12)))
    with pytest.raises(ValueError, match="expected 6 or 12 numbers"):
        batch.move(np.zeros((5, 7)))


def test_a_thread_per_core_that_the_process_may_use(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4,2")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 2, 5}, raising=False)
    assert RodBatch(rods()).threads == 3
    assert RodBatch(rods(), threads=2).threads == 2


def test_no_rod_moves_any_more_when_one_ends_the_batch(monkeypatch):
    batch, moving = RodBatch(rods(), threads=2), []
    batch.settle(boundaries())

    def move(rod, _):
        if rod is batch.rods[0]:
            raise MemoryError
        moving.append(rod)
        time.sleep(0.3)
        moving.remove(rod)

    monkeypatch.setattr(CosseratRod, "move", move)
    with pytest.raises(MemoryError):
        batch.move(np.zeros((len(batch), 12)))
    assert not moving
