"""The task: where the rod starts, which shape it shall take, what is progress and what failure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.envs.cell import CellState, OccluderPath, SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.exceptions import RodDiverged, UnreachablePose
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from dlo_gym.metrics import ptp_3d
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses, displace
from dlo_gym.scene.clearance import clearance

DENSE_UNIT = 0.1  # mean node error that costs 1 per step [m]
ATTEMPTS = 200
BLOCKED_ATTEMPTS = 5000  # of which one in some hundred is blocked, at a millisecond each
DETOURS = 10  # tried per blocked way
GOAL_STRETCH = 0.95  # of the largest distance between the clamps, at the goal


@dataclass(frozen=True, eq=False)
class Goal:
    """A shape to reach.

    Attributes:
        centerline: (n_nodes, 3) world [m].
        boundary: the clamp poses that held the rod in it when it was sampled.
    """

    centerline: Array
    boundary: BoundaryPoses


def shape_error(achieved: ArrayLike, desired: ArrayLike) -> Array:
    """Mean node distance (...) [m] of centerlines (..., n, 3), or flat (..., 3 n) [m]."""
    achieved = np.asarray(achieved, dtype=np.float64)
    desired = np.asarray(desired, dtype=np.float64)
    if achieved.shape != desired.shape or achieved.size % 3:
        raise ValueError(
            "achieved, desired: expected centerlines of one shape,"
            f" got {achieved.shape} and {desired.shape}"
        )
    if achieved.shape[-1] != 3:
        points = (*achieved.shape[:-1], achieved.shape[-1] // 3, 3)
        achieved, desired = achieved.reshape(points), desired.reshape(points)
    return ptp_3d(achieved, desired).mean(axis=-1)


def compute_reward(
    achieved: ArrayLike,
    desired: ArrayLike,
    failed: ArrayLike,
    *,
    kind: str,
    success_threshold: float,
    termination_penalty: float,
) -> Array:
    """Reward (...) of reaching flat centerlines ``achieved`` for ``desired`` (..., 3 n) [m].

    Args:
        failed: (...) whether the episode ended early at this step.
        kind: ``"dense"``: minus the mean node error in decimetres; ``"sparse"``: 0 if that error
            is at most ``success_threshold`` [m], else -1.
        termination_penalty: taken off where ``failed``.
    """
    error = shape_error(achieved, desired)
    cost = error / DENSE_UNIT if kind == "dense" else (error > success_threshold).astype(float)
    return -cost - termination_penalty * np.asarray(failed, dtype=np.float64)


def failures(infos: dict[str, Any] | Sequence[dict[str, Any]]) -> NDArray[np.bool_]:
    """Whether each info, or the only one, tells of an episode that ended early."""
    if isinstance(infos, dict):
        return np.array(bool(infos.get("termination")))
    return np.array([bool(info.get("termination")) for info in infos], dtype=bool)


def advance(cell: SimulatedCell, displacement: BoundaryDisplacement, config: ShapeEnvConfig) -> str:
    """Move the cell by one step; the reason why that ends the episode, or ``""``.

    A motion that cannot be made leaves the cell as it was.
    """
    return advance_all([cell], displacement.vector.reshape(1, -1, 6), config)[0]


def advance_all(cells: Sequence[SimulatedCell], twists: Array, config: ShapeEnvConfig) -> list[str]:
    """``advance`` of each of n cells by twists (n, k, 6) [m], [rad] of their k clamps.

    What the arms do is worked out for all cells at once.
    """
    clamps = np.stack([cell.boundary.clamps for cell in cells])
    ends = clamps[..., :3, 3] + twists[..., :3]
    reasons = _clamps_apart(cells, ends, config)
    joint_angles: Sequence[Array | None] = [None] * len(cells)
    arms = cells[0].arms
    if arms is not None:
        guesses = np.stack([_joint_angles(cell) for cell in cells])
        joint_angles = list(arms.reach(displace(clamps, twists), guesses))
    for i, (cell, twist, angles) in enumerate(zip(cells, twists, joint_angles, strict=True)):
        if not reasons[i] and cell.clamps_at_obstacle(ends[i]):
            reasons[i] = "collision"
        reasons[i] = reasons[i] or _move(cell, twist, angles)
    moved = [i for i, reason in enumerate(reasons) if not reason]
    if arms is not None and moved:
        gaps = clearance(arms.T_world_base, np.stack([_joint_angles(cells[i]) for i in moved]))
        for i, touching in zip(moved, gaps.smallest < 0.0, strict=True):
            reasons[i] = "collision" if touching or cells[i].arms_at_obstacle() else ""
    for i in moved:
        if not reasons[i] and forbidden_touch(cells[i], config):
            reasons[i] = "obstacle_contact"
        lowest = cells[i].rod_state.positions[:, 2].min()
        if not reasons[i] and lowest < np.max(cells[i].properties.radius):
            reasons[i] = "table_contact"
    return reasons


def forbidden_touch(cell: SimulatedCell, config: ShapeEnvConfig) -> bool:
    """Whether the rod touches an obstacle that it must not."""
    forbidden = (touch == "forbidden" for touch in config.touches)
    return any(hit and no for hit, no in zip(cell.touching, forbidden, strict=False))


def _clamps_apart(cells: Sequence[SimulatedCell], ends: Array, config: ShapeEnvConfig) -> list[str]:
    """Which of the cells' clamps at ``ends`` (n, k, 3) [m] are too far apart or too near."""
    if ends.shape[1] == 1:
        return [""] * len(cells)
    distances = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    longest = config.max_stretch * np.array([cell.properties.length for cell in cells])
    # A command that the safety gate cut to a limit stands on it up to rounding.
    return [
        "overstretch" if far else ("collision" if near else "")
        for far, near in zip(
            distances > longest + 1e-9, distances < config.min_gripper_distance - 1e-9, strict=True
        )
    ]


def _move(cell: SimulatedCell, twist: Array, joint_angles: Array | None) -> str:
    if joint_angles is not None and np.isnan(joint_angles).any():
        return "unreachable"
    try:
        cell.move(BoundaryDisplacement(*twist), joint_angles)
    except UnreachablePose:
        return "unreachable"
    except RodDiverged:
        return "rod_diverged"
    return ""


def _joint_angles(cell: SimulatedCell) -> Array:
    assert cell.joint_angles is not None
    return cell.joint_angles


def reset_to_random_start(
    cell: SimulatedCell,
    rng: np.random.Generator,
    config: ShapeEnvConfig,
    occluders: tuple[OccluderPath, ...],
) -> None:
    """Settle the cell's rod between random clamps around the middle of the start distribution.

    Raises:
        ValueError: if the options leave no start that the arms and the rod can take.
    """
    for _ in range(ATTEMPTS):
        try:
            cell.reset(_random_start(rng, config), occluders)
        except (UnreachablePose, RodDiverged, ValueError):
            continue
        if advance(cell, BoundaryDisplacement.zero(config.n_clamps), config) == "":
            cell.reset(cell.boundary, occluders)
            return
    raise ValueError(
        f"no start found in {ATTEMPTS} attempts for start_distance={config.start_distance},"
        f" start_height={config.start_height}, start_noise={config.start_noise}"
    )


def sample_goal(cell: SimulatedCell, rng: np.random.Generator, config: ShapeEnvConfig) -> Goal:
    """A shape that the rod takes after a random sequence of motions from its present state.

    Every step on the way is one that the environment would allow, so the goal can be reached; the
    way leads over intermediate poses, so it is not the straight one. The cell is left as it was.

    Raises:
        ValueError: if the options leave no goal that can be reached.
    """
    start = cell.save()
    try:
        for _ in range(BLOCKED_ATTEMPTS if config.straight_way == "blocked" else ATTEMPTS):
            cell.restore(start)
            if not _wander(cell, start.rod.boundary, rng, config):
                continue
            if far_enough(cell, start, config):
                return Goal(cell.rod_state.positions.copy(), cell.boundary)
    finally:
        cell.restore(start)
    raise ValueError(
        f"no goal found in {ATTEMPTS} attempts for goal_distance={config.goal_distance} [m],"
        f" goal_moves={config.goal_moves}, goal_translation={config.goal_translation} [m],"
        f" goal_rotation={config.goal_rotation} [rad]"
    )


def far_enough(cell: SimulatedCell, start: CellState, config: ShapeEnvConfig) -> bool:
    """Whether the cell is as far from ``start``, and as little stretched, as a goal shall be."""
    distance = shape_error(cell.rod_state.positions, start.rod.positions)
    stretch = cell.boundary.distance / (config.max_stretch * cell.properties.length)
    near, far = config.goal_distance
    return bool(near <= distance <= far and stretch <= GOAL_STRETCH)


def _random_start(rng: np.random.Generator, config: ShapeEnvConfig) -> BoundaryPoses:
    along_x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # d3 = +x, d2 = +z
    clamps = []
    for side in (-0.5, 0.5):
        position = np.array([side * config.start_distance, 0.0, config.start_height])
        position += rng.uniform(-1.0, 1.0, 3) * config.start_noise[0]
        tilt = np.append(rng.uniform(-1.0, 1.0, 2) * config.start_noise[1], 0.0)
        if config.planar:
            position[1] = tilt[1] = 0.0
        clamps.append(pose(along_x @ exp_so3(tilt), position))
    return BoundaryPoses(*clamps[: config.n_clamps])


def _wander(
    cell: SimulatedCell,
    start: BoundaryPoses,
    rng: np.random.Generator,
    config: ShapeEnvConfig,
) -> bool:
    """Follow ``goal_moves`` random motions in steps; False if one of them is not allowed."""
    if config.straight_way == "blocked":
        return _detour(cell, rng, config)
    return all(
        _follow(cell, random_motion(cell.boundary, start, rng, config), config)
        for _ in range(config.goal_moves)
    )


def _detour(cell: SimulatedCell, rng: np.random.Generator, config: ShapeEnvConfig) -> bool:
    """Follow a random motion whose straight way is blocked, around over a translation to somewhere
    else; False if none of some is allowed."""
    start = cell.save()
    boundary = start.rod.boundary
    motion = random_motion(boundary, boundary, rng, config)
    if not straight_way_blocked(cell, boundary.displaced(motion), config):
        return False
    for _ in range(DETOURS):
        around = random_motion(boundary, boundary, rng, config).vector.reshape(2, 6)
        around[:, 3:] = 0.0
        legs = [
            BoundaryDisplacement(*around),
            BoundaryDisplacement(*(motion.vector.reshape(2, 6) - around)),
        ]
        cell.restore(start)
        if all(_follow(cell, leg, config) for leg in legs):
            return True
    return False


def straight_way_blocked(cell: SimulatedCell, goal: BoundaryPoses, config: ShapeEnvConfig) -> bool:
    """Whether the arms can hold ``goal``, but would collide or not reach on the straight way of
    the cell's clamps to it."""
    guess = cell.joint_angles
    if cell.arms is None or guess is None:
        return False
    motion = cell.boundary.displacement_to(goal)
    n = n_steps(motion, cell.boundary, config)
    shares = np.arange(1, n + 1)[:, None, None] / n
    starts = np.repeat(cell.boundary.clamps[None], n, axis=0)
    clamps = displace(starts, shares * motion.vector.reshape(-1, 6))
    joint_angles = np.empty((n, 2, 6))
    for i in range(n):
        joint_angles[i] = cell.arms.reach(clamps[i], guess)
        guess = np.where(np.isnan(joint_angles[i]), guess, joint_angles[i])
    reached = ~np.isnan(joint_angles).any(axis=(1, 2))
    gaps = clearance(cell.arms.T_world_base, np.nan_to_num(joint_angles)).smallest
    passable = reached & (gaps >= 0.0)
    return bool(passable[-1] and not passable.all())


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


def _follow(cell: SimulatedCell, motion: BoundaryDisplacement, config: ShapeEnvConfig) -> bool:
    n = n_steps(motion, cell.boundary, config)
    step = motion.scaled(1.0 / n)
    return not any(advance(cell, step, config) for _ in range(n))
