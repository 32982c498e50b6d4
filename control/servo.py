"""The plainest controllers: the clamps go to the goal's ends, straight or over what is there."""

from math import sqrt

import numpy as np

from control.controller import ControlDiagnostics
from control.safety_limits import SafetyLimits
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate

ARRIVED = 1e-3  # at the height, or above the goal [m]


class EndServo:
    """Moves the clamps straight to the goal's ends and tangents, blind to what is in between.

    Args:
        limits: of the safety gate; what a step goes along each axis keeps them together.
        planar: whether two axes are all there are.
    """

    diagnostics = ControlDiagnostics()

    def __init__(self, limits: SafetyLimits, *, planar: bool = False) -> None:
        self._step = limits.translation_step / sqrt(2.0 if planar else 3.0)

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        pass

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        return _within(self._step, _to_ends(boundary, goal))


class OverServo:
    """Lifts the clamps, goes above the goal's ends, and lets the cable down on them.

    Args:
        limits, planar: as of ``EndServo``.
        lift: above the clamps' start and the goal's ends [m], as far as the workspace goes.
    """

    diagnostics = ControlDiagnostics()

    def __init__(self, limits: SafetyLimits, *, planar: bool = False, lift: float = 0.15) -> None:
        self._step = limits.translation_step / sqrt(2.0 if planar else 3.0)
        self._lift, self._ceiling = lift, limits.workspace[1][2]
        self._height = self._ceiling
        self._risen = self._above = False

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        highest = max(boundary.clamps[:, 2, 3].max(), goal[[0, -1], 2].max())
        self._height = min(highest + self._lift, self._ceiling)
        self._risen = self._above = False

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        twists = _to_ends(boundary, goal)
        up = self._height - boundary.clamps[:, 2, 3]
        self._risen = self._risen or np.abs(up).max() < ARRIVED
        self._above = self._above or (self._risen and np.abs(twists[:, :2]).max() < ARRIVED)
        if not self._risen:
            twists[:] = 0.0
        if not self._above:
            twists[:, 2] = up
        return _within(self._step, twists)


def _to_ends(boundary: BoundaryPoses, goal: Array) -> Array:
    """(k, 6) twists that take the clamps to the ends and tangents of a goal (n, 3) [m]."""
    ends = ((goal[0], goal[1] - goal[0]), (goal[-1], goal[-1] - goal[-2]))
    twists = []
    for clamp, (position, tangent) in zip(boundary.clamps, ends, strict=False):
        turn = np.cross(clamp[:3, 2], tangent / np.linalg.norm(tangent))
        twists.append(np.concatenate([position - clamp[:3, 3], turn]))
    return np.stack(twists)


def _within(step: float, twists: Array) -> BoundaryDisplacement:
    """Twists (k, 6), scaled so that no clamp moves by more than ``step`` [m] along an axis."""
    largest = np.abs(twists[:, :3]).max()
    return BoundaryDisplacement(*twists).scaled(step / max(largest, step))
