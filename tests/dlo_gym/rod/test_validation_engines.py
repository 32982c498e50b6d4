"""The rod against independent engines, PyElastica and MuJoCo: dynamic, settled."""

import numpy as np
import pytest

from benchmarks.mujoco_flex_peer import MujocoFlexRod
from benchmarks.pyelastica_peer import PyElasticaRod
from benchmarks.validation.engines import PAPER, THIN, random_motion, settle_peer

SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))]


@pytest.mark.parametrize("seed", SEEDS)
def test_settles_where_pyelastica_settles(seed):
    motion = random_motion(seed)
    peer = settle_peer(PyElasticaRod, PAPER, motion)
    assert peer.speed < 1e-3  # settled
    moved = np.linalg.norm(motion.end.positions - motion.start.positions, axis=1)
    assert moved.max() > 0.02
    assert peer.distances(motion).max() < 0.5e-3


@pytest.mark.parametrize("seed", SEEDS)
def test_settles_where_mujoco_settles(seed):
    # An inextensible rod in both; what is left is their measures of bending, of second order in n.
    largest = []
    for n in (50, 100):
        motion = random_motion(seed, THIN, n)
        peer = settle_peer(MujocoFlexRod, THIN, motion)
        assert peer.speed < 1e-3
        largest.append(peer.distances(motion).max())
    assert largest[1] < 1e-3
    assert largest[1] < 0.5 * largest[0]


def test_mujoco_rod_starts_in_the_given_shape():
    motion = random_motion(0)
    peer = MujocoFlexRod(PAPER, motion.start, motion.displacement, duration=0.5)
    distances = np.linalg.norm(peer.positions - motion.start.positions, axis=1)
    assert distances.max() < 2e-4  # the held end edges do not stretch
