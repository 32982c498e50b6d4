"""The rod's Hessian at any shape, stable or not, to see where stability ends."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import eig_banded, solve_banded

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import CosseratRod, RodState
from dlo_gym.rod import _kernels_energy as energy_kernels
from dlo_gym.rod._kernels_assembly import assemble
from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH
from dlo_gym.rod._kernels_solve import apply_step, exact_stress, free_range

TOLERANCE = 1e-6  # of EI / L^2: the largest force left at an equilibrium


class Linearisation(NamedTuple):
    """The rod's energy about a shape, to second order in what is free to move.

    Turns are measured times the element length, so that the units are the same throughout.

    Attributes:
        gradient: (n_free,) zero at an equilibrium [N].
        band: (9, n_free) lower band of the Hessian [N/m].
    """

    gradient: Array
    band: Array

    def lowest(self, count: int = 4) -> Array:
        """The lowest eigenvalues of the Hessian [N/m], ascending."""
        return eig_banded(
            self.band, lower=True, eigvals_only=True, select="i", select_range=(0, count - 1)
        )


def relax(rod: CosseratRod, shape: RodState, hold: int) -> RodState:
    """The equilibrium near ``shape``, stable or not, by Newton's method with SciPy's solver.

    Args:
        hold: an unknown that stays where it is. Where the rod can turn at no cost, holding an
            unknown that the turn would move leaves one equilibrium, still free of any force there.

    Raises:
        RuntimeError: if no equilibrium is reached.
    """
    positions, quaternions = shape.positions.copy(), shape.quaternions.copy()
    largest = TOLERANCE * rod.properties.bending_stiffness / rod.properties.length**2
    free = slice(*free_range(rod.n_elements, shape.boundary.right is not None))
    for _ in range(20):
        shape = replace(shape, positions=positions.copy(), quaternions=quaternions.copy())
        gradient, band = linearise(rod, shape)
        if np.abs(gradient).max() < largest:
            return shape
        band[0, hold - free.start] *= 1e12
        upper = [np.roll(diagonal, k) for k, diagonal in enumerate(band)][:0:-1]
        step = np.zeros(6 * rod.n_elements + 3)
        step[free] = -solve_banded((HALF_BANDWIDTH,) * 2, [*upper, *band], gradient)
        step /= _scale(rod)
        apply_step(rod._arrays, positions, quaternions, step, 1.0, np.zeros((rod.n_elements, 3)))
    raise RuntimeError(f"no equilibrium nearby: {np.abs(gradient).max():.1e} N left")


def linearise(rod: CosseratRod, shape: RodState) -> Linearisation:
    """The rod's own energy about ``shape``, which need not be an equilibrium."""
    rod.restore(shape)
    n_dofs = 6 * rod.n_elements + 3
    work = energy_kernels.Work(
        np.zeros((rod.n_elements, 3)), np.zeros(n_dofs), np.zeros((n_dofs, HALF_BANDWIDTH + 1)),
        np.zeros((2, 4, 3)),
    )  # fmt: skip
    exact_stress(rod._arrays, shape.positions, shape.quaternions, work.stress)
    assemble(rod._system, shape.positions, shape.quaternions, rod._ends, work, True)
    free = slice(*free_range(rod.n_elements, rod._ends.right_held))
    scale = _scale(rod)[free]
    lower = work.band[free].T.copy()
    for k, diagonal in enumerate(lower):
        inside = len(scale) - k
        diagonal[:inside] /= scale[:inside] * scale[k:]
        diagonal[inside:] = 0.0
    return Linearisation(work.gradient[free] / scale, lower)


def _scale(rod: CosseratRod) -> Array:
    """(n_dofs,) 1 for a position, the element length [m] for a turn."""
    scale = np.ones(6 * rod.n_elements + 3)
    scale.reshape(-1, 3)[1::2] = rod.properties.length / rod.n_elements
    return scale
