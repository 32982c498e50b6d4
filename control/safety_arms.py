"""Steps of the grippers that the arms can follow without touching each other or the table."""

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from control.safety_limits import SafetyLimits, Violation
from control.safety_steps import BLOCKED, AllowedSteps
from dlo_gym.exceptions import SafetyStop, UnreachablePose
from dlo_gym.geometry.se3 import Array, exp_so3
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.clearance import clearance
from dlo_gym.scene.ur5e import nearest_solution, wrist_angle

# A step is looked at in this many points of its way, then in as many more before the first of
# them that breaks a limit.
POINTS = 5
ROUNDING = 1e-9
DIFFERENCE = 1e-5  # of finite differences [m]
LEVER = 0.15  # [m]; a rotation counts as the motion of a point this far from the clamp
# A step that slides along an arm's surface also leaves it a little, by this part of its length,
# because the surface is curved.
LIFT = 0.05

CLEARANCES = (
    "between the arms",
    *(f"{side} arm to the table" for side in SIDES),
    *(f"{side} arm to itself" for side in SIDES),
)
WRISTS = tuple(f"{side} arm's wrist" for side in SIDES)


class Followed(NamedTuple):
    """A step (k, 2, 3) that the arms follow, the joint angles (2, 6) [rad] they come to and
    start from, and what cut it."""

    step: Array
    joint_angles: Array
    start: Array
    violations: list[Violation]


class _Tried(NamedTuple):
    """Fractions (m,) of a step: joint angles (m, 2, 6) [rad], what the limits look at (m, n_rows),
    whether they hold (m,)."""

    fractions: Array
    joint_angles: Array
    values: Array
    passed: NDArray[np.bool_]


class ArmSteps:
    """A step (k, 2, 3) of clamps at poses (k, 4, 4), as far as the arms can follow it.

    Keeps reach, joint speed and acceleration, the clearances of the arms and their wrists out of
    the singularity. These limits are
    not convex, so the step is looked at in ``POINTS`` points of its way. A limit that is already
    broken at the poses is widened to what it is there: standing still always passes.

    Args:
        limits: to keep.
        arms: whose grippers hold the clamps.
        clamps: (k, 4, 4) poses in the world.
        joint_angles: (2, 6) near which the arms are [rad].
        former: (2, 6) the joints' step before [rad], which accelerations count from.
    """

    def __init__(
        self, limits: SafetyLimits, arms: DualArm, clamps: Array, joint_angles: Array, former: Array
    ) -> None:
        self.limits, self.arms, self.clamps = limits, arms, clamps
        self.guess, self.former = joint_angles, former
        self.wrist_sides = np.sign(wrist_angle(joint_angles))
        self._stands = False

    def cut(self, step: Array, allowed: AllowedSteps) -> Followed:
        """The part of ``step`` (k, 2, 3), which ``allowed`` holds, that the arms follow too.

        Raises:
            SafetyStop: if an arm cannot hold its clamp where it is.
        """
        fraction, straight = self._straight(step)
        near = any(one.limit in ("clearance", "singularity") for one in straight.violations)
        if fraction < BLOCKED and near:
            slid = self._slid(step)
            slid = allowed.largest_fraction(slid) * slid
            along, sliding = self._straight(slid)
            if along > BLOCKED:
                return sliding._replace(violations=straight.violations)
        return straight

    def _straight(self, step: Array) -> tuple[float, Followed]:
        """The largest fraction of ``step`` (k, 2, 3) up to which the arms follow, and where to."""
        whole = self._tried(step, np.linspace(0.0, 1.0, POINTS + 1))
        if whole.passed.all():
            return 1.0, Followed(step, whole.joint_angles[-1], self.start, [])
        # Shown for the whole step; where only its way is barred, for the bar.
        first = int(np.argmin(whole.passed))
        shown = first if whole.passed[-1] else -1
        violations = self._violations(whole.joint_angles[shown], whole.values[shown])
        before, bar = whole.fractions[first - 1 : first + 1].tolist()
        fine = self._tried(step, np.linspace(before, bar, POINTS + 1))
        fine.passed[0], fine.passed[-1] = True, False  # as seen, whatever rounding says now
        last = int(np.argmin(fine.passed)) - 1
        fraction = float(fine.fractions[last])
        return fraction, Followed(fraction * step, fine.joint_angles[last], self.start, violations)

    def _tried(self, step: Array, fractions: Array) -> _Tried:
        """Fractions (m,) of ``step`` (k, 2, 3); the first time from zero, so that where the arms
        are needs no call of its own."""
        joint_angles = self.reached(fractions[:, None, None, None] * step)
        near = self._margins(joint_angles)
        if not self._stands:
            self._stand(joint_angles[0], near[0])
        values = np.concatenate([self._rates(joint_angles), near], axis=1)
        passed = np.all(self.signs * (values - self.bounds) <= ROUNDING, axis=1)
        return _Tried(fractions, joint_angles, values, np.asarray(passed))

    def _stand(self, joint_angles: Array, near: Array) -> None:
        """Takes joint angles (2, 6) and margins (7,) for where the arms are: steps count from
        there, limits are widened to it."""
        if not np.isfinite(joint_angles).all():
            raise _unreachable(self.arms, self.clamps, self.guess)
        self.start, self.margins, self._stands = joint_angles, near, True
        joints = (
            ("joint speed", "rad/s", self.limits.max_joint_speed),
            ("joint acceleration", "rad/s^2", self.limits.max_joint_acceleration),
        )
        self.rows = [
            (name, f"{side} arm", unit, bound, False)
            for name, unit, bound in joints
            for side in SIDES
        ]
        self.rows += [
            ("clearance", what, "m", min(self.limits.min_arm_clearance, margin), True)
            for what, margin in zip(CLEARANCES, near[:-2].tolist(), strict=True)
        ]
        angle = self.limits.min_wrist_angle or -inf
        self.rows += [
            ("singularity", what, "rad", min(angle, margin), True)
            for what, margin in zip(WRISTS, near[-2:].tolist(), strict=True)
        ]
        self.bounds = np.array([row[3] for row in self.rows])
        self.signs = np.array([-1.0 if row[4] else 1.0 for row in self.rows])

    def reached(self, steps: Array) -> Array:
        """(m, 2, 6) joint angles after steps (m, k, 2, 3), as ``DualArm.inverse_kinematics``
        gives them; NaN where an arm does not reach."""
        k = len(self.clamps)
        clamps = np.tile(self.clamps, (len(steps), 1, 1, 1))
        clamps[..., :3, :3] = exp_so3(steps[:, :, 1]) @ clamps[..., :3, :3]
        clamps[..., :3, 3] += steps[:, :, 0]
        joint_angles = np.tile(self.guess, (len(steps), 1, 1))
        flanges = self.arms.flange_in_base(clamps)
        joint_angles[:, :k] = nearest_solution(flanges, self.guess[:k])
        return joint_angles

    def _margins(self, joint_angles: Array) -> Array:
        """(m, 7) clearances [m] of joint angles (m, 2, 6), and how far either wrist is from its
        singularity [rad], negative on the other side of it."""
        wrists = self.wrist_sides * wrist_angle(joint_angles)
        return np.concatenate([clearances(self.arms, joint_angles), wrists], axis=1)

    def _rates(self, joint_angles: Array) -> Array:
        """(m, 4) largest joint speeds of the arms [rad/s], then accelerations [rad/s^2], on the
        way to joint angles (m, 2, 6); NaN out of reach."""
        period = self.limits.control_period
        step = joint_angles - self.start
        # Slowing down does not count: only what goes beyond the former step or turns round.
        lower, upper = np.minimum(self.former, 0.0), np.maximum(self.former, 0.0)
        change = np.abs(step - np.clip(step, lower, upper))
        rates = [np.abs(step).max(axis=2) / period, change.max(axis=2) / period**2]
        return np.concatenate(rates, axis=1)

    def _violations(self, joint_angles: Array, values: Array) -> list[Violation]:
        """The limits that joint angles (2, 6) with ``values`` (n_rows,) break."""
        found = [
            Violation("reach", f"{side} arm cannot take its clamp there")
            for side, angles in zip(SIDES, joint_angles, strict=True)
            if np.isnan(angles).any()
        ]
        for (limit, what, unit, bound, at_least), value, excess in zip(
            self.rows, values.tolist(), (self.signs * (values - self.bounds)).tolist(), strict=True
        ):
            if excess > ROUNDING:
                found.append(Violation(limit, what, value, bound, unit, at_least))
        return found

    def _slid(self, step: Array) -> Array:
        """``step`` (k, 2, 3) turned along the surfaces that it would press the arms against."""
        k = len(self.clamps)
        scale = np.tile(np.repeat([1.0, 1.0 / LEVER], 3), k)
        tried = np.eye(6 * k) * DIFFERENCE * scale
        near = self._margins(self.reached(tried.reshape(-1, k, 2, 3)))
        # (7, 6 k); NaN at the edge of an arm's reach, where nothing can be said.
        gradients = np.nan_to_num(((near - self.margins) / DIFFERENCE).T)
        room = self.bounds[-len(self.margins) :] - self.margins
        scaled = step.ravel() / scale
        lift = LIFT * float(np.linalg.norm(scaled))
        # Rounds of projections onto each surface's half-space, from which the others may push.
        for _ in range(3):
            for gradient, least in zip(gradients, room, strict=True):
                size = float(gradient @ gradient)
                missing = least - float(gradient @ scaled)
                if missing > 0.0 and size > 1e-9:
                    scaled = scaled + (missing + lift * np.sqrt(size)) / size * gradient
        return (scaled * scale).reshape(k, 2, 3)


def clearances(arms: DualArm, joint_angles: Array) -> Array:
    """``DualArm.clearance`` of joint angles (m, 2, 6) as (m, 5), by ``CLEARANCES`` [m]."""
    near = clearance(arms.T_world_base, joint_angles)
    return np.concatenate([near.between_arms[:, None], near.to_table, near.within_arm], axis=1)


def _unreachable(arms: DualArm, clamps: Array, guess: Array) -> SafetyStop:
    """The stop where the arms cannot even be where they are."""
    try:
        arms.inverse_kinematics(BoundaryPoses(*clamps), guess)
    except UnreachablePose as error:
        return SafetyStop(f"reach: {error}", limit="reach")
    return SafetyStop("reach: the arms cannot hold the clamps where they are", limit="reach")
