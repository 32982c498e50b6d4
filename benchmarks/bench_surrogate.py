"""Prediction and Jacobian of the shipped surrogate beside the rod that it replaces."""

import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.weights_file import SHIPPED_ONE_ROD

STEP = np.tile([0.005] * 3 + [np.deg2rad(2.25)] * 3, 2)


def milliseconds(call: Callable[[], object], count: int = 300) -> tuple[float, float]:
    """Median and p99 of ``call``."""
    for _ in range(10):
        call()
    times = []
    for _ in range(count):
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    return float(np.median(times)), float(np.percentile(times, 99))


def main() -> None:
    rng = np.random.default_rng(0)
    rod = CosseratRod(RodProperties(length=0.5))
    start = rod.settle(random_boundary(rng, 0.5))
    displacement = BoundaryDisplacement.from_vector(STEP * rng.choice([-1.0, 1.0], 12))
    predictor = ShapePredictor.load(properties=rod.properties)
    reference = ShapePredictor.load(SHIPPED_ONE_ROD)
    centerline = start.positions

    def move() -> None:
        rod.restore(start)
        rod.move(displacement)

    def move_and_differentiate() -> None:
        move()
        rod.sensitivity()

    table = Table("51 nodes, one core", "median ms", "p99 ms")
    for name, call in (
        ("surrogate: prediction", lambda: predictor.predict(centerline, displacement)),
        (
            "surrogate: prediction and Jacobian",
            lambda: predictor.predict_with_jacobian(centerline, displacement),
        ),
        ("surrogate: for another rod", lambda: predictor.for_rod(rod.properties)),
        ("reference rod only: prediction", lambda: reference.predict(centerline, displacement)),
        (
            "reference rod only: prediction and Jacobian",
            lambda: reference.predict_with_jacobian(centerline, displacement),
        ),
        ("rod: restore and move", move),
        ("rod: restore, move and sensitivity", move_and_differentiate),
    ):
        median, p99 = milliseconds(call)
        table.add_row(name, f"{median:.3f}", f"{p99:.3f}")
    Console().print(table)


if __name__ == "__main__":
    main()
