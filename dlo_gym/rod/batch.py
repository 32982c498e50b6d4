"""Many rods that settle and move together, in threads."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState

Asked = TypeVar("Asked")


@dataclass(frozen=True, eq=False)
class BatchState:
    """Where m rods are after all were asked for something.

    Attributes:
        states: (m,) of each rod; None of one that has never settled.
        errors: (m,) why a rod stayed where it was; None where it did as asked.
    """

    states: tuple[RodState | None, ...]
    errors: tuple[RodDiverged | ValueError | None, ...]

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(m,) which rods stayed where they were, because of an error."""
        return np.array([error is not None for error in self.errors])

    @property
    def positions(self) -> Array:
        """(m, n_nodes, 3) centerlines in world [m]; NaN without a state, as all that follows."""
        return self._stacked(lambda state: state.positions)

    @property
    def quaternions(self) -> Array:
        """(m, n_elements, 4) wxyz of R_world_element."""
        return self._stacked(lambda state: state.quaternions)

    @property
    def curvature(self) -> Array:
        """(m, n_elements - 1, 3) curvature and twist at the inner nodes [1/m]."""
        return self._stacked(lambda state: state.curvature)

    @property
    def strain(self) -> Array:
        """(m, n_elements, 3) shear and stretch [-]."""
        return self._stacked(lambda state: state.strain)

    @property
    def wrenches(self) -> Array:
        """(m, 2, 6) force [N] and torque [N m], world axes, of left and right clamp on the rod."""
        return self._stacked(lambda state: np.stack([state.wrench_left, state.wrench_right]))

    @property
    def energy(self) -> Array:
        """(m,) elastic plus gravitational [J]."""
        return self._stacked(lambda state: np.asarray(state.energy))

    def _stacked(self, part: Callable[[RodState], Array]) -> Array:
        parts = [None if state is None else part(state) for state in self.states]
        shape = next((np.shape(known) for known in parts if known is not None), ())
        return np.stack([np.full(shape, np.nan) if known is None else known for known in parts])


class RodBatch:
    """Rods of one number of elements, each of its own material, that are worked out in threads.

    Every result is the single rod's to the last bit. Between calls the rods may be used on their
    own: to restore a state, say, or for their sensitivities. A rod that can touch nothing lets go
    of Python's lock while it moves, so only such rods gain from more threads than one.

    Args:
        rods: distinct rods of the same ``n_elements``.
        threads: how many work at once; None takes ``OMP_NUM_THREADS`` where it is set, else the
            number of this process's cores.

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
            threads = int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
        if threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self.threads = min(threads, len(self.rods))
        self._pool = ThreadPoolExecutor(self.threads, "rods") if self.threads > 1 else None

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
        done: list[_Answer] = [_Answer(None, None)] * len(self)

        def work(first: int) -> None:
            for i in range(first, len(self), self.threads):
                done[i] = _answer(action, self.rods[i], asked[i])

        if self._pool is None:
            work(0)
        else:
            list(self._pool.map(work, range(self.threads)))
        return BatchState(
            tuple(answer.state for answer in done), tuple(answer.error for answer in done)
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
