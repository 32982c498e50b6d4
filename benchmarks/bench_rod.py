"""A 5 mm and 2.25 degree move of both ends at the paper's reference rod, beside PyElastica.

PyElastica's time is for the same motion taken in 0.1 s, dynamic, at its own time step of 1e-4 s.
Then what it costs to have many rods, long ones, and the first one after installation.
"""

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.pyelastica_peer import PyElasticaRod
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodBatch, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary

STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)
PROPERTIES = RodProperties(length=0.5, radius=0.003, youngs_modulus=1e6, density=1e3)
FIRST_CALL = """
import time
began = time.perf_counter()
import numpy as np
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary
rod = CosseratRod(RodProperties(0.5))
rod.settle(random_boundary(np.random.default_rng(0), 0.5))
rod.move(BoundaryDisplacement.zero())
print(time.perf_counter() - began)
rod.advance(BoundaryDisplacement.zero(), 0.05)
print(time.perf_counter() - began)
"""


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


def batch_rate(n_rods: int, threads: int) -> float:
    """Moves per second of a batch; between random clamps that are drawn anew every ten moves."""
    rng = np.random.default_rng(1)
    batch = RodBatch([CosseratRod(PROPERTIES) for _ in range(n_rods)], threads=threads)
    rates = []
    for _ in range(max(3, 64 // n_rods)):
        batch.settle([random_boundary(rng, 0.5) for _ in range(n_rods)])
        for _ in range(10):
            displacements = STEP * rng.choice([-1.0, 1.0], (n_rods, 12))
            began = time.perf_counter()
            state = batch.move(displacements)
            seconds = time.perf_counter() - began
            rates.append((n_rods - state.lost.sum()) / seconds)
    return float(np.median(rates))


def bytes_of(rod: CosseratRod) -> int:
    """Of the rod's arrays."""
    found: dict[int, int] = {}

    def count(value: object) -> None:
        if isinstance(value, np.ndarray):
            found[id(value)] = value.nbytes
        elif isinstance(value, tuple):
            for item in value:
                count(item)

    for value in vars(rod).values():
        count(value)
    return sum(found.values())


def resident(n_rods: int) -> float:
    """Bytes that each of ``n_rods`` rods adds to the process."""
    state = CosseratRod(PROPERTIES).settle(random_boundary(np.random.default_rng(0), 0.5))

    def resident_set() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    before = resident_set()
    rods = [CosseratRod(PROPERTIES) for _ in range(n_rods)]
    for rod in rods:
        rod.restore(state)
    return (resident_set() - before) / n_rods


def first_calls() -> list[list[float]]:
    """Seconds from the start of Python to the end of the first settle and move, and to the end of
    the first advance: without compiled kernels, and with them."""
    with tempfile.TemporaryDirectory() as cache:
        run = [
            subprocess.run(
                [sys.executable, "-c", FIRST_CALL],
                env=os.environ | {"NUMBA_CACHE_DIR": cache},
                check=True,
                capture_output=True,
                text=True,
            ).stdout
            for _ in range(2)
        ]
    return [[float(line) for line in output.split()] for output in run]


def main() -> None:
    rng = np.random.default_rng(0)
    rod = CosseratRod(PROPERTIES, n_elements=50)
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
        peer = PyElasticaRod(PROPERTIES, before, displacement, duration=0.1)
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

    rates = Table("moves per second, 50 elements", "1 thread", "2 threads")
    for n_rods in (1, 8, 64):
        both = [f"{batch_rate(n_rods, threads):.0f}" for threads in (1, 2)]
        rates.add_row(f"{n_rods} rods", *both)
    Console().print(rates)

    sizes = Table("elements", "ms per move", "us per element", "kB of arrays")
    thin = replace(PROPERTIES, radius=0.001, youngs_modulus=1e8)
    for n in (25, 50, 100, 200, 400):
        rod = CosseratRod(thin, n)
        list(random_moves(rod, rng, 10))
        median = float(np.median([seconds for *_, seconds in random_moves(rod, rng, 100)]))
        sizes.add_row(
            str(n), f"{1e3 * median:.3f}", f"{1e6 * median / n:.2f}", f"{bytes_of(rod) / 1e3:.0f}"
        )
    Console().print(sizes)
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:  # this one has memory to reuse
        added = fresh.submit(resident, 1000).result()
    Console().print(f"{added / 1e3:.0f} kB more in a process per rod of 50 elements")

    starts = Table("seconds from the start of Python", "to compile", "compiled")
    for name, cold, cached in zip(("settle, move", "then advance"), *first_calls(), strict=True):
        starts.add_row(name, f"{cold:.1f}", f"{cached:.2f}")
    Console().print(starts)


if __name__ == "__main__":
    main()
