"""What a controller is."""

from dataclasses import dataclass, field
from typing import Protocol

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate


@dataclass(frozen=True)
class ControlDiagnostics:
    """How a controller came to its last command.

    Attributes:
        status: ``"ok"``, or why the controller held still.
        cost: of the plan that was found, in the controller's own measure; NaN if it has none.
        predicted_error: of the shape to the goal at the end of the plan, mean over the nodes [m].
        timings_ms: by component.
    """

    status: str = "ok"
    cost: float = float("nan")
    predicted_error: float = float("nan")
    timings_ms: dict[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return self.status == "ok"


class Controller(Protocol):
    """Steers the rod to a goal shape: MPC, servo, sampling or a learned policy."""

    @property
    def diagnostics(self) -> ControlDiagnostics:
        """Of the last call of ``control``."""
        ...

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        """Starts an episode: goal (n_nodes, 3) [m], the clamp poses and the rod held in them."""
        ...

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        """The displacement to ask for next.

        What is really sent is the safety gate's decision; a controller that must know it compares
        the ``boundary`` of two calls.

        Args:
            estimate: the rod's shape as it was observed after the last command.
            boundary: the clamps' present poses.
            goal: (n_nodes, 3) the shape to reach, world [m].
        """
        ...
