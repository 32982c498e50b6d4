"""Obstacles that stand in the straight way to a goal, and leave another way to it open."""

from typing import NamedTuple

import numpy as np

from dlo_gym.envs import goals, tasks
from dlo_gym.envs.cell import CellState, SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.rod.obstacles import Box, Capsule, Obstacle
from dlo_gym.scene.clearance import obstacle_clearance

ATTEMPTS = 500
PLACES = 20  # tried per obstacle and way
MARGIN = 0.01  # between an obstacle and what must not touch it on the way [m]
APART = 0.08  # obstacles from each other [m]
ASIDE = 0.06  # deviation of the other obstacles from the straight way [m]
LIFT = (0.04, 0.18)  # of both clamps on the way round [m]


class Way(NamedTuple):
    """A motion without obstacles.

    Attributes:
        steps: the displacement of each of s steps.
        positions: (s, n_nodes, 3) centerlines after each [m].
        joint_angles: (s, 2, 6) [rad]; None without arms.
    """

    steps: list[BoundaryDisplacement]
    positions: Array
    joint_angles: Array | None


def sample_course(
    cell: SimulatedCell, rng: np.random.Generator, config: ShapeEnvConfig
) -> goals.Goal:
    """Put obstacles into a cell that has none, and find a goal behind them.

    On the straight way of the clamps to the goal the cable touches the first obstacle; the others
    stand nearby. A way round them exists: it was simulated among them, every step one that the
    environment allows. The cell is left at its start, with the obstacles.

    Raises:
        ValueError: if the options leave no such goal.
    """
    start = cell.save()
    low, high = config.standing_obstacles or (len(config.obstacles),) * 2
    for _ in range(ATTEMPTS):
        cell.restore(start)
        around = _way_round(cell, start, rng, config)
        straight = None if around is None else _straight_way(cell, start, around, config)
        if around is None or straight is None:
            continue
        n_standing = int(rng.integers(low, high, endpoint=True))
        bodies = _place(cell, start, around, straight, rng, config, n_standing)
        goal = None if bodies is None else _among(cell, start, bodies, around, config)
        if goal is not None:
            return goal
    cell.restore(start)
    raise ValueError(
        f"no way round obstacles found in {ATTEMPTS} attempts for obstacles={config.obstacles},"
        f" goal_distance={config.goal_distance} [m], goal_translation={config.goal_translation} [m]"
    )


def standing(kind: str, top: Array, rng: np.random.Generator) -> Obstacle:
    """A ``"post"`` or ``"box"`` of random thickness on the table, with the middle of its top at
    ``top`` (3,) [m]."""
    if kind == "post":
        radius = float(rng.uniform(0.012, 0.02))
        # Its lower cap is in the table.
        return Capsule.between([top[0], top[1], 0.0], [*top[:2], top[2] - radius], radius)
    half_edges = rng.uniform(0.02, 0.04, 2)
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(0.0, np.pi)]))
    return Box(pose(turn, [*top[:2], top[2] / 2]), np.append(half_edges, top[2] / 2))


def _way_round(
    cell: SimulatedCell, start: CellState, rng: np.random.Generator, config: ShapeEnvConfig
) -> Way | None:
    """A random motion to a goal far enough, over a lifted translation to somewhere else."""
    boundary = start.rod.boundary
    k = config.n_clamps
    motion = goals.random_motion(boundary, boundary, rng, config).vector.reshape(k, 6)
    lifted = goals.random_motion(boundary, boundary, rng, config).vector.reshape(k, 6)
    lifted[:, 3:] = 0.0
    highest = config.workspace[1][2] - boundary.clamps[:, 2, 3]
    lifted[:, 2] = np.minimum(rng.uniform(*LIFT), highest)
    steps, positions, joint_angles = [], [], []
    for twists in (lifted, motion - lifted):
        leg = BoundaryDisplacement(*twists)
        n_steps = goals.n_steps(leg, cell.boundary, config)
        for _ in range(n_steps):
            steps.append(leg.scaled(1.0 / n_steps))
            if tasks.advance(cell, steps[-1], config):
                return None
            positions.append(cell.rod_state.positions)
            joint_angles.append(cell.joint_angles)
    if not goals.far_enough(cell, start, config):
        return None
    return Way(steps, np.stack(positions), None if cell.arms is None else np.stack(joint_angles))


def _straight_way(
    cell: SimulatedCell, start: CellState, around: Way, config: ShapeEnvConfig
) -> Array | None:
    """Centerlines (s, n_nodes, 3) [m] of the cable whose clamps go straight to where ``around``
    leads, whatever the arms meet; None where the cable is lost."""
    motion = start.rod.boundary.displacement_to(cell.boundary)
    cell.restore(start)
    n_steps = goals.n_steps(motion, cell.boundary, config)
    step = motion.scaled(1.0 / n_steps)
    positions = []
    try:
        for _ in range(n_steps):
            positions.append(cell.rod.move(step).positions)
    except (RodDiverged, ValueError):  # the clamps may come too close to each other
        return None
    return np.stack(positions)


def _place(
    cell: SimulatedCell,
    start: CellState,
    around: Way,
    straight: Array,
    rng: np.random.Generator,
    config: ShapeEnvConfig,
    n_standing: int,
) -> tuple[Obstacle, ...] | None:
    """Obstacles beside the start and the way round; the first one is in the straight way."""
    bodies: list[Obstacle] = []
    n_steps, n_nodes, _ = straight.shape
    for kind, touch in zip(config.obstacles[:n_standing], config.touches, strict=False):
        for _ in range(PLACES):
            top = straight[
                rng.integers(n_steps // 4, n_steps), rng.integers(n_nodes // 8, n_nodes * 7 // 8)
            ] + [0.0, 0.0, rng.uniform(0.005, 0.05)]
            if bodies:
                top[:2] += rng.normal(0.0, ASIDE, 2)
            body = standing(kind, top, rng)
            apart = [np.linalg.norm((body.pose - other.pose)[:2, 3]) > APART for other in bodies]
            if all(apart) and _clear(cell, start, around, body, touch):
                bodies.append(body)
                break
        else:
            return None
    return tuple(bodies)


def _clear(cell: SimulatedCell, start: CellState, around: Way, body: Obstacle, touch: str) -> bool:
    """Whether the cable is clear of a body at the start and, unless it may touch it, on the way;
    and the clamps and arms always."""
    margin = MARGIN + cell.rod_radius
    ends = around.positions[:, [0, -1] if start.rod.boundary.right is not None else [0]]
    whole = around.positions if touch == "forbidden" else ends
    for points in (start.rod.positions, whole):
        if (body.signed_distance(points) < margin).any():
            return False
    if cell.arms is None or around.joint_angles is None or start.joint_angles is None:
        return True
    joint_angles = np.concatenate([start.joint_angles[None], around.joint_angles])
    gaps = obstacle_clearance(cell.arms.T_world_base, joint_angles, [body])
    return bool((gaps > MARGIN).all())


def _among(
    cell: SimulatedCell,
    start: CellState,
    bodies: tuple[Obstacle, ...],
    around: Way,
    config: ShapeEnvConfig,
) -> goals.Goal | None:
    """Where the way leads among the bodies, which stay in the cell; None if it is not allowed."""
    cell.restore(start)
    try:
        cell.place_obstacles(bodies)
    except RodDiverged:
        return None
    placed = cell.save()
    if any(tasks.advance(cell, step, config) for step in around.steps):
        return None
    goal = goals.Goal(cell.rod_state.positions.copy(), cell.boundary)
    fits = goals.far_enough(cell, placed, config)
    cell.restore(placed)
    return goal if fits else None
