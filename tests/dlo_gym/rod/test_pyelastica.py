"""The rod against an independent engine: PyElastica, dynamic, settled."""

import numpy as np
import pytest

from benchmarks.pyelastica_peer import PyElasticaRod
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))]
)
def test_settles_where_pyelastica_settles(seed):
    rng = np.random.default_rng(seed)
    properties = RodProperties(0.5)
    rod = CosseratRod(properties)
    start = rod.settle(random_boundary(rng, 0.5))
    while True:
        size = np.tile([0.05] * 3 + [0.4] * 3, 2)
        displacement = BoundaryDisplacement.from_vector(size * rng.uniform(-1.0, 1.0, 12))
        if start.boundary.displaced(displacement).distance < 0.48:
            break
    end = rod.move(displacement)
    peer = PyElasticaRod(properties, start, displacement, duration=0.5)
    peer.advance(3.0)
    assert peer.speed < 1e-3  # settled
    assert np.linalg.norm(end.positions - start.positions, axis=1).max() > 0.02
    assert np.linalg.norm(peer.positions - end.positions, axis=1).max() < 0.5e-3
