"""Steps of the grippers that keep the convex limits, and the part of a step that does."""

from collections.abc import Callable
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from control.safety_limits import SafetyLimits, Violation
from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.arms import SIDES

# A straight cut below this fraction of the command counts as blocked: then it slides instead.
BLOCKED = 0.05
# Relative; a step that is at its limit up to rounding passes whole.
STEP_TOLERANCE = 1e-6
FRACTIONS, ROUNDS = 16, 8


class AllowedSteps:
    """The convex set of steps (k, 2, 3) allowed from clamp origins (k, 3) [m]; it holds zero.

    A limit that is already broken at the origins is widened to what it is there. A step is a
    translation [m] and a rotation vector [rad] for each of k clamps.

    Args:
        limits: to keep.
        origins: (k, 3) of the clamps, world [m].
        former: (k, 2, 3) the step before, which accelerations count from; None from rest.
    """

    def __init__(self, limits: SafetyLimits, origins: Array, former: Array | None = None) -> None:
        self.origins = origins
        self.two = len(origins) == 2
        self.former = np.zeros((len(origins), 2, 3)) if former is None else former
        self.period = limits.control_period
        lower, upper = np.asarray(limits.workspace)
        self.lower, self.upper = np.minimum(lower, origins), np.maximum(upper, origins)
        self.normals = limits.plane_normals
        self.plane_offsets = (self.normals * limits.plane_points).sum(axis=1)
        self.plane_bounds = np.minimum(origins @ self.normals.T - self.plane_offsets, 0.0)
        self.axis = np.zeros(3)
        longest = shortest = 0.0
        if self.two:
            gap = origins[1] - origins[0]
            distance = float(np.linalg.norm(gap))
            self.axis = gap / distance if distance > 0 else self.axis
            longest = max(limits.max_gripper_distance, distance)
            # Along the present axis: a half-space inside the true, non-convex limit.
            shortest = min(limits.min_gripper_distance, float(self.axis @ gap))
        self.max_distance, self.min_distance = longest, shortest
        self.accelerations = (limits.max_acceleration, limits.max_rotation_acceleration)
        self._label(limits)

    def _label(self, limits: SafetyLimits) -> None:
        """The rows of ``values``: limit, what, unit, bound, whether it is the least allowed."""
        rows: list[tuple[str, str, str, float, bool]] = []
        clamps = [f"{side} clamp" for side in SIDES[: len(self.origins)]]
        steps = (("translation step", limits.translation_step, "m"),)
        steps += (("rotation step", limits.rotation_step, "rad"),)
        for name, bound, unit in steps:
            rows += [(name, clamp, unit, bound * (1 + STEP_TOLERANCE), False) for clamp in clamps]
        for corner, at_least in ((self.lower, True), (self.upper, False)):
            rows += [
                ("workspace", f"{clamp}'s {axis}", "m", corner[i, j], at_least)
                for i, clamp in enumerate(clamps)
                for j, axis in enumerate("xyz")
            ]
        rows += [
            ("plane", f"{clamp} to plane {j}", "m", self.plane_bounds[i, j], True)
            for i, clamp in enumerate(clamps)
            for j in range(len(self.normals))
        ]
        if self.two:
            rows.append(("overstretch", "between the clamps", "m", self.max_distance, False))
            rows.append(("gripper distance", "between the clamps", "m", self.min_distance, True))
        names = (("acceleration", "m/s^2"), ("rotation acceleration", "rad/s^2"))
        for (name, unit), bound in zip(names, self.accelerations, strict=True):
            if isfinite(bound):
                bound = bound * (1 + STEP_TOLERANCE)
                rows += [(name, clamp, unit, bound, False) for clamp in clamps]
        self.rows = rows
        self.bounds = np.array([row[3] for row in rows])
        self.signs = np.array([-1.0 if row[4] else 1.0 for row in rows])

    def values(self, steps: Array) -> Array:
        """What each limit looks at, (m, n_rows), of steps (m, k, 2, 3)."""
        m = len(steps)
        size = np.sqrt(np.square(steps).sum(axis=3))
        targets = self.origins + steps[:, :, 0]
        flat = targets.reshape(m, -1)
        columns = [size[:, :, 0], size[:, :, 1], flat, flat]
        if len(self.normals):
            columns.append((targets @ self.normals.T - self.plane_offsets).reshape(m, -1))
        if self.two:
            gap = targets[:, 1] - targets[:, 0]
            columns += [np.linalg.norm(gap, axis=1)[:, None], (gap @ self.axis)[:, None]]
        for part, bound in enumerate(self.accelerations):
            if isfinite(bound):
                change = speeding_up(steps[:, :, part], self.former[:, part])
                columns.append(change / self.period**2)
        return np.concatenate(columns, axis=1)

    def holds(self, steps: Array) -> NDArray[np.bool_]:
        """(m,) whether each of steps (m, k, 2, 3) keeps every limit."""
        kept = self.signs * (self.values(steps) - self.bounds) <= 0.0
        return np.asarray(np.all(kept, axis=1))

    def violations(self, step: Array) -> list[Violation]:
        """The limits that ``step`` (k, 2, 3) breaks."""
        values = self.values(step[None])[0]
        broken = np.flatnonzero(~(self.signs * (values - self.bounds) <= 0.0))
        found = []
        for i in broken:
            limit, what, unit, bound, at_least = self.rows[i]
            found.append(Violation(limit, what, float(values[i]), float(bound), unit, at_least))
        return found

    def largest_fraction(self, step: Array) -> float:
        """The largest fraction of ``step`` (k, 2, 3) that is allowed; zero always is."""
        if self.holds(step[None])[0]:
            return 1.0
        return largest_fraction(lambda f: self.holds(f[:, None, None, None] * step))

    def slid(self, step: Array) -> Array:
        """``step`` with its translations moved back onto workspace, planes and distances."""
        step = step.copy()
        targets = np.clip(self.origins + step[:, 0], self.lower, self.upper)
        for normal, offset, bounds in zip(
            self.normals, self.plane_offsets, self.plane_bounds.T, strict=True
        ):
            targets += np.outer(np.maximum(bounds - (targets @ normal - offset), 0.0), normal)
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

    def cut(self, step: Array) -> tuple[Array, list[Violation]]:
        """The part of ``step`` (k, 2, 3) that is allowed, and the limits that cut it."""
        violations = self.violations(step)
        if not violations:
            return step, violations
        fraction = self.largest_fraction(step)
        if fraction < BLOCKED:
            slid = self.slid(step)
            along = self.largest_fraction(slid)
            if along > BLOCKED:
                return along * slid, violations
        return fraction * step, violations


def scaled_to_step(step: Array, limits: SafetyLimits) -> tuple[Array, list[Violation]]:
    """``step`` (k, 2, 3) scaled as a whole to the step limits, and the limits that cut it."""
    # Divided by its largest value first, so that no norm of a huge command overflows.
    largest = float(np.abs(step).max())
    if largest == 0.0:
        return step, []
    sizes = np.sqrt(np.square(step / largest).sum(axis=2))
    size = sizes.max(axis=0)
    steps = (limits.translation_step, limits.rotation_step)
    bounds = [limit / s if s > 0 else inf for limit, s in zip(steps, size, strict=True)]
    tolerant = largest / (1.0 + STEP_TOLERANCE)
    names = (("translation step", "m"), ("rotation step", "rad"))
    violations = []
    for i, (name, unit) in enumerate(names):
        if tolerant > bounds[i]:
            side = SIDES[int(np.argmax(sizes[:, i]))]
            value = largest * float(size[i])
            violations.append(Violation(name, f"{side} clamp", value, steps[i], unit))
    if not violations:
        return step, []
    return step / largest * min(bounds), violations


def largest_fraction(
    passes: Callable[[Array], NDArray[np.bool_]], fractions: int = FRACTIONS, rounds: int = ROUNDS
) -> float:
    """The fraction below 1 up to which all passes, by search between ever closer neighbours.

    ``passes`` says of fractions (m,) which do; the result is too small by at most
    ``fractions ** -rounds``. Zero is taken to pass.
    """
    inside, outside = 0.0, 1.0
    for _ in range(rounds):
        tried = inside + (outside - inside) * np.arange(1, fractions + 1) / fractions
        passed = passes(tried)
        passed[-1] = False  # known from the round before, or from the caller
        first = int(np.argmin(passed))
        outside = float(tried[first])
        inside = float(tried[first - 1]) if first > 0 else inside
    return inside


def speeding_up(step: Array, former: Array) -> Array:
    """By how much (...) ``step`` (..., 3) is faster than, or turned from, ``former`` (..., 3).

    The distance to the nearest point between ``former`` and standing still.
    """
    length = np.maximum((former * former).sum(axis=-1), 1e-300)
    along = np.clip((step * former).sum(axis=-1) / length, 0.0, 1.0)
    return np.linalg.norm(step - along[..., None] * former, axis=-1)
