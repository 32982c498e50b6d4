"""The task: where the rod starts, what is progress and what failure."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.envs.cell import OccluderPath, SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.exceptions import RodDiverged, UnreachablePose
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from dlo_gym.metrics import ptp_3d
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses, displace
from dlo_gym.scene.clearance import clearance

DENSE_UNIT = 0.1  # mean node error that costs 1 per step [m]
ATTEMPTS = 200


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


def advance_all(
    cells: Sequence[SimulatedCell],
    twists: Array,
    config: ShapeEnvConfig,
    each: Callable[..., Iterable[str]] = map,
) -> list[str]:
    """``advance`` of each of n cells by twists (n, k, 6) [m], [rad] of their k clamps.

    What the arms do is worked out for all cells at once; ``each`` is how to ``map`` the rest.
    """
    clamps = np.stack([cell.boundary.clamps for cell in cells])
    ends = clamps[..., :3, 3] + twists[..., :3]
    reasons = clamps_apart(cells, ends, config)
    joint_angles: Sequence[Array | None] = [None] * len(cells)
    arms = cells[0].arms
    if arms is not None:
        guesses = np.stack([_joint_angles(cell) for cell in cells])
        joint_angles = list(arms.reach(displace(clamps, twists), guesses))
    for i, (cell, points) in enumerate(zip(cells, ends, strict=True)):
        if not reasons[i] and cell.clamps_at_obstacle(points):
            reasons[i] = "collision"
    free = [i for i, reason in enumerate(reasons) if not reason]
    arguments = [[values[i] for i in free] for values in (cells, twists, joint_angles)]
    for i, reason in zip(free, each(move, *arguments), strict=True):
        reasons[i] = reason
    moved = [i for i, reason in enumerate(reasons) if not reason]
    if moved:
        for i, reason in zip(moved, _contacts([cells[i] for i in moved], config), strict=True):
            reasons[i] = reason
    return reasons


def _contacts(cells: Sequence[SimulatedCell], config: ShapeEnvConfig) -> list[str]:
    """What each of the cells touches where it stands that it must not, or ``""``."""
    arms, colliding = cells[0].arms, [False] * len(cells)
    if arms is not None:
        gaps = clearance(arms.T_world_base, np.stack([_joint_angles(cell) for cell in cells]))
        colliding = [gap < 0.0 for gap in gaps.smallest]
    reasons = []
    for cell, touching in zip(cells, colliding, strict=True):
        if touching or cell.arms_at_obstacle():
            reasons.append("collision")
        elif forbidden_touch(cell, config):
            reasons.append("obstacle_contact")
        else:
            reasons.append("table_contact" if above_table(cell) < 0.0 else "")
    return reasons


def forbidden_touch(cell: SimulatedCell, config: ShapeEnvConfig) -> bool:
    """Whether the rod touches an obstacle that it must not."""
    forbidden = (touch == "forbidden" for touch in config.touches)
    return any(hit and no for hit, no in zip(cell.touching, forbidden, strict=False))


def above_table(cell: SimulatedCell) -> float:
    """Height of the rod's lowest node above where the rod would touch the table [m]."""
    return float(cell.rod_state.positions[:, 2].min()) - cell.rod_radius


def clamps_apart(cells: Sequence[SimulatedCell], ends: Array, config: ShapeEnvConfig) -> list[str]:
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


def move(cell: SimulatedCell, twist: Array, joint_angles: Array | None) -> str:
    """Move the clamps by ``twist`` (k, 6) [m], [rad], which arms at ``joint_angles`` (2, 6) [rad]
    hold then; why they cannot, or ``""``."""
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
    middle = (0.0, 0.0, config.start_height)
    for _ in range(ATTEMPTS):
        try:
            cell.reset(level_clamps(middle, rng, config), occluders)
        except (UnreachablePose, RodDiverged, ValueError):
            continue
        ends = cell.boundary.clamps[None, :, :3, 3]
        if clamps_apart([cell], ends, config) == _contacts([cell], config) == [""]:
            return
    raise ValueError(
        f"no start found in {ATTEMPTS} attempts for start_distance={config.start_distance},"
        f" start_height={config.start_height}, start_noise={config.start_noise}"
    )


def level_clamps(
    middle: ArrayLike, rng: np.random.Generator, config: ShapeEnvConfig
) -> BoundaryPoses:
    """Clamps ``start_distance`` apart along x around ``middle`` (3,) [m], level but for noise."""
    along_x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # d3 = +x, d2 = +z
    clamps = []
    for side in (-0.5, 0.5):
        position = np.array(middle, dtype=np.float64)
        position[0] += side * config.start_distance
        position += rng.uniform(-1.0, 1.0, 3) * config.start_noise[0]
        tilt = np.append(rng.uniform(-1.0, 1.0, 2) * config.start_noise[1], 0.0)
        if config.planar:
            position[1] = tilt[1] = 0.0
        clamps.append(pose(along_x @ exp_so3(tilt), position))
    return BoundaryPoses(*clamps[: config.n_clamps])
