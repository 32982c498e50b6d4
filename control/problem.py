"""The optimal control problem that the shape MPC solves at every control step."""

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import NamedTuple

import casadi as ca
import numpy as np

from control.safety import SafetyLimits
from dlo_gym.envs.actions import ClampAction
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses


@dataclass(frozen=True)
class MpcConfig:
    """Settings of the shape MPC.

    Errors enter the cost as multiples of ``error_scale``, decisions as fractions of the largest
    step, so the weights have no unit.

    Attributes:
        n_clamps: grippers that move: 2, or 1 where the right end is free.
        planar: whether they stay in the plane of world x and z.
        horizon: N, number of control steps planned ahead.
        iterations: Gauss-Newton iterations per control step.
        error_scale: node error that costs 1 [m].
        terminal_weight: of the last shape's error, relative to each other one's.
        translation_weight, rotation_weight: of the squared decisions.
        change_weight: of the squared change of the decisions from step to step.
        damping: Levenberg term that keeps an iteration near its linearisation.
        confidence_floor: weight of a node nobody sees, relative to one that two views see.
        disturbance_gain: of the low-pass filter on the one-step prediction error, 0 to switch off.
        max_disturbance: largest prediction error per node that the filter believes [m].
        max_failures: control steps in a row without a solution after which ``SolverFailed`` is
            raised; up to then the arms hold still.
        qp_solver: a CasADi ``conic`` plugin.

    Raises:
        ValueError: naming the setting.
    """

    n_clamps: int = 2
    planar: bool = False
    horizon: int = 5
    iterations: int = 1
    error_scale: float = 0.01
    terminal_weight: float = 5.0
    translation_weight: float = 1e-3
    rotation_weight: float = 1e-3
    change_weight: float = 1e-2
    damping: float = 1e-3
    confidence_floor: float = 0.3
    disturbance_gain: float = 0.2
    max_disturbance: float = 0.005
    max_failures: int = 10
    qp_solver: str = "daqp"

    def __post_init__(self) -> None:
        if self.n_clamps not in (1, 2):
            raise ValueError(f"n_clamps: expected 1 or 2, got {self.n_clamps}")
        for name in ("horizon", "iterations", "max_failures"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        for name in ("error_scale", "max_disturbance"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in (
            "terminal_weight",
            "translation_weight",
            "rotation_weight",
            "change_weight",
            "damping",
        ):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name}: expected zero or more, got {getattr(self, name)}")
        for name in ("confidence_floor", "disturbance_gain"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected between 0 and 1, got {getattr(self, name)}")
        if not ca.has_conic(self.qp_solver):
            raise ValueError(
                f"qp_solver: this CasADi has no conic plugin {self.qp_solver!r};"
                " daqp, osqp and qpoases come with its wheels"
            )

    @property
    def action(self) -> ClampAction:
        """What is decided of one step, in fractions of the largest."""
        return ClampAction(1.0, 1.0, planar=self.planar, n_clamps=self.n_clamps)

    @property
    def n_decisions(self) -> int:
        """m, the decisions of one step."""
        return self.action.size

    @property
    def n_constraints(self) -> int:
        """Rows of ``LinearConstraints``."""
        return self.horizon * (3 * self.n_clamps + (1 if self.n_clamps == 2 else 0))


class LinearConstraints(NamedTuple):
    """``lower <= matrix @ decisions <= upper`` on the flat plan (N m,)."""

    matrix: Array
    lower: Array
    upper: Array


@dataclass(frozen=True, eq=False)
class ShapeProblem:
    """One control step's optimal control problem.

    The plan (N, m) holds each step's decisions in [-1, 1]: fractions of the largest step along
    each axis of an action box inside ``limits``; m is 10, with one of k = 2 clamps free 5, in the
    plane 6 or 3. Rotation axes are the clamps' d1 and d2 at the beginning of the plan.

    Attributes:
        centerline: (n_nodes, 3) present shape [m].
        boundary: present clamp poses.
        goal: (n_nodes, 3) [m].
        node_weights: (n_nodes,), mean 1.
        disturbance: (n_nodes, 3) added to the model's prediction at every step [m].
        previous: (m,) decisions of the last step that was made.
        limits: of the safety gate.
        config: weights and horizon.
    """

    centerline: Array
    boundary: BoundaryPoses
    goal: Array
    node_weights: Array
    disturbance: Array
    previous: Array
    limits: SafetyLimits
    config: MpcConfig

    @property
    def directions(self) -> Array:
        """(6 k, m) displacement [m, rad] of each decision."""
        return step_directions(self.boundary, self.limits, self.config.planar)

    @property
    def shape_weights(self) -> Array:
        """(N, 3 n_nodes) weight of each squared coordinate error [1/m^2]."""
        config = self.config
        per_step = np.ones(config.horizon)
        per_step[-1] = config.terminal_weight
        per_node = self.node_weights / (len(self.node_weights) * config.error_scale**2)
        return np.outer(per_step, np.repeat(per_node, 3))

    @property
    def decision_hessian(self) -> Array:
        """(N m, N m) Hessian of the terms in step size and change of step."""
        config, N, action = self.config, self.config.horizon, self.config.action
        size = np.repeat(
            [config.translation_weight, config.rotation_weight],
            [len(action.translation_axes), action.n_rotations],
        )
        differences = np.kron(np.eye(N) - np.eye(N, k=-1), np.eye(action.size))
        return 2.0 * (
            np.diag(np.tile(size, N * action.n_clamps))
            + config.change_weight * differences.T @ differences
        )

    @property
    def decision_gradient(self) -> Array:
        """(N m,) gradient of the same terms at a zero plan."""
        m = self.config.n_decisions
        gradient = np.zeros(self.config.horizon * m)
        gradient[:m] = -2.0 * self.config.change_weight * self.previous
        return gradient

    def cost(self, plan: Array, shapes: Array) -> float:
        """Of ``plan`` (N, m), which leads through ``shapes`` (N, n_nodes, 3) [m]."""
        flat = plan.ravel()
        errors = (shapes - self.goal).reshape(len(plan), -1)
        decisions = 0.5 * flat @ self.decision_hessian @ flat + self.decision_gradient @ flat
        offset = self.config.change_weight * self.previous @ self.previous
        return float((self.shape_weights * errors**2).sum() + decisions + offset)

    def clamp_origins(self) -> Array:
        """(k, 3) present origins of the clamps [m]."""
        return self.boundary.clamps[:, :3, 3]

    def origin_map(self) -> Array:
        """(N, k, 3, N m) linear map from the flat plan to the clamps' motions by each step [m]."""
        N = self.config.horizon
        directions = self.directions
        k, m = len(directions) // 6, directions.shape[1]
        translations = directions.reshape(k, 2, 3, m)[:, 0]
        steps = np.tril(np.ones((N, N)))
        return np.einsum("nj,gam->ngajm", steps, translations).reshape(N, k, 3, -1)

    def gaps(self, plan: Array) -> Array:
        """(N, 3) from the left to the right clamp's origin after each step of ``plan`` [m]."""
        origins, moves = self.clamp_origins(), self.origin_map()
        return origins[1] - origins[0] + (moves[:, 1] - moves[:, 0]) @ plan.ravel()

    def excess(self, plan: Array) -> float:
        """By how much ``plan`` overstretches, summed over its steps [m].

        The linear constraints miss it where a plan turns a taut rod.
        """
        if self.boundary.right is None:
            return 0.0
        longest = max(self.limits.max_gripper_distance, self.boundary.distance)
        return float(np.maximum(np.linalg.norm(self.gaps(plan), axis=1) - longest, 0.0).sum())

    def constraints(self, plan: Array) -> LinearConstraints:
        """Workspace, overstretch and gripper distance, linearised at ``plan`` (N, m).

        A limit that is broken at present is widened to what it is, so that a zero plan always
        satisfies every row. The distance rows are linear along the axis between the clamps.
        """
        limits, origins = self.limits, self.clamp_origins()
        moves = self.origin_map()
        lower, upper = np.asarray(limits.workspace)
        N = len(moves)
        box_lower = np.tile((np.minimum(lower, origins) - origins).ravel(), N)
        box_upper = np.tile((np.maximum(upper, origins) - origins).ravel(), N)
        box = LinearConstraints(moves.reshape(len(box_lower), -1), box_lower, box_upper)
        if self.boundary.right is None:
            return box
        gap = origins[1] - origins[0]
        gap_moves = moves[:, 1] - moves[:, 0]
        gaps = self.gaps(plan)
        axes = gaps / np.maximum(np.linalg.norm(gaps, axis=1, keepdims=True), 1e-9)
        present = axes @ gap
        longest = max(limits.max_gripper_distance, float(np.linalg.norm(gap)))
        shortest = np.minimum(limits.min_gripper_distance, present)
        return LinearConstraints(
            np.concatenate([box.matrix, np.einsum("ka,kam->km", axes, gap_moves)]),
            np.concatenate([box.lower, shortest - present]),
            np.concatenate([box.upper, longest - present]),
        )


class Plan(NamedTuple):
    """A solution: decisions (N, m), the linear model's shapes (N, n_nodes, 3) and their cost."""

    decisions: Array
    shapes: Array
    cost: float


def step_directions(boundary: BoundaryPoses, limits: SafetyLimits, planar: bool = False) -> Array:
    """(6 k, m) displacement [m, rad], world axes, of a decision of 1 in each direction.

    Per gripper those of ``ClampAction``: dx, dy, dz and rotations about d1 and d2; if ``planar``
    dx, dz and the rotation about d1. The box of decisions in [-1, 1] touches the limits' balls with
    its corners, so no decision breaks a step limit.
    """
    clamps = boundary.clamps
    axes, turns = (2.0, 1.0) if planar else (3.0, 2.0)
    action = ClampAction(
        limits.translation_step / sqrt(axes),
        limits.rotation_step / sqrt(turns),
        planar=planar,
        n_clamps=len(clamps),
    )
    return action.to_twists(np.eye(action.size), clamps).reshape(action.size, -1).T
