"""The rod between two grippers that move as the robots please."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState

LARGEST_STEP = (0.005, 0.1)  # of one step along a move: translation [m], rotation [rad]
LARGEST_MOVE = (0.1, 0.6)  # what goes further was not carried there: the rod settles anew
SMALLEST_MOVE = 1e-7  # [m], [rad]
LOST_FORCE = 60.0  # where no equilibrium was found, above any sensible limit [N]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class HeldShape:
    """The rod as the world shows it.

    Attributes:
        positions: (n_nodes, 3) centerline in world [m]; (0, 3) where no rod is held.
        boundary: the clamp poses.
        wrenches: (2, 6) force [N] and torque [N m] that the left and the right clamp exert on the
            rod at its end nodes, world axes.
        problem: why this is no equilibrium; empty if it is.
    """

    positions: Array
    boundary: BoundaryPoses
    wrenches: Array
    problem: str = ""

    @classmethod
    def nothing(cls, boundary: BoundaryPoses) -> "HeldShape":
        """Of grippers at ``boundary`` that hold no rod, and so feel none."""
        return cls(np.zeros((0, 3)), boundary, np.zeros((2, 6)))


class HeldRod:
    """Follows the clamps wherever they go and never fails.

    Within reach the rod is in quasi-static equilibrium. Clamps further apart than the rod is long
    pull at its last shape, which goes along with them, with a force that grows by
    ``overstretch_stiffness``; so they do, with a large force, where no equilibrium is found.

    Args:
        properties: of the rod.
        n_elements: of the rod.
        overstretch_stiffness: [N/m].
    """

    def __init__(
        self, properties: RodProperties, n_elements: int = 50, overstretch_stiffness: float = 2000.0
    ) -> None:
        self.rod = CosseratRod(properties, n_elements)
        self.overstretch_stiffness = overstretch_stiffness
        self._shape: HeldShape | None = None
        self._settled: RodState | None = None

    def follow(self, boundary: BoundaryPoses) -> HeldShape:
        """The rod after its clamps went to ``boundary``."""
        before = self._shape
        if before is not None and _same(before.boundary, boundary):
            return before
        if boundary.distance >= self.rod.properties.length:
            shape = self._pulled(boundary)
        else:
            shape = self._equilibrium(boundary)
        former = "" if before is None else before.problem
        if bool(shape.problem) != bool(former):
            _log.warning("rod: %s", shape.problem or "in equilibrium again")
        self._shape = shape
        return shape

    def forget(self) -> None:
        """Lets the rod settle anew at the next poses."""
        self._shape = self._settled = None

    def _equilibrium(self, boundary: BoundaryPoses) -> HeldShape:
        try:
            state = self._moved(boundary)
        except RodDiverged as error:
            lost = self._carried(boundary, LOST_FORCE)
            return replace(lost, problem=f"no equilibrium: {error}")
        self._settled = state
        wrenches = np.stack([state.wrench_left, state.wrench_right])
        return HeldShape(state.positions, boundary, wrenches)

    def _moved(self, boundary: BoundaryPoses) -> RodState:
        """The rod's equilibrium, along the move from the last one where there is one."""
        if self._settled is None:
            return self.rod.settle(boundary)
        move = self._settled.boundary.displacement_to(boundary)
        if _size(move, LARGEST_MOVE) > 1.0:
            return self.rod.settle(boundary)
        n_steps = max(int(np.ceil(_size(move, LARGEST_STEP))), 1)
        try:
            for _ in range(n_steps - 1):
                self.rod.move(move.scaled(1.0 / n_steps))
            at = self.rod.state.boundary
            return self.rod.move(move if n_steps == 1 else at.displacement_to(boundary))
        except (RodDiverged, ValueError):
            # A straight line between two poses in reach may leave it.
            return self._settled_anew(boundary)

    def _settled_anew(self, boundary: BoundaryPoses) -> RodState:
        assert self._settled is not None
        try:
            return self.rod.settle(boundary)
        except RodDiverged:
            self.rod.restore(self._settled)  # the move may have failed on its way
            raise

    def _pulled(self, boundary: BoundaryPoses) -> HeldShape:
        length = self.rod.properties.length
        stiffness = max(
            self.overstretch_stiffness,
            float(np.max(self.rod.properties.stretching_stiffness)) / length,
        )
        shape = self._carried(boundary, stiffness * (boundary.distance - length))
        problem = f"overstretched: clamps {boundary.distance:.4f} m apart, rod {length:.4f} m long"
        return replace(shape, problem=problem)

    def _carried(self, boundary: BoundaryPoses, force: float) -> HeldShape:
        """The last shape with its ends at ``boundary``, pulled apart by ``force`` [N] more."""
        last = self._settled
        assert boundary.right is not None
        ends = np.stack([boundary.left[:3, 3], boundary.right[:3, 3]])
        share = np.linspace(0.0, 1.0, self.rod.n_nodes)[:, None]
        if last is None:
            positions = (1.0 - share) * ends[0] + share * ends[1]
            wrenches = np.zeros((2, 6))
        else:
            shift = ends - last.positions[[0, -1]]
            positions = last.positions + (1.0 - share) * shift[0] + share * shift[1]
            wrenches = np.stack([last.wrench_left, last.wrench_right])
        chord = (ends[1] - ends[0]) / max(boundary.distance, 1e-9)
        wrenches[0, :3] -= force * chord
        wrenches[1, :3] += force * chord
        return HeldShape(positions, boundary, wrenches)


def _same(first: BoundaryPoses, second: BoundaryPoses) -> bool:
    assert first.right is not None
    assert second.right is not None
    left, right = first.left - second.left, first.right - second.right
    return max(np.abs(left).max(), np.abs(right).max()) < SMALLEST_MOVE


def _size(move: BoundaryDisplacement, unit: tuple[float, float] = (1.0, 1.0)) -> float:
    """The larger of translation and rotation, in units of ``unit`` [m], [rad]."""
    ends = move.vector.reshape(-1, 2, 3)
    return float((np.linalg.norm(ends, axis=-1) / np.array(unit)).max())
