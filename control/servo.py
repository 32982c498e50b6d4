"""The plainest controller: both clamps go straight to the goal's ends."""

from math import sqrt

import numpy as np

from control.controller import ControlDiagnostics
from control.safety_limits import SafetyLimits
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate


class EndServo:
    """Moves the clamps straight to the goal's ends and tangents, blind to what is in between.

    Args:
        limits: of the safety gate; one step's translation fits into the box inside them.
    """

    diagnostics = ControlDiagnostics()

    def __init__(self, limits: SafetyLimits) -> None:
        self._step = limits.translation_step / sqrt(3.0)

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        pass

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        ends = ((goal[0], goal[1] - goal[0]), (goal[-1], goal[-1] - goal[-2]))
        twists = []
        for clamp, (position, tangent) in zip(boundary.clamps, ends, strict=False):
            turn = np.cross(clamp[:3, 2], tangent / np.linalg.norm(tangent))
            twists.append(np.concatenate([position - clamp[:3, 3], turn]))
        largest = max(np.abs(twist[:3]).max() for twist in twists)
        return BoundaryDisplacement(*twists).scaled(self._step / max(largest, self._step))
