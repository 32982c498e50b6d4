"""Goals: shapes that the rod takes at the end of a way that the environment allows.

The way is planned for clamps and arms first, all of its steps at once; the rod, which takes most of
the time, moves only where they can.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.envs import tasks
from dlo_gym.envs.cell import CellState, SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses, way
from dlo_gym.scene.clearance import clearance

ATTEMPTS = 200
BLOCKED_ATTEMPTS = 5000  # of which one in some hundred is blocked
DETOURS = 10  # tried per blocked way
GOAL_STRETCH = 0.95  # of the largest distance between the clamps, at the goal
STRIDE = 4  # steps that a rod takes at once on the way
WELL_ABOVE = 0.05  # the table, so that it cannot be touched within a stride [m]


@dataclass(frozen=True, eq=False)
class Goal:
    """A shape to reach.

    Attributes:
        centerline: (n_nodes, 3) world [m].
        boundary: the clamp poses that held the rod in it when it was sampled.
    """

    centerline: Array
    boundary: BoundaryPoses


def sample_goal(cell: SimulatedCell, rng: np.random.Generator, config: ShapeEnvConfig) -> Goal:
    """A shape that the rod takes after a random sequence of motions from its present state.

    Every step on the way is one that the environment would allow, so the goal can be reached; the
    way leads over intermediate poses, so it is not the straight one. The cell is left as it was.

    Raises:
        ValueError: if the options leave no goal that can be reached.
    """
    start = cell.save()
    attempts = BLOCKED_ATTEMPTS if config.straight_way == "blocked" else ATTEMPTS
    try:
        for _ in range(attempts):
            if not _wander(cell, start, rng, config):
                continue
            if far_enough(cell, start, config):
                return Goal(cell.rod_state.positions.copy(), cell.boundary)
    finally:
        cell.restore(start)
    raise ValueError(
        f"no goal found in {attempts} attempts for goal_distance={config.goal_distance} [m],"
        f" goal_moves={config.goal_moves}, goal_translation={config.goal_translation} [m],"
        f" goal_rotation={config.goal_rotation} [rad]"
    )


def far_enough(cell: SimulatedCell, start: CellState, config: ShapeEnvConfig) -> bool:
    """Whether the cell is as far from ``start``, and as little stretched, as a goal shall be."""
    distance = tasks.shape_error(cell.rod_state.positions, start.rod.positions)
    near, far = config.goal_distance
    return bool(near <= distance <= far) and not _stretched(cell, cell.boundary, config)


class Leg(NamedTuple):
    """A motion of the clamps in n equal steps, each within the limits.

    Attributes:
        step: the motion of one step.
        clamps: (n, k, 4, 4) poses after each step.
        joint_angles: (n, 2, 6) [rad] that hold them, NaN where an arm cannot; None without arms.
    """

    step: BoundaryDisplacement
    clamps: Array
    joint_angles: Array | None

    @property
    def end(self) -> BoundaryPoses:
        return BoundaryPoses.of_rigid(*self.clamps[-1])


def _wander(
    cell: SimulatedCell, start: CellState, rng: np.random.Generator, config: ShapeEnvConfig
) -> bool:
    """Move the cell along random motions from ``start``; False if there was no way.

    The rod, which takes most of the time, moves only where clamps and arms can.
    """
    ways = _detours if config.straight_way == "blocked" else _walks
    for legs in ways(cell, start, rng, config):
        if _stretched(cell, legs[-1].end, config):
            continue
        if cell.rod_state is not start.rod:
            cell.restore(start)
        if all(_follow(cell, leg) for leg in legs):
            return True
    return False


def _stretched(cell: SimulatedCell, goal: BoundaryPoses, config: ShapeEnvConfig) -> bool:
    return goal.distance > GOAL_STRETCH * config.max_stretch * cell.properties.length


def _walks(
    cell: SimulatedCell, start: CellState, rng: np.random.Generator, config: ShapeEnvConfig
) -> Iterator[list[Leg]]:
    """``goal_moves`` random motions in a row, if clamps and arms can make them all."""
    legs: list[Leg] = []
    boundary, joint_angles = start.rod.boundary, start.joint_angles
    for _ in range(config.goal_moves):
        motion = random_motion(boundary, start.rod.boundary, rng, config)
        leg = _leg(cell, boundary, joint_angles, motion, config)
        if not _passable(cell, leg, config).all():
            return
        legs.append(leg)
        boundary = leg.end
        joint_angles = None if leg.joint_angles is None else leg.joint_angles[-1]
    yield legs


def _detours(
    cell: SimulatedCell, start: CellState, rng: np.random.Generator, config: ShapeEnvConfig
) -> Iterator[list[Leg]]:
    """Ways round to where a random motion leads whose straight way is blocked, each over a
    translation to somewhere else; none where the straight way is free."""
    boundary, joint_angles = start.rod.boundary, start.joint_angles
    motion = random_motion(boundary, boundary, rng, config)
    if not _blocked(cell, _leg(cell, boundary, joint_angles, motion, config)):
        return
    for _ in range(DETOURS):
        around = random_motion(boundary, boundary, rng, config).vector.reshape(2, 6)
        around[:, 3:] = 0.0
        rest = BoundaryDisplacement(*(motion.vector.reshape(2, 6) - around))
        out = _leg(cell, boundary, joint_angles, BoundaryDisplacement(*around), config)
        if _passable(cell, out, config).all():
            assert out.joint_angles is not None
            back = _leg(cell, out.end, out.joint_angles[-1], rest, config)
            if _passable(cell, back, config).all():
                yield [out, back]


def _leg(
    cell: SimulatedCell,
    boundary: BoundaryPoses,
    joint_angles: Array | None,
    motion: BoundaryDisplacement,
    config: ShapeEnvConfig,
) -> Leg:
    """``motion`` from ``boundary``, which ``joint_angles`` (2, 6) [rad] hold."""
    n = n_steps(motion, boundary, config)
    step = motion.scaled(1.0 / n)
    clamps = way(boundary.clamps, step.vector.reshape(-1, 6), n)
    if cell.arms is None or joint_angles is None:
        return Leg(step, clamps, None)
    return Leg(step, clamps, cell.arms.follow(clamps, joint_angles))


def _blocked(cell: SimulatedCell, leg: Leg) -> bool:
    """Whether the arms can hold a leg's end, but would collide or not reach on the way to it."""
    clear = _arms_clear(cell, leg)
    return bool(clear[-1] and not clear.all())


def _passable(cell: SimulatedCell, leg: Leg, config: ShapeEnvConfig) -> NDArray[np.bool_]:
    """(n,) at which steps of a leg the clamps may be and the arms can."""
    apart = tasks.clamps_apart([cell] * len(leg.clamps), leg.clamps[..., :3, 3], config)
    return _arms_clear(cell, leg) & np.array([reason == "" for reason in apart])


def _arms_clear(cell: SimulatedCell, leg: Leg) -> NDArray[np.bool_]:
    """(n,) at which steps of a leg the arms reach the clamps and touch nothing."""
    if cell.arms is None or leg.joint_angles is None:
        return np.ones(len(leg.clamps), dtype=bool)
    return clearance(cell.arms.T_world_base, leg.joint_angles).smallest >= 0.0  # not if NaN


def _follow(cell: SimulatedCell, leg: Leg) -> bool:
    """Move the cell along a leg that clamps and arms can take; False if the rod cannot.

    A rod whose shape does not depend on how it came there strides over some steps at a time, where
    it is well above the table.
    """
    n_steps = len(leg.clamps)
    stride = 1 if cell.rod.path_dependent else STRIDE
    for begin in range(0, n_steps, stride):
        end = min(begin + stride, n_steps)
        start = cell.save()
        if tasks.above_table(cell) > WELL_ABOVE and _moved(cell, leg, begin, end, WELL_ABOVE):
            continue
        if cell.rod_state is not start.rod:
            cell.restore(start)
        if not all(_moved(cell, leg, i, i + 1, 0.0) for i in range(begin, end)):
            return False
    return True


def _moved(cell: SimulatedCell, leg: Leg, begin: int, end: int, height: float) -> bool:
    """Move the cell over steps of a leg at once; whether it could, and the rod came to hang at
    least ``height`` [m] above the table."""
    joint_angles = None if leg.joint_angles is None else leg.joint_angles[end - 1]
    twist = leg.step.vector.reshape(-1, 6) * (end - begin)
    return tasks.move(cell, twist, joint_angles) == "" and tasks.above_table(cell) >= height


def random_motion(
    boundary: BoundaryPoses,
    start: BoundaryPoses,
    rng: np.random.Generator,
    config: ShapeEnvConfig,
) -> BoundaryDisplacement:
    """From ``boundary`` to somewhere around ``start``."""
    low, high = np.asarray(config.workspace)
    together = rng.uniform(-1.0, 1.0, 3)
    apart = rng.uniform(-0.5, 0.5, (2, 3))
    offsets = config.goal_translation * (together + apart)[: config.n_clamps]
    targets = np.clip(start.clamps[:, :3, 3] + offsets, low, high)
    rotations = (rng.uniform(-1.0, 1.0, (2, 2)) * config.goal_rotation)[: config.n_clamps]
    if config.planar:
        targets[:, 1] = boundary.clamps[:, 1, 3]
        rotations[:, 1] = 0.0
    twists = [
        np.concatenate([target - clamp[:3, 3], clamp[:3, :2] @ rotation])
        for clamp, target, rotation in zip(boundary.clamps, targets, rotations, strict=True)
    ]
    return BoundaryDisplacement(*twists)


def n_steps(motion: BoundaryDisplacement, boundary: BoundaryPoses, config: ShapeEnvConfig) -> int:
    """How many steps a motion from ``boundary`` takes within the limits."""
    twists = motion.vector.reshape(-1, 6)
    turns = boundary.clamps[:, :3, :3].swapaxes(-1, -2) @ twists[:, 3:, None]
    largest = max(
        np.abs(twists[:, :3]).max() / config.max_translation_step,
        np.abs(turns).max() / config.max_rotation_step,
    )
    return max(1, int(np.ceil(largest)))
