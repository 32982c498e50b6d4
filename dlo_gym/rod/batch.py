"""Many rods that settle and move together, in threads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState
from dlo_gym.threads import Threads, n_cores

Asked = TypeVar("Asked")


@dataclass(frozen=True, eq=False)
class BatchState:
    """Where m rods are after all were asked for something.

    Attributes:
        states: (m,) of each rod; None of one that has never settled.
        errors: (m,) why a rod stayed where it was; None where it did as asked.
        n_elements: of each rod.
    """

    states: tuple[RodState | None, ...]
    errors: tuple[RodDiverged | ValueError | None, ...]
    n_elements: int

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(m,) which rods stayed where they were, because of an error."""
        return np.array([error is not None for error in self.errors])

    @property
    def positions(self) -> Array:
        """(m, n_nodes, 3) centerlines in world [m]; NaN without a state, as all that follows."""
        return self._stacked(lambda state: state.positions, self.n_elements + 1, 3)

    @property
    def quaternions(self) -> Array:
        """(m, n_elements, 4) wxyz of R_world_element."""
        return self._stacked(lambda state: state.quaternions, self.n_elements, 4)

    @property
    def curvature(self) -> Array:
        """(m, n_elements - 1, 3) curvature and twist at the inner nodes [1/m]."""
        return self._stacked(lambda state: state.curvature, self.n_elements - 1, 3)

    @property
    def strain(self) -> Array:
        """(m, n_elements, 3) shear and stretch [-]."""
        return self._stacked(lambda state: state.strain, self.n_elements, 3)

    @property
    def wrenches(self) -> Array:
        """(m, 2, 6) force [N] and torque [N m], world axes, of left and right clamp on the rod."""
        return self._stacked(lambda state: np.stack([state.wrench_left, state.wrench_right]), 2, 6)

    @property
    def energy(self) -> Array:
        """(m,) elastic plus gravitational [J]."""
        return self._stacked(lambda state: np.asarray(state.energy))

    def _stacked(self, part: Callable[[RodState], Array], *shape: int) -> Array:
        unknown = np.full(shape, np.nan)
        return np.stack([unknown if state is None else part(state) for state in self.states])


class RodBatch:
    """Rods of one number of elements, each of its own material, that are worked out in threads.

    Every result is the single rod's to the last bit. Between calls the rods may be used on their
    own: to restore a state, say, or for their sensitivities. A rod that can touch nothing lets go
    of Python's lock while it moves, so only such rods gain from more threads than one.

    Args:
        rods: distinct rods of the same ``n_elements``.
        threads: how many work at once; None takes one per core that this process may use.

    Raises:
        ValueError: naming the argument.
    """

    def __init__(self, rods: Sequence[CosseratRod], *, threads: int | None = None) -> None:
        self.rods = tuple(rods)
        if not self.rods or len(set(map(id, self.rods))) < len(self.rods):
            raise ValueError(f"rods: expected distinct rods, at least one, got {list(self.rods)}")
        sizes = sorted({rod.n_elements for rod in self.rods})
        if len(sizes) > 1:
            raise ValueError(f"rods: expected one number of elements, got {sizes}")
        if threads is None:
            threads = n_cores()
        if threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self.threads = min(threads, len(self.rods))
        self._threads = Threads(self.threads)

    def __len__(self) -> int:
        return len(self.rods)

    @property
    def state(self) -> BatchState:
        """The present states."""
        return self._each(lambda rod, _: rod.state, [None] * len(self))

    def settle(self, boundaries: Sequence[BoundaryPoses]) -> BatchState:
        """Find every rod's equilibrium between its own clamps, as ``CosseratRod.settle``.

        Raises:
            ValueError: if they are not one per rod. What is wrong with one rod alone is among the
                result's errors.
        """
        return self._each(CosseratRod.settle, boundaries)

    def move(self, displacements: ArrayLike) -> BatchState:
        """Move every rod's clamps, as ``CosseratRod.move``.

        Args:
            displacements: (m, 12) or (m, 6), ``BoundaryDisplacement``'s vectors.

        Raises:
            ValueError: if they are not one per rod, or not finite. What is wrong with one rod
                alone, one overstretched or without a state, is among the result's errors.
        """
        displacements = np.asarray(displacements, dtype=np.float64)
        return self._each(
            CosseratRod.move, [BoundaryDisplacement.from_vector(row) for row in displacements]
        )

    def _each(
        self, action: Callable[[CosseratRod, Asked], RodState], asked: Sequence[Asked]
    ) -> BatchState:
        """What ``action`` returns or raises for each rod and what is ``asked`` of it."""
        if len(asked) != len(self):
            raise ValueError(f"expected one per rod, {len(self)}, got {len(asked)}")
        done = self._threads.map(lambda rod, wanted: _answer(action, rod, wanted), self.rods, asked)
        return BatchState(
            tuple(answer.state for answer in done),
            tuple(answer.error for answer in done),
            self.rods[0].n_elements,
        )


class _Answer(NamedTuple):
    state: RodState | None
    error: RodDiverged | ValueError | None


def _answer(
    action: Callable[[CosseratRod, Asked], RodState], rod: CosseratRod, asked: Asked
) -> _Answer:
    try:
        return _Answer(action(rod, asked), None)
    except RodDiverged as error:
        return _Answer(error.last_good, error)
    except ValueError as error:
        return _Answer(rod.state if rod.settled else None, error)
