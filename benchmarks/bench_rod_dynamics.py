"""One 5 cm action at 0.2 m/s in motion: time and error of this rod, of PyElastica and of MuJoCo.

Errors are node distances at the action's end to a fine solution (160 elements, 1 ms) that starts
from its own equilibrium between the same clamps, so that they hold the error in space, of the
clamps' model, and in time. PyElastica runs 50 elements with boundary conditions in numba,
MuJoCo's flex rod 50 with its end edges held by mocap bodies.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.bench_rod import bytes_of
from benchmarks.mujoco_flex_peer import MujocoFlexRod
from benchmarks.pyelastica_peer import PyElasticaRod
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary

DURATION = 0.25
PROPERTIES = RodProperties(length=0.5, radius=0.003, youngs_modulus=1e6, external_damping=5.0)
ACTIONS = 6


class Action(NamedTuple):
    """Where the clamps start and what they do."""

    boundary: BoundaryPoses
    displacement: BoundaryDisplacement


def random_action(rng: np.random.Generator) -> Action:
    """Both ends move 5 cm in any direction, turning by up to 0.2 rad."""
    while True:
        boundary = random_boundary(rng, PROPERTIES.length)
        moves = rng.normal(size=(2, 3))
        moves *= 0.05 / np.linalg.norm(moves, axis=1, keepdims=True)
        vector = np.concatenate([np.hstack([move, rng.uniform(-0.2, 0.2, 3)]) for move in moves])
        action = Action(boundary, BoundaryDisplacement.from_vector(vector))
        if boundary.displaced(action.displacement).distance < 0.95 * PROPERTIES.length:
            return action


def at_nodes(positions: Array) -> Array:
    """Positions at 51 equally spaced places along the rod."""
    s = np.linspace(0.0, 1.0, len(positions))
    wanted = np.linspace(0.0, 1.0, 51)
    return np.column_stack([np.interp(wanted, s, column) for column in positions.T])


def timed_advance(rod: CosseratRod, action: Action, dt: float) -> tuple[Array, float]:
    start = rod.settle(action.boundary)
    seconds = []
    state = start
    for _ in range(5):
        rod.restore(start)
        began = time.perf_counter()
        state = rod.advance(action.displacement, DURATION, dt=dt)
        seconds.append(time.perf_counter() - began)
    return at_nodes(state.positions), float(np.median(seconds))


def timed_peer(action: Action) -> tuple[Array, float]:
    start = CosseratRod(PROPERTIES).settle(action.boundary)
    peer = PyElasticaRod(PROPERTIES, start, action.displacement, duration=DURATION, damping=5.0)
    began = time.perf_counter()
    peer.advance(DURATION)
    return peer.positions, time.perf_counter() - began


def timed_flex(action: Action, time_step: float) -> tuple[Array, float]:
    start = CosseratRod(PROPERTIES).settle(action.boundary)
    peer = MujocoFlexRod(
        PROPERTIES, start, action.displacement, duration=DURATION, time_step=time_step
    )
    began = time.perf_counter()
    peer.advance(DURATION)
    return peer.positions, time.perf_counter() - began


def main() -> None:
    rng = np.random.default_rng(0)
    actions = [random_action(rng) for _ in range(ACTIONS + 1)]
    fine = CosseratRod(PROPERTIES, 160, clamp="node")
    runs: dict[str, list[tuple[Array, float]]] = {}
    exact = []
    for action in actions:
        fine.settle(action.boundary)
        exact.append(at_nodes(fine.advance(action.displacement, DURATION, dt=1e-3).positions))
        runs.setdefault("PyElastica 1.0.0, n 50, 0.1 ms", []).append(timed_peer(action))
        for dt in (0.005, 0.01, 0.02, 0.03125):
            name = f"MuJoCo flex, n 50, {1e3 * dt:g} ms"
            runs.setdefault(name, []).append(timed_flex(action, dt))
        for n in (16, 25, 50):
            rod = CosseratRod(PROPERTIES, n, clamp="node")
            for dt in (0.005, 0.0125, 0.025, 0.0625, 0.25):
                name = f"advance, n {n}, {1e3 * dt:g} ms"
                runs.setdefault(name, []).append(timed_advance(rod, action, dt))
    table = Table("5 cm in 0.25 s", "ms", "mean error mm", "max error mm", "PyElastica / ours")
    peer_time = 0.0
    for name, results in runs.items():
        errors = [
            np.linalg.norm(positions - truth, axis=1)
            for (positions, _), truth in zip(results[1:], exact[1:], strict=True)
        ]
        seconds = float(np.median([seconds for _, seconds in results[1:]]))  # the first compiles
        peer_time = peer_time or seconds
        table.add_row(
            name,
            f"{1e3 * seconds:.2f}",
            f"{1e3 * np.mean(errors):.3f}",
            f"{1e3 * np.max(errors):.2f}",
            f"{peer_time / seconds:.0f}x",
        )
    Console().print(table)
    thin = replace(PROPERTIES, radius=0.001, youngs_modulus=1e8)
    growth = Table("elements", "ms per 25 ms step", "kB per rod")
    for n in (25, 50, 100, 200, 400):
        rod = CosseratRod(thin, n, clamp="node")
        _, seconds = timed_advance(rod, actions[0], 0.025)
        growth.add_row(str(n), f"{1e2 * seconds:.3f}", f"{bytes_of(rod) / 1e3:.0f}")
    Console().print(growth)


if __name__ == "__main__":
    main()
