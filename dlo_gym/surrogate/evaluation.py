"""Scores of a shape predictor on rollouts it has not seen (Section VI-A2)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from rich.table import Table

from dlo_gym.geometry.se3 import Array, pose, quaternion_to_matrix
from dlo_gym.metrics import ptp_3d
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.surrogate.simulation import Rollouts

Predict = Callable[[Array, BoundaryDisplacement], Array]
PredictFor = Callable[[RodProperties], Predict]


@dataclass(frozen=True)
class Score:
    """Errors over all moves of some number of steps, PTP3D averaged over the nodes.

    Attributes:
        n_steps: of 5 mm and pi / 80 rad at most per component, as rollouts have them; 0 for the
            null action.
        n_moves: that were predicted.
        mean_mm, p95_mm: over the moves [mm].
        max_node_mm: of any node in any move [mm].
        motion_mm: how far the nodes truly moved, mean [mm].
    """

    n_steps: int
    n_moves: int
    mean_mm: float
    p95_mm: float
    max_node_mm: float
    motion_mm: float


class RecordedMove(NamedTuple):
    """Centerlines (n, 3) before and after [m], and the clamps' displacement between."""

    before: Array
    displacement: BoundaryDisplacement
    after: Array


def evaluate_predictor(
    predict_for: PredictFor,
    rollouts: Rollouts,
    *,
    n_steps: tuple[int, ...] = (0, 1, 2, 3),
    stride: int = 1,
    noise: float = 0.0,
    seed: int = 0,
) -> list[Score]:
    """Scores for moves of each of ``n_steps``, from every ``stride``-th state of the rollouts.

    Args:
        predict_for: from a rod's properties, its ``predict``: the centerline (n, 3) after a
            displacement.
        noise: standard deviation added to the coordinates that ``predict`` is given [m]; the error
            is then that of the predicted change.
        seed: of the noise.

    Raises:
        ValueError: naming the argument, if no rollout has a move so long.
    """
    n_states = rollouts.positions.shape[1]
    if not n_steps or not 0 <= min(n_steps) <= max(n_steps) < n_states:
        raise ValueError(f"n_steps: expected 0 to {n_states - 1} each, got {n_steps}")
    if stride < 1:
        raise ValueError(f"stride: expected at least 1, got {stride}")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"noise: expected 0 or a positive length [m], got {noise}")
    rng = np.random.default_rng(seed)
    predictors = [predict_for(rollouts.properties(i)) for i in range(len(rollouts.rods))]
    scores = []
    for steps in n_steps:
        errors, motions = [], []
        for i, predict in enumerate(predictors):
            for move in recorded_moves(rollouts, i, steps, stride):
                offset = noise * rng.standard_normal(move.before.shape)
                predicted = predict(move.before + offset, move.displacement) - offset
                errors.append(ptp_3d(predicted, move.after))
                motions.append(ptp_3d(move.before, move.after))
        error = 1e3 * np.array(errors)
        mean = error.mean(axis=1)
        scores.append(
            Score(
                steps,
                len(error),
                float(mean.mean()),
                float(np.percentile(mean, 95)),
                float(error.max()),
                float(1e3 * np.mean(motions)),
            )
        )
    return scores


def recorded_moves(
    rollouts: Rollouts, index: int, steps: int, stride: int = 1
) -> Iterator[RecordedMove]:
    """The moves of ``steps`` in one rollout, from every ``stride``-th state."""
    states, clamps = rollouts.positions[index].astype(np.float64), rollouts.clamps[index]
    for first in range(0, len(states) - steps, stride):
        last = first + steps
        start, end = boundary(states[first], clamps[first]), boundary(states[last], clamps[last])
        yield RecordedMove(states[first], start.displacement_to(end), states[last])


def boundary(positions: Array, clamps: Array) -> BoundaryPoses:
    """Clamp poses of one recorded state: positions (n, 3), quaternions wxyz (2, 4)."""
    rotations = quaternion_to_matrix(clamps)
    return BoundaryPoses(pose(rotations[0], positions[0]), pose(rotations[1], positions[-1]))


def score_table(scores: list[Score]) -> Table:
    """For the terminal."""
    table = Table("steps", "moves", "mean", "p95", "worst node", "motion", title="PTP3D in mm")
    for s in scores:
        values = (s.mean_mm, s.p95_mm, s.max_node_mm, s.motion_mm)
        table.add_row(str(s.n_steps), str(s.n_moves), *(f"{value:.3f}" for value in values))
    return table
