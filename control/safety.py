"""The single gate that every command passes, in simulation and on robots."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from control.safety_arms import ArmSteps
from control.safety_limits import SafetyLimits, Violation
from control.safety_steps import AllowedSteps, scaled_to_step
from dlo_gym.exceptions import SafetyStop
from dlo_gym.geometry.se3 import Array, exp_so3, log_so3
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.scene.arms import DualArm

__all__ = ["SafetyDecision", "SafetyGate", "SafetyLimits", "Violation"]

ADVICE = "reset the gate to go on from where the arms are"


@dataclass(frozen=True, eq=False)
class SafetyDecision:
    """What may be sent.

    Attributes:
        displacement: from the poses the command was to start from.
        target: the poses to send, ``boundary.displaced(displacement)``.
        cuts: the limits that cut the command, each with what was asked and what is allowed;
            empty if nothing was cut.
    """

    displacement: BoundaryDisplacement
    target: BoundaryPoses
    cuts: tuple[Violation, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """Names of the limits that cut the command, of ``"translation step"``,
        ``"rotation step"``, ``"acceleration"``, ``"rotation acceleration"``, ``"workspace"``,
        ``"plane"``, ``"overstretch"``, ``"gripper distance"``, ``"reach"``, ``"joint speed"``,
        ``"joint acceleration"``, ``"clearance"``."""
        return tuple(dict.fromkeys(cut.limit for cut in self.cuts))

    @property
    def was_cut(self) -> bool:
        return bool(self.cuts)

    def __str__(self) -> str:
        """What would be sent, as a dry run shows it."""
        sides = zip(("left", "right"), self.displacement.vector.reshape(-1, 2, 3), strict=False)
        parts = [
            f"{side} {np.round(1e3 * step[0], 1).tolist()} mm"
            f" {np.round(np.degrees(step[1]), 1).tolist()} deg"
            for side, step in sides
        ]
        cuts = f" (cut by {'; '.join(map(str, self.cuts))})" if self.cuts else ""
        return ", ".join(parts) + cuts


class SafetyGate:
    """Cuts commands to ``limits``; remembers the last one sent.

    The limits of the grippers make a convex set of steps around the last command sent, so a
    command is cut along its own direction, to the largest fraction that stays inside. Where that
    leaves (nearly) nothing, because the arms stand at a border, the part that pushes outwards is
    taken away and the command slides along the border. What is left goes through the limits of
    the arms, which are not convex: reach, joint speeds, clearances.

    Arms that are outside a limit already may move in every way that does not take them further
    out; nothing moves them by itself.

    Args:
        limits: to keep.
        arms: that hold the clamps; without them no limit of an arm is checked.
    """

    def __init__(self, limits: SafetyLimits, arms: DualArm | None = None) -> None:
        self.limits = limits
        self.arms = arms
        self.reset()

    def reset(self) -> None:
        """Forgets the last command; after a stop, or when the arms were moved by others.

        A dry run, whose commands are never sent, resets before every check.
        """
        self._last: BoundaryPoses | None = None
        self._step: Array | None = None
        self._joint_angles: Array | None = None
        self._joint_step = np.zeros((2, 6))

    def check(
        self,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses,
        joint_angles: ArrayLike | None = None,
    ) -> SafetyDecision:
        """What may be sent of ``displacement``, which starts from the poses ``boundary``.

        The step is measured from the last command this gate let through, if there is one. The
        returned target counts as sent.

        Args:
            displacement: the command.
            boundary: present poses of the clamps.
            joint_angles: (2, 6) present ones of the arms [rad]; where the gate has arms and this
                is omitted, those of the last command, at first the arms' home.

        Raises:
            SafetyStop: if a value is not finite, ``boundary`` is further than ``max_deviation``
                from the last command sent, or an arm cannot be where it is.
            ValueError: if the displacement does not move exactly the clamps that exist, or the
                joint angles have another shape.
        """
        vector = displacement.vector
        if not np.isfinite(vector).all():
            raise SafetyStop(f"command refused: expected finite numbers, got {vector.tolist()}")
        if (displacement.right is None) != (boundary.right is None):
            raise ValueError(
                "displacement: must move the right clamp exactly if it exists, got "
                f"right={displacement.right} for right clamp {boundary.right}"
            )
        guess = self._guess(joint_angles)
        requested, cuts = scaled_to_step(vector.reshape(-1, 2, 3), self.limits)
        start = present = _poses(boundary)
        wanted = requested
        if self._last is not None:
            start = _poses(self._last)
            if not np.array_equal(start, present):
                self._check_deviation(start, present)
                wanted = _step(start, _moved(present, requested))
        allowed = AllowedSteps(self.limits, start[:, :3, 3], self._step)
        sent, cut_by = allowed.cut(wanted)
        cuts += cut_by
        if guess is not None:
            assert self.arms is not None
            arms = ArmSteps(self.limits, self.arms, start, guess, self._joint_step)
            followed = arms.cut(sent, allowed)
            sent = followed.step
            cuts += followed.violations
            self._joint_step = followed.joint_angles - followed.start
            self._joint_angles = followed.joint_angles
        if start is present or np.array_equal(start, present):
            step = BoundaryDisplacement.from_vector(sent.ravel()) if cuts else displacement
            target = boundary.displaced(step)
        else:
            target = BoundaryPoses(*_moved(start, sent))
            step = BoundaryDisplacement.from_vector(_step(present, _poses(target)).ravel())
        self._last, self._step = target, sent
        return SafetyDecision(step, target, _first_of_each(cuts))

    def _guess(self, joint_angles: ArrayLike | None) -> Array | None:
        """Joint angles (2, 6) near which to look; None without arms."""
        if self.arms is None:
            return None
        if joint_angles is None:
            return self.arms.home if self._joint_angles is None else self._joint_angles
        guess = np.asarray(joint_angles, dtype=np.float64)
        if guess.shape != (2, 6):
            raise ValueError(f"joint_angles: expected shape (2, 6), got {guess.shape}")
        if not np.isfinite(guess).all():
            raise SafetyStop(f"joint angles refused: expected finite ones, got {guess.tolist()}")
        return guess

    def _check_deviation(self, last: Array, present: Array) -> None:
        metres, radians = np.linalg.norm(_step(last, present), axis=2).max(axis=0).tolist()
        limits = self.limits
        what = "arms from the last command sent"
        for limit, value, bound, unit, shown in (
            ("deviation", metres, limits.max_deviation, "m", f"{1e3 * metres:.1f} mm"),
            (
                "rotation deviation",
                radians,
                limits.max_rotation_deviation,
                "rad",
                f"{np.degrees(radians):.1f} degrees",
            ),
        ):
            if not value <= bound:
                raise Violation(limit, what, value, bound, unit).stop(f"{shown} away; {ADVICE}")


def _first_of_each(cuts: list[Violation]) -> tuple[Violation, ...]:
    """``cuts`` without those that name the same limit and thing a second time."""
    return tuple({(cut.limit, cut.what): cut for cut in reversed(cuts)}.values())[::-1]


def _poses(boundary: BoundaryPoses) -> Array:
    """(k, 4, 4), k the number of clamps."""
    clamps = [boundary.left] if boundary.right is None else [boundary.left, boundary.right]
    return np.array(clamps)


def _moved(poses: Array, step: Array) -> Array:
    """Poses (k, 4, 4) after a step (k, 2, 3)."""
    moved = poses.copy()
    rotation = exp_so3(step[:, 1]) @ poses[:, :3, :3]
    # One Newton step towards the nearest rotation, as ``BoundaryPoses.displaced``.
    moved[:, :3, :3] = 1.5 * rotation - 0.5 * rotation @ rotation.swapaxes(1, 2) @ rotation
    moved[:, :3, 3] += step[:, 0]
    return moved


def _step(start: Array, end: Array) -> Array:
    """The step (k, 2, 3) from poses (k, 4, 4) to others."""
    turned = log_so3(end[:, :3, :3] @ start[:, :3, :3].swapaxes(1, 2))
    return np.stack([end[:, :3, 3] - start[:, :3, 3], turned], axis=1)
