"""Model predictive shape control by Gauss-Newton real-time iterations."""

from time import perf_counter

import casadi as ca
import numpy as np

from control.controller import ControlDiagnostics
from control.models import HorizonModel, Rollout
from control.problem import MpcConfig, Plan, ShapeProblem, step_directions
from control.safety import SafetyLimits
from dlo_gym.exceptions import DloError, SolverFailed
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate

# What overstretching costs when two iterations are compared [1/m].
OVERSTRETCH_PRICE = 1e4


class ShapeMPC:
    """Moves the grippers so that the rod takes a goal shape.

    At every control step the plan of the last one, shifted, is linearised on the model and one QP
    gives the correction (real-time iteration: Diehl, Bock, Schloeder 2005). The error between the
    model's one-step prediction and the observed shape is filtered per node and added to all
    predictions, which removes the model's bias.

    When there is no solution the arms hold still and ``diagnostics.status`` begins with
    ``"SolverFailed"``; after ``max_failures`` such steps in a row ``SolverFailed`` is raised.

    Args:
        model: what to plan on.
        limits: of the safety gate that the commands will pass.
        config: weights and horizon.
    """

    def __init__(
        self,
        model: HorizonModel,
        limits: SafetyLimits | None = None,
        config: MpcConfig | None = None,
    ) -> None:
        self.model = model
        self.limits = limits or SafetyLimits()
        self.config = config or MpcConfig()
        n, n_rows = self.config.horizon * self.config.n_decisions, self.config.n_constraints
        structure = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(n_rows, n)}
        quiet = {"osqp": {"osqp": {"verbose": False}}, "qpoases": {"printLevel": "none"}}
        options = {"error_on_fail": False, **quiet.get(self.config.qp_solver, {})}
        self._qp = ca.conic("qp", self.config.qp_solver, structure, options)
        self._forget()

    def _forget(self) -> None:
        self._plan = np.zeros((self.config.horizon, self.config.n_decisions))
        self._disturbance = np.zeros((self.model.n_nodes, 3))
        self._last: tuple[Array, BoundaryPoses] | None = None
        self._failures = 0
        self._diagnostics = ControlDiagnostics()

    @property
    def diagnostics(self) -> ControlDiagnostics:
        return self._diagnostics

    @property
    def disturbance(self) -> Array:
        """(n_nodes, 3) present estimate of the model's one-step bias [m]."""
        return self._disturbance.copy()

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        """Starts an episode.

        Raises:
            ValueError: if the goal has another number of nodes than the model, its ends are
                further apart than the rod is long, or another number of clamps holds the rod than
                the configuration says.
        """
        self._checked_goal(goal)
        self._check_clamps(boundary)
        span = float(np.linalg.norm(goal[-1] - goal[0]))
        if boundary.right is not None and not span < properties.length:
            raise ValueError(
                f"goal: overstretched: its ends are {span:.4f} m apart, the rod is"
                f" {properties.length:.4f} m long"
            )
        self.model.reset(boundary, properties)
        self._forget()

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        """The first step of the plan.

        Raises:
            SolverFailed: after ``max_failures`` steps in a row without a solution.
            ValueError: if goal or estimate have another number of nodes than the model, or another
                number of clamps holds the rod than the configuration says.
        """
        started = perf_counter()
        goal = self._checked_goal(goal)
        self._check_clamps(boundary)
        if estimate.centerline.shape != goal.shape:
            raise ValueError(
                f"estimate: expected a centerline of shape {goal.shape},"
                f" got {estimate.centerline.shape}"
            )
        try:
            if not np.isfinite(estimate.centerline).all():
                raise SolverFailed("the estimated centerline is not finite")
            problem = self._problem(estimate, boundary, goal)
            plan = self.solve(problem, self._plan)
        except (DloError, FloatingPointError, RuntimeError, ValueError) as error:
            return self._hold(error, started)
        self._failures = 0
        self._last = estimate.centerline, boundary
        self._plan = np.concatenate([plan.decisions[1:], plan.decisions[-1:]])
        error = np.linalg.norm(plan.shapes[-1] - goal, axis=1).mean()
        elapsed = {"control": 1e3 * (perf_counter() - started)}
        self._diagnostics = ControlDiagnostics("ok", plan.cost, float(error), elapsed)
        return BoundaryDisplacement.from_vector(problem.directions @ plan.decisions[0])

    def solve(self, problem: ShapeProblem, start: Array, iterations: int | None = None) -> Plan:
        """Gauss-Newton iterations on ``problem`` from the plan ``start`` (N, m).

        An iteration that has made the cost worse is undone and repeated with more damping
        (Levenberg-Marquardt). With one iteration there is nothing to compare, and no cost for it.

        Raises:
            SolverFailed: if a QP has no finite solution.
        """
        plan, damping = start, self.config.damping
        best: tuple[float, Array, Rollout] | None = None
        shapes = np.empty(0)
        for _ in range(iterations or self.config.iterations):
            rollout = self.model.linearise(
                problem.centerline,
                problem.boundary,
                plan,
                problem.directions,
                problem.disturbance,
            )
            cost = problem.cost(plan, rollout.shapes) + OVERSTRETCH_PRICE * problem.excess(plan)
            if best is None or cost <= best[0]:
                best, damping = (cost, plan, rollout), max(damping / 4.0, self.config.damping)
            else:
                damping = max(8.0 * damping, 1e-3 * best[0])
            _, base, rollout = best
            correction = self._solve_qp(problem, base, rollout, damping)
            plan = np.clip(base + correction, -1.0, 1.0)
            change = (rollout.jacobians @ correction.ravel()).reshape(rollout.shapes.shape)
            shapes = rollout.shapes + change
        return Plan(plan, shapes, problem.cost(plan, shapes))

    def _solve_qp(
        self, problem: ShapeProblem, plan: Array, rollout: Rollout, damping: float
    ) -> Array:
        """The correction (N, m) of ``plan``."""
        N, flat = len(plan), plan.ravel()
        weights = problem.shape_weights.reshape(-1)
        jacobian = rollout.jacobians.reshape(-1, flat.size)
        errors = (rollout.shapes - problem.goal).reshape(-1)
        weighted = jacobian * weights[:, None]
        regular = problem.decision_hessian
        hessian = 2.0 * jacobian.T @ weighted + regular
        hessian[np.diag_indices_from(hessian)] += damping
        gradient = 2.0 * weighted.T @ errors + regular @ flat + problem.decision_gradient
        rows = problem.constraints(plan)
        reached = rows.matrix @ flat
        # In steps, not metres: solvers' tolerances are meant for numbers of about 1.
        step = problem.limits.translation_step
        solution = self._qp(
            h=hessian,
            g=gradient,
            a=rows.matrix / step,
            lba=(rows.lower - reached) / step,
            uba=(rows.upper - reached) / step,
            lbx=-1.0 - flat,
            ubx=1.0 - flat,
        )
        correction = np.asarray(solution["x"]).reshape(N, -1)
        stats = self._qp.stats()
        # daqp reports success for NaN input, so the values themselves are looked at too.
        if not stats["success"] or not np.isfinite(correction).all():
            raise SolverFailed(f"{self.config.qp_solver}: {stats['unified_return_status']}")
        return correction

    def _problem(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> ShapeProblem:
        """This step's problem, after the disturbance estimate took in the last step's error."""
        floor = self.config.confidence_floor
        weights = floor + (1.0 - floor) * np.clip(estimate.confidence, 0.0, 1.0)
        previous = np.zeros(6 * self.config.n_clamps)
        if self._last is not None:
            last_centerline, last_boundary = self._last
            made = last_boundary.displacement_to(boundary)
            previous = made.vector
            if estimate.seen and self.config.disturbance_gain > 0.0:
                predicted = self.model.step(last_centerline, last_boundary, made)
                self._filter_disturbance(estimate.centerline - predicted, estimate.confidence)
        directions = step_directions(boundary, self.limits, self.config.planar)
        scales = np.square(directions).sum(axis=0)
        return ShapeProblem(
            centerline=estimate.centerline,
            boundary=boundary,
            goal=goal,
            node_weights=weights / weights.mean(),
            disturbance=self._disturbance,
            previous=np.clip(directions.T @ previous / scales, -1.0, 1.0),
            limits=self.limits,
            config=self.config,
        )

    def _filter_disturbance(self, error: Array, confidence: Array) -> None:
        size = np.linalg.norm(error, axis=1, keepdims=True)
        believed = error * np.minimum(1.0, self.config.max_disturbance / np.maximum(size, 1e-12))
        gain = self.config.disturbance_gain * np.clip(confidence, 0.0, 1.0)[:, None]
        self._disturbance = self._disturbance + gain * (believed - self._disturbance)

    def _hold(self, error: Exception, started: float) -> BoundaryDisplacement:
        self._failures += 1
        self._plan = np.zeros_like(self._plan)
        self._last = None
        status = f"SolverFailed: {error}"
        elapsed = {"control": 1e3 * (perf_counter() - started)}
        self._diagnostics = ControlDiagnostics(status, timings_ms=elapsed)
        if self._failures >= self.config.max_failures:
            raise SolverFailed(
                f"no solution in {self._failures} control steps in a row; the last: {error}"
            ) from error
        return BoundaryDisplacement.zero(self.config.n_clamps)

    def _check_clamps(self, boundary: BoundaryPoses) -> None:
        if len(boundary.clamps) != self.config.n_clamps:
            raise ValueError(
                f"boundary: expected {self.config.n_clamps} clamps, as the MPC's n_clamps says,"
                f" got {len(boundary.clamps)}"
            )

    def _checked_goal(self, goal: Array) -> Array:
        goal = np.asarray(goal, dtype=np.float64)
        if goal.shape != (self.model.n_nodes, 3) or not np.isfinite(goal).all():
            raise ValueError(
                f"goal: expected finite values of shape ({self.model.n_nodes}, 3),"
                f" got shape {goal.shape}"
            )
        return goal
