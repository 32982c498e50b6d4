"""The potential that the solver brings to rest: the rod's own, and what is added to it.

A term is a NamedTuple of arrays, empty where it does not act, and a kernel
``add_term(term, x, q, work, with_hessian)`` that returns its energy [J] and adds to
``work.gradient`` and ``work.band``. Node i has rows 6 i to 6 i + 2, the rotation of element e in
its own frame rows 6 e + 3 to 6 e + 5, so neighbouring nodes fit the half-bandwidth of 8.
"""

from typing import NamedTuple

from numba import njit

from dlo_gym.rod._kernels_energy import RodArrays, assemble_rod
from dlo_gym.rod._kernels_inertia import Inertia, add_inertia


class System(NamedTuple):
    """A rod and the terms that act on it beside its own energy."""

    rod: RodArrays
    inertia: Inertia


@njit(cache=True, inline="always")
def assemble(system, x, q, ends, work, with_hessian):
    """Potential [J] of the shape x (n + 1, 3), q (n, 4); updates ``work`` but for its stress.

    The band is written ``with_hessian`` only.
    """
    energy = assemble_rod(system.rod, x, q, ends, work, with_hessian)
    if system.inertia.weight.size > 0:
        energy += add_inertia(system.inertia, x, q, work, with_hessian)
    return energy
