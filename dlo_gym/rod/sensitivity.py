"""Derivatives of an equilibrium by the rod's parameters."""

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod._kernels_assembly import System, assemble
from dlo_gym.rod._kernels_banded import solve
from dlo_gym.rod._kernels_energy import Ends, RodArrays, Work
from dlo_gym.rod._kernels_solve import free_range

PARAMETERS = (
    "log_EI",
    "log_GJ",
    "log_weight",
    "rest_curvature_1",
    "rest_curvature_2",
    "rest_twist",
    "length",
)
"""Logarithms are natural; weight is the linear density; the length [m] carries mass with it."""

STEP = 1e-4  # relative; the gradient is linear or nearly so in every parameter


def perturbed(rod: RodArrays, weight: Array, name: str, step: float) -> RodArrays:
    """The rod with one parameter changed by ``step``; ``weight`` (n + 1, 3) [N] is of the nodes."""
    if name == "log_EI":
        scale = np.exp([step, step, 0.0])
        stiffer = np.exp(step)
        return rod._replace(
            bending=rod.bending * scale,
            yield_moment=rod.yield_moment * stiffer,
            hardening=rod.hardening * stiffer,
        )
    if name == "log_GJ":
        return rod._replace(bending=rod.bending * np.exp([0.0, 0.0, step]))
    if name == "log_weight":
        return rod._replace(forces=rod.forces + np.expm1(step) * weight)
    if name == "length":
        stretch = step / float(rod.rest_length.sum())
        return rod._replace(
            rest_length=rod.rest_length * (1.0 + stretch),
            voronoi_length=rod.voronoi_length * (1.0 + stretch),
            forces=rod.forces + stretch * weight,
        )
    axis = PARAMETERS.index(name) - PARAMETERS.index("rest_curvature_1")
    return rod._replace(rest_curvature=rod.rest_curvature + step * np.eye(3)[axis])


def parameter_sensitivity(
    system: System, weight: Array, x: Array, q: Array, ends: Ends, work: Work
) -> Array:
    """d(unknowns)/d(PARAMETERS), shape (n_dofs, 7), given the factors of H in ``work``.

    H d(unknowns) = -d(gradient)/d(parameter), the right side by central differences of the
    gradient at the shape as it is.
    """
    gradient = np.empty_like(work.gradient)
    scratch = work._replace(gradient=gradient, clamp_terms=np.empty_like(work.clamp_terms))
    columns = np.empty((len(gradient), len(PARAMETERS)))
    for column, name in enumerate(PARAMETERS):
        step = STEP * (float(system.rod.rest_length.sum()) if name == "length" else 1.0)
        sides = []
        for sign in (1.0, -1.0):
            rod = perturbed(system.rod, weight, name, sign * step)
            assemble(system._replace(rod=rod), x, q, ends, scratch, False)
            sides.append(gradient.copy())
        columns[:, column] = (sides[1] - sides[0]) / (2.0 * step)
    first, last = free_range(len(q), ends.right_held)
    columns[:first] = 0.0
    columns[last:] = 0.0
    solve(work.band, first, last, columns)
    return columns
