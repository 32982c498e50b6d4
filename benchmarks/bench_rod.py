"""A 5 mm and 2.25 degree move of both ends at the paper's reference rod, beside PyElastica.

PyElastica's time is for the same motion taken in 0.1 s, dynamic, at its own time step of 1e-4 s.
"""

import time

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.pyelastica_peer import PyElasticaRod
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary

STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)


def random_moves(rod: CosseratRod, rng: np.random.Generator, count: int):
    """Yields (state before, displacement, seconds) of moves, from a new shape every 25."""
    done = 0
    while done < count:
        if done % 25 == 0:
            rod.settle(random_boundary(rng, rod.properties.length))
        displacement = BoundaryDisplacement.from_vector(STEP * rng.choice([-1.0, 1.0], 12))
        before = rod.state
        began = time.perf_counter()
        try:
            rod.move(displacement)
        except ValueError:  # overstretched: choose another
            continue
        yield before, displacement, time.perf_counter() - began
        done += 1


def main() -> None:
    rng = np.random.default_rng(0)
    properties = RodProperties(length=0.5, radius=0.003, youngs_modulus=1e6, density=1e3)
    rod = CosseratRod(properties, n_elements=50)
    list(random_moves(rod, rng, 10))
    moves = list(random_moves(rod, rng, 1000))
    ours = 1e3 * np.array([seconds for *_, seconds in moves])
    settles = []
    for _ in range(100):
        boundary = random_boundary(rng, 0.5)
        began = time.perf_counter()
        rod.settle(boundary)
        settles.append(1e3 * (time.perf_counter() - began))
    peers = []
    for before, displacement, _ in moves[:6]:
        peer = PyElasticaRod(properties, before, displacement, duration=0.1)
        began = time.perf_counter()
        peer.advance(0.1)
        peers.append(1e3 * (time.perf_counter() - began))
    peer_time = float(np.median(peers[1:]))  # the first compiles

    table = Table("rod, 50 elements, one core", "median ms", "p99 ms", "PyElastica / ours")
    table.add_row(
        "move 5 mm, 2.25 deg, both ends",
        f"{np.median(ours):.3f}",
        f"{np.percentile(ours, 99):.3f}",
        f"{peer_time / np.median(ours):.0f}x",
    )
    table.add_row("settle from afar", f"{np.median(settles):.2f}", f"{max(settles):.2f}", "")
    table.add_row("PyElastica 1.0.0, same move", f"{peer_time:.1f}", "", "1x")
    Console().print(table)


if __name__ == "__main__":
    main()
