"""What a validation case hands to the page."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike


class Case(NamedTuple):
    """One table of the page with its picture.

    Attributes:
        header: (n_columns,) names.
        rows: each (n_columns,) cells.
        draw: fills an empty figure; None for a case without a picture.
        size: of the picture, width and height [inch].
    """

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    draw: Callable[[Figure], None] | None = None
    size: tuple[float, float] = (7.0, 2.8)


COMPARISON = ("quantity", "reference", "rod", "error")


def compare(quantity: str, reference: float, ours: float, unit: str = "") -> tuple[str, ...]:
    """A row of ``COMPARISON``, its error relative to the reference."""
    error = abs(ours / reference - 1.0)
    percent = f"{100 * error:.2g} %" if error > 1e-6 else f"{error:.0e}"
    return quantity, f"{reference:.5g} {unit}".strip(), f"{ours:.5g} {unit}".strip(), percent


def order(counts: ArrayLike, errors: ArrayLike) -> float:
    """The order of convergence: minus the slope of log(error) over log(number of pieces)."""
    return float(-np.polyfit(np.log(counts), np.log(errors), 1)[0])
