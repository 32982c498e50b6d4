"""The closed loop without its clock: what a run computes and a replay computes again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from control.controller import Controller
from control.models import RodModel, SurrogateModel
from control.mpc import ShapeMPC
from control.policy import PolicyController
from control.safety import SafetyDecision, SafetyGate, SafetyLimits
from dlo_gym.geometry.camera import View
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.state import ShapeEstimate
from sim2real.config import CellConfig
from tracking.predictors import RodPredictor, make_predictor
from tracking.tracker import MultiViewTracker, TrackerConfig


@dataclass(frozen=True, eq=False)
class LoopInput:
    """All that one control step depends on.

    Attributes:
        views: one image per camera, taken together.
        stamp: when they were taken, since the start of the run [s].
        boundary: the clamps at that time, as measured.
        commanded: the clamps where the last command sends them.
        joint_angles: (2, 6) newest of the arms [rad].
    """

    views: tuple[View, ...]
    stamp: float
    boundary: BoundaryPoses
    commanded: BoundaryPoses
    joint_angles: Array


@dataclass(frozen=True, eq=False)
class LoopOutput:
    """What one control step came to.

    Attributes:
        estimate: the tracked shape when the images were taken.
        ahead: (n_nodes, 3) that shape carried on to the commanded clamps [m].
        requested: what the controller asked for, from the commanded clamps.
        decision: what the safety gate lets through of it.
        status: of the controller.
        tracking_ms, control_ms: time of the tracker, and of controller and gate.
    """

    estimate: ShapeEstimate
    ahead: Array
    requested: BoundaryDisplacement
    decision: SafetyDecision
    status: str
    tracking_ms: float
    control_ms: float


class TrackedCable:
    """Follows the cable through a sequence of images and clamp poses.

    Args:
        config: cable, cameras and tracker.
    """

    def __init__(self, config: CellConfig) -> None:
        self.properties = config.rod.properties
        tracker = config.tracker
        predictor = make_predictor(tracker.predictor, self.properties, tracker.n_nodes)
        settings = TrackerConfig(
            triangulation=tracker.triangulation, lost_after=tracker.lost_after_s
        )
        self._tracker = MultiViewTracker(predictor, config.camera_models, config=settings)
        self._ahead = RodPredictor(self.properties, tracker.n_nodes, memory=1.0)
        self._boundary: BoundaryPoses | None = None

    def follow(self, views: Sequence[View], boundary: BoundaryPoses, stamp: float) -> ShapeEstimate:
        """The shape in ``views``, taken at ``stamp`` with the clamps at ``boundary``.

        Raises:
            TrackLost: if the cable has not been seen for too long.
        """
        if self._boundary is None:
            self._tracker.initialise(boundary, self.properties, stamp=stamp)
            self._boundary = boundary
        displacement = self._boundary.displacement_to(boundary)
        self._boundary = boundary
        return self._tracker.update(tuple(views), displacement, stamp)

    def ahead(self, centerline: Array, start: BoundaryPoses, end: BoundaryPoses) -> Array:
        """The shape (n_nodes, 3) [m] after the clamps have gone from ``start`` to ``end``: makes
        up for the time that images and arms take."""
        return self._ahead.predict(centerline, start.displacement_to(end), start)


class ClosedLoop:
    """Tracker, latency compensation, controller and safety gate, one step at a time.

    A function of its inputs alone: the same inputs give the same outputs to the last bit.

    Args:
        config: of the cell.
        goal: (n_nodes, 3) shape to reach, world [m].
        speed: share of the steps and speeds in the cell's limits, from 0 to 1.
    """

    def __init__(self, config: CellConfig, goal: Array, speed: float = 1.0) -> None:
        self.config = config
        self.goal = goal
        self.limits = slowed(config.safety_limits, speed)
        self.gate = SafetyGate(self.limits, config.dual_arm)
        self.cable = TrackedCable(config)
        self.controller = make_controller(config, self.limits)
        self._started = False

    def step(self, given: LoopInput) -> LoopOutput:
        """One control step.

        Raises:
            TrackLost: if the cable has not been seen for too long.
            SolverFailed: if the controller gives up.
            SafetyStop: if the gate refuses to let anything through.
        """
        if not self._started:
            self.controller.reset(self.goal, given.commanded, self.cable.properties)
            self._started = True
        started = perf_counter()
        estimate = self.cable.follow(given.views, given.boundary, given.stamp)
        tracked = perf_counter()
        ahead = self.cable.ahead(estimate.centerline, given.boundary, given.commanded)
        requested = self.controller.control(
            replace(estimate, centerline=ahead), given.commanded, self.goal
        )
        decision = self.gate.check(requested, given.commanded, given.joint_angles)
        return LoopOutput(
            estimate,
            ahead,
            requested,
            decision,
            self.controller.diagnostics.status,
            1e3 * (tracked - started),
            1e3 * (perf_counter() - tracked),
        )

    def resume(self, boundary: BoundaryPoses) -> None:
        """Starts anew from the clamps' present poses after a stop; the cable is tracked on."""
        self.gate.reset()
        self.controller.reset(self.goal, boundary, self.cable.properties)


def slowed(limits: SafetyLimits, speed: float) -> SafetyLimits:
    """``limits`` with steps and speeds times ``speed``.

    Raises:
        ValueError: if ``speed`` is not in (0, 1].
    """
    if not 0.0 < speed <= 1.0:
        raise ValueError(f"speed: expected more than 0 and at most 1, got {speed}")
    return replace(
        limits,
        max_translation_step=speed * limits.max_translation_step,
        max_rotation_step=speed * limits.max_rotation_step,
        max_speed=speed * limits.max_speed,
        max_rotation_speed=speed * limits.max_rotation_speed,
    )


def make_controller(config: CellConfig, limits: SafetyLimits) -> Controller:
    """The controller that the cell file names.

    Raises:
        ValueError: if an RL controller comes without a policy, or the surrogate does not fit the
            cable's number of nodes.
        WeightsError: if weights are missing or damaged.
    """
    control, n_nodes = config.control, config.tracker.n_nodes
    if control.controller == "rl":
        if control.policy is None:
            raise ValueError("control.policy: the rl controller needs the file of a policy")
        return PolicyController(Path(control.policy))
    if control.model == "rod":
        return ShapeMPC(RodModel(n_nodes - 1), limits)
    from dlo_gym.surrogate.predictor import ShapePredictor

    predictor = ShapePredictor.load()
    if predictor.n_nodes != n_nodes:
        raise ValueError(
            f"tracker.n_nodes: the surrogate knows cables of {predictor.n_nodes} nodes, got"
            f" {n_nodes}; take control.model = 'rod'"
        )
    return ShapeMPC(SurrogateModel(predictor), limits)
