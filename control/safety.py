"""The single gate that every command passes, in simulation and on robots."""

from dataclasses import dataclass, field
from math import inf, isfinite, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import SafetyStop
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses

# A straight cut below this fraction of the command counts as blocked: then it slides instead.
BLOCKED = 0.05
BISECTIONS = 30
# Relative; a step that is at its limit up to rounding passes whole.
STEP_TOLERANCE = 1e-6


@dataclass(frozen=True)
class SafetyLimits:
    """What a command may do to each gripper.

    Steps and speeds are Euclidean norms per gripper. The default steps are the diagonals of an
    action box of 10 mm per axis and 4.5 degrees about each of d1 and d2.

    Attributes:
        max_translation_step: of one command [m].
        max_rotation_step: of one command [rad].
        max_speed: of a gripper [m/s]; 0.25 m/s is the usual limit beside people (ISO 10218-1).
        max_rotation_speed: of a gripper [rad/s].
        control_period: time between two commands [s]; with the speeds it limits the step too.
        rod_length: rest length of the rod [m].
        overstretch_margin: the clamps stay within ``(1 - margin) * rod_length`` of each other [-].
        min_gripper_distance: between the clamps' origins [m].
        workspace: lower and upper corner (3,) of the box the clamps' origins stay in, world [m].
        max_deviation, max_rotation_deviation: of the poses a command starts from, from the last
            command sent [m], [rad]; beyond it the arms are not where they were sent and the gate
            stops.

    Raises:
        ValueError: naming the field.
    """

    max_translation_step: float = 0.01 * sqrt(3.0)
    max_rotation_step: float = 4.5 * pi / 180.0 * sqrt(2.0)
    max_speed: float = 0.25
    max_rotation_speed: float = 1.5
    control_period: float = 0.1
    rod_length: float = 0.5
    overstretch_margin: float = 0.02
    min_gripper_distance: float = 0.05
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = field(
        default=((-0.6, -0.5, 0.05), (0.6, 0.5, 0.9))
    )
    max_deviation: float = 0.05
    max_rotation_deviation: float = 0.4

    def __post_init__(self) -> None:
        for name in (
            "max_translation_step",
            "max_rotation_step",
            "max_speed",
            "max_rotation_speed",
            "control_period",
            "rod_length",
            "max_deviation",
            "max_rotation_deviation",
        ):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive number, got {value}")
        if self.max_rotation_step > pi / 2:
            raise ValueError(
                f"max_rotation_step: expected at most pi/2 rad, got {self.max_rotation_step}"
            )
        if not 0.0 <= self.overstretch_margin < 1.0:
            raise ValueError(
                f"overstretch_margin: expected 0 <= margin < 1, got {self.overstretch_margin}"
            )
        if not 0.0 <= self.min_gripper_distance < self.max_gripper_distance:
            raise ValueError(
                "min_gripper_distance: expected between 0 and the largest distance"
                f" {self.max_gripper_distance:.4g} m, got {self.min_gripper_distance}"
            )
        box = np.asarray(self.workspace, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise ValueError(
                f"workspace: expected a lower corner below an upper corner, got {self.workspace}"
            )

    @property
    def max_gripper_distance(self) -> float:
        """The largest distance between the clamps' origins [m]."""
        return (1.0 - self.overstretch_margin) * self.rod_length

    @property
    def translation_step(self) -> float:
        """The largest translation in one period, by step and by speed [m]."""
        return min(self.max_translation_step, self.max_speed * self.control_period)

    @property
    def rotation_step(self) -> float:
        """The largest rotation in one period, by step and by speed [rad]."""
        return min(self.max_rotation_step, self.max_rotation_speed * self.control_period)


@dataclass(frozen=True, eq=False)
class SafetyDecision:
    """What may be sent.

    Attributes:
        displacement: from the poses the command was to start from.
        target: the poses to send, ``boundary.displaced(displacement)``.
        reasons: the limits that cut the command, of ``"translation step"``, ``"rotation step"``,
            ``"workspace"``, ``"overstretch"``, ``"gripper distance"``; empty if nothing was cut.
    """

    displacement: BoundaryDisplacement
    target: BoundaryPoses
    reasons: tuple[str, ...] = ()

    @property
    def was_cut(self) -> bool:
        return bool(self.reasons)


class SafetyGate:
    """Cuts commands to ``limits``; remembers the last one sent.

    The limits make a convex set of steps around the last command sent, so a command is cut along
    its own direction, to the largest fraction that stays inside. Where that leaves (nearly)
    nothing, because the arms stand at a border, the part that pushes outwards is taken away and
    the command slides along the border.

    Arms that are outside a limit already may move in every way that does not take them further
    out; nothing moves them by itself.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits = limits
        self._last: BoundaryPoses | None = None

    def reset(self) -> None:
        """Forgets the last command; after a stop, or when the arms were moved by others."""
        self._last = None

    def check(self, displacement: BoundaryDisplacement, boundary: BoundaryPoses) -> SafetyDecision:
        """What may be sent of ``displacement``, which starts from the poses ``boundary``.

        The step is measured from the last command this gate let through, if there is one. The
        returned target counts as sent.

        Raises:
            SafetyStop: if a value is not finite, or ``boundary`` is further than
                ``max_deviation`` from the last command sent.
            ValueError: if the displacement does not move exactly the clamps that exist.
        """
        vector = displacement.vector
        if not np.isfinite(vector).all():
            raise SafetyStop(f"command refused: expected finite numbers, got {vector.tolist()}")
        if (displacement.right is None) != (boundary.right is None):
            raise ValueError(
                "displacement: must move the right clamp exactly if it exists, got "
                f"right={displacement.right} for right clamp {boundary.right}"
            )
        requested, reasons = _scaled_to_step(vector.reshape(-1, 2, 3), self.limits)
        if self._last is None or _same(self._last, boundary):
            allowed = _Allowed(self.limits, boundary)
            sent, cut_by = _cut(requested, allowed)
            step = displacement
            if reasons or cut_by:
                step = BoundaryDisplacement.from_vector(sent.ravel())
            target = boundary.displaced(step)
        else:
            self._check_deviation(boundary)
            wanted = boundary.displaced(BoundaryDisplacement.from_vector(requested.ravel()))
            from_last = self._last.displacement_to(wanted).vector.reshape(-1, 2, 3)
            allowed = _Allowed(self.limits, self._last)
            sent, cut_by = _cut(from_last, allowed)
            target = self._last.displaced(BoundaryDisplacement.from_vector(sent.ravel()))
            step = boundary.displacement_to(target)
        self._last = target
        return SafetyDecision(step, target, tuple(dict.fromkeys([*reasons, *cut_by])))

    def _check_deviation(self, boundary: BoundaryPoses) -> None:
        assert self._last is not None
        difference = self._last.displacement_to(boundary).vector.reshape(-1, 2, 3)
        metres, radians = np.linalg.norm(difference, axis=2).max(axis=0)
        limits = self.limits
        if metres > limits.max_deviation or radians > limits.max_rotation_deviation:
            raise SafetyStop(
                f"the arms are {1e3 * metres:.1f} mm and {np.degrees(radians):.1f} degrees from"
                f" the last command sent, {1e3 * limits.max_deviation:.1f} mm and"
                f" {np.degrees(limits.max_rotation_deviation):.1f} degrees are allowed; reset the"
                " gate to go on from where they are"
            )


class _Allowed:
    """The convex set of steps (k, 2, 3) allowed from ``boundary``, which always holds zero.

    A limit that is already broken at ``boundary`` is widened to what it is there.
    """

    def __init__(self, limits: SafetyLimits, boundary: BoundaryPoses) -> None:
        self.translation_step = limits.translation_step * (1.0 + STEP_TOLERANCE)
        self.rotation_step = limits.rotation_step * (1.0 + STEP_TOLERANCE)
        self.origins = _origins(boundary)
        lower, upper = np.asarray(limits.workspace)
        self.lower = np.minimum(lower, self.origins)
        self.upper = np.maximum(upper, self.origins)
        self.two = boundary.right is not None
        if self.two:
            gap = self.origins[1] - self.origins[0]
            distance = float(np.linalg.norm(gap))
            self.axis = gap / distance if distance > 0 else np.zeros(3)
            self.max_distance = max(limits.max_gripper_distance, distance)
            # Along the present axis: a half-space inside the true, non-convex limit.
            self.min_distance = min(limits.min_gripper_distance, float(self.axis @ gap))

    def broken(self, step: Array) -> list[str]:
        """The limits that ``step`` (k, 2, 3) breaks."""
        reasons = []
        size = np.sqrt(np.square(step).sum(axis=2))
        if size[:, 0].max() > self.translation_step:
            reasons.append("translation step")
        if size[:, 1].max() > self.rotation_step:
            reasons.append("rotation step")
        targets = self.origins + step[:, 0]
        if (targets < self.lower).any() or (targets > self.upper).any():
            reasons.append("workspace")
        if self.two:
            gap = targets[1] - targets[0]
            if np.linalg.norm(gap) > self.max_distance:
                reasons.append("overstretch")
            if self.axis @ gap < self.min_distance:
                reasons.append("gripper distance")
        return reasons

    def slid(self, step: Array) -> Array:
        """``step`` with its translations moved back onto the workspace and distance limits."""
        step = step.copy()
        targets = np.clip(self.origins + step[:, 0], self.lower, self.upper)
        if self.two:
            gap = targets[1] - targets[0]
            length = float(np.linalg.norm(gap))
            excess = np.zeros(3)
            if length > self.max_distance:
                excess = gap * (1.0 - self.max_distance / length)
            elif (along := float(self.axis @ gap)) < self.min_distance:
                excess = self.axis * (along - self.min_distance)
            # Each gripper gives back in proportion to what its own motion contributed.
            direction = excess / max(float(np.linalg.norm(excess)), 1e-300)
            shares = np.maximum([-step[0, 0] @ direction, step[1, 0] @ direction], 0.0)
            shares = shares / shares.sum() if shares.sum() > 0 else np.full(2, 0.5)
            targets += np.outer(shares * [1.0, -1.0], excess)
        step[:, 0] = targets - self.origins
        return step


def _cut(step: Array, allowed: _Allowed) -> tuple[Array, list[str]]:
    """The part of ``step`` (k, 2, 3) that is allowed, and the limits that cut it."""
    reasons = allowed.broken(step)
    if not reasons:
        return step, reasons
    fraction = _largest_fraction(step, allowed)
    if fraction < BLOCKED:
        slid = allowed.slid(step)
        along = _largest_fraction(slid, allowed)
        if along > BLOCKED:
            return along * slid, reasons
    return fraction * step, reasons


def _largest_fraction(step: Array, allowed: _Allowed) -> float:
    """The largest fraction of ``step`` that is allowed; zero always is."""
    if not allowed.broken(step):
        return 1.0
    inside, outside = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        if allowed.broken(middle * step):
            outside = middle
        else:
            inside = middle
    return inside


def _scaled_to_step(step: Array, limits: SafetyLimits) -> tuple[Array, list[str]]:
    """``step`` (k, 2, 3) scaled as a whole to the step limits, and the limits that cut it."""
    # Divided by its largest value first, so that no norm of a huge command overflows.
    largest = float(np.abs(step).max())
    if largest == 0.0:
        return step, []
    size = np.sqrt(np.square(step / largest).sum(axis=2)).max(axis=0)
    steps = (limits.translation_step, limits.rotation_step)
    bounds = [limit / s if s > 0 else inf for limit, s in zip(steps, size, strict=True)]
    names = ("translation step", "rotation step")
    tolerant = largest / (1.0 + STEP_TOLERANCE)
    reasons = [name for name, bound in zip(names, bounds, strict=True) if tolerant > bound]
    if not reasons:
        return step, []
    return step / largest * min(bounds), reasons


def _origins(boundary: BoundaryPoses) -> NDArray[np.float64]:
    """The clamps' origins (k, 3), k the number of clamps [m]."""
    clamps = [boundary.left] if boundary.right is None else [boundary.left, boundary.right]
    return np.array([clamp[:3, 3] for clamp in clamps])


def _same(a: BoundaryPoses, b: BoundaryPoses) -> bool:
    return np.array_equal(a.left, b.left) and (
        a.right is b.right
        or (a.right is not None and b.right is not None and np.array_equal(a.right, b.right))
    )
