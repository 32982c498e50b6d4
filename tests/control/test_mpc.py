"""The MPC against its reference, its limits, its failures, and closed on the true rod."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from control.casadi_surrogate import casadi_step
from control.models import RodModel, SurrogateModel
from control.mpc import ShapeMPC
from control.mpc_reference import solve_with_ipopt
from control.problem import MpcConfig, ShapeProblem, step_directions
from control.safety import SafetyGate, SafetyLimits
from dlo_gym.exceptions import SolverFailed
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState, ShapeEstimate
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.weights_file import SHIPPED, load_weights

ROD = RodProperties(length=0.5)
LIMITS = SafetyLimits(min_gripper_distance=0.12, workspace=((-0.4, -0.25, 0.2), (0.4, 0.25, 0.6)))
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def held(left=(-0.2, 0.0, 0.34), right=(0.2, 0.0, 0.34), tilt=(0, 0, 0)) -> BoundaryPoses:
    return BoundaryPoses(
        pose(ALONG_X @ exp_so3(tilt), left), pose(ALONG_X @ exp_so3(np.negative(tilt)), right)
    )


def estimate_of(centerline: np.ndarray) -> ShapeEstimate:
    n = len(centerline)
    return ShapeEstimate(centerline.copy(), np.zeros((0, n), dtype=bool), np.ones(n))


class SmoothPredictor:
    """A small random network that moves the ends as the clamps move: a model for tests only."""

    def __init__(self, seed: int = 0, n_nodes: int = 7, bias: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.n_nodes = n_nodes
        share = np.linspace(0.0, 1.0, n_nodes)[:, None, None]
        left = np.concatenate([np.eye(3), 0.03 * rng.normal(size=(3, 3))], axis=1)
        right = np.concatenate([np.eye(3), 0.03 * rng.normal(size=(3, 3))], axis=1)
        linear = np.concatenate([(1 - share) * left, share * right], axis=2)
        self.linear = linear.reshape(3 * n_nodes, 12)
        self.state = rng.normal(size=(12, 3 * n_nodes))
        self.action = rng.normal(size=(12, 12))
        self.out = 5e-3 * rng.normal(size=(3 * n_nodes, 12))
        self.bias = bias * rng.normal(size=3 * n_nodes)

    def for_rod(self, properties):
        return self

    def predict(self, centerline, displacement, boundary=None):
        return self.predict_with_tangents(
            centerline, displacement, np.zeros((self.n_nodes, 3, 0)), np.zeros((12, 0))
        )[0]

    def predict_with_tangents(self, centerline, displacement, d_centerline, d_displacement):
        x, u = centerline.ravel(), displacement.vector
        dx = d_centerline.reshape(3 * self.n_nodes, -1)
        at_zero, hidden = np.tanh(self.state @ x), np.tanh(self.state @ x + self.action @ u)
        y = x + self.linear @ u + self.out @ (hidden - at_zero) + self.bias
        d_input = self.state @ dx
        d_hidden = (1 - hidden**2)[:, None] * (d_input + self.action @ d_displacement)
        d_hidden -= (1 - at_zero**2)[:, None] * d_input
        dy = dx + self.linear @ d_displacement + self.out @ d_hidden
        return y.reshape(-1, 3), dy.reshape(self.n_nodes, 3, -1)

    def casadi_step(self) -> ca.Function:
        x, u = ca.MX.sym("x", 3 * self.n_nodes), ca.MX.sym("u", 12)
        state, action = ca.DM(self.state), ca.DM(self.action)
        hidden = ca.tanh(state @ x + action @ u) - ca.tanh(state @ x)
        y = x + ca.DM(self.linear) @ u + ca.DM(self.out) @ hidden + ca.DM(self.bias)
        return ca.Function("step", [x, u], [y])


def small_problem(
    goal_shift=(0.01, 0.02, 0.015), *, limits=LIMITS, boundary=None, config=None, seed=0
) -> tuple[ShapeProblem, SmoothPredictor]:
    rng = np.random.default_rng(seed)
    predictor = SmoothPredictor(seed)
    boundary = boundary or held(tilt=(0.1, -0.05, 0.0))
    n = predictor.n_nodes
    line = np.linspace(boundary.left[:3, 3], boundary.right[:3, 3], n)
    line[:, 2] -= 0.1 * np.sin(np.linspace(0, np.pi, n))
    problem = ShapeProblem(
        centerline=line,
        boundary=boundary,
        goal=line + np.asarray(goal_shift) + 0.001 * rng.normal(size=(n, 3)),
        node_weights=np.ones(n),
        disturbance=1e-4 * rng.normal(size=(n, 3)),
        previous=0.3 * rng.normal(size=10),
        limits=limits,
        config=config or MpcConfig(horizon=3),
    )
    return problem, predictor


@pytest.mark.parametrize("model", ["network", "rod", "rod, one end free", "rod in the plane"])
def test_rollout_derivatives_match_finite_differences(model):
    rng = np.random.default_rng(3)
    planar = model == "rod in the plane"
    boundary = held(tilt=(0.2, 0.0 if planar else 0.1, 0.0))
    if model == "rod, one end free":
        boundary = BoundaryPoses(boundary.left)
    if model == "network":
        problem, predictor = small_problem()
        used, centerline = SurrogateModel(predictor), problem.centerline
    else:
        used = RodModel(20)
        rod = CosseratRod(ROD, 20)
        centerline = rod.settle(boundary).positions + 1e-3 * rng.normal(size=(21, 3))
    used.reset(boundary, ROD)
    directions = step_directions(boundary, LIMITS, planar)
    plan = rng.uniform(-1, 1, (3, directions.shape[1]))
    disturbance = 1e-3 * rng.normal(size=centerline.shape)

    def shapes(z):
        return used.linearise(centerline, boundary, z, directions, disturbance).shapes

    jacobians = used.linearise(centerline, boundary, plan, directions, disturbance).jacobians
    for _ in range(4):
        direction = rng.normal(size=plan.shape)
        h = 1e-4
        numeric = (shapes(plan + h * direction) - shapes(plan - h * direction)) / (2 * h)
        analytic = (jacobians @ direction.ravel()).reshape(numeric.shape)
        assert_allclose(analytic, numeric, atol=3e-6 * np.abs(numeric).max())


@pytest.mark.parametrize(
    "case", ["free", "far", "at the wall", "stretched", "close", "already overstretched"]
)
def test_converged_iterations_agree_with_ipopt(case):
    boundary, shift, limits = held(tilt=(0.1, -0.05, 0.0)), (0.01, 0.02, 0.015), LIMITS
    if case == "far":
        shift = (0.05, 0.1, 0.1)
    elif case == "at the wall":
        limits = replace(LIMITS, workspace=((-0.205, -0.01, 0.3), (0.203, 0.005, 0.345)))
    elif case == "stretched":
        boundary, shift = held((-0.24, 0, 0.34), (0.24, 0, 0.34)), (0.0, 0.0, 0.0)
    elif case == "close":
        boundary = held((-0.065, 0, 0.34), (0.065, 0, 0.34))
    elif case == "already overstretched":
        boundary = held((-0.248, 0, 0.34), (0.248, 0, 0.34))
    problem, predictor = small_problem(shift, limits=limits, boundary=boundary)
    if case == "stretched":
        spread = np.linspace(-0.03, 0.03, predictor.n_nodes)
        problem = replace(problem, goal=problem.goal + np.outer(spread, [1.0, 0.5, 0.0]))
    elif case == "close":
        spread = np.linspace(0.03, -0.03, predictor.n_nodes)
        problem = replace(problem, goal=problem.goal + np.outer(spread, [1.0, 0.5, 0.0]))
    start = np.zeros((3, 10))
    mpc = ShapeMPC(SurrogateModel(predictor), limits, problem.config)
    fast = mpc.solve(problem, start, iterations=30)
    exact = solve_with_ipopt(problem, predictor.casadi_step(), start)
    assert fast.cost == pytest.approx(exact.cost, rel=1e-5)
    assert exact.cost == pytest.approx(problem.cost(exact.decisions, exact.shapes), rel=1e-9)
    assert_allclose(fast.shapes, exact.shapes, atol=2e-5)


def test_the_cost_is_what_the_weights_say():
    config = MpcConfig(
        horizon=2,
        error_scale=0.1,
        terminal_weight=3.0,
        translation_weight=0.5,
        rotation_weight=0.25,
        change_weight=0.125,
    )
    problem, _ = small_problem(config=config)
    n = len(problem.goal)
    problem = replace(problem, node_weights=np.linspace(0.5, 1.5, n))
    rng = np.random.default_rng(0)
    plan, shapes = rng.uniform(-1, 1, (2, 10)), problem.goal + 0.01 * rng.normal(size=(2, n, 3))
    expected, before = 0.0, problem.previous
    for step, shape, weight in zip(plan, shapes, (1.0, 3.0), strict=True):
        squared = np.square(np.linalg.norm(shape - problem.goal, axis=1) / 0.1)
        expected += weight * np.mean(problem.node_weights * squared)
        for first in (0, 5):
            expected += 0.5 * np.square(step[first : first + 3]).sum()
            expected += 0.25 * np.square(step[first + 3 : first + 5]).sum()
        expected += 0.125 * np.square(step - before).sum()
        before = step
    assert problem.cost(plan, shapes) == pytest.approx(expected, rel=1e-12)


def test_every_solution_starts_from_the_last_plan_one_step_on(monkeypatch):
    mpc = ShapeMPC(SurrogateModel(SmoothPredictor(0)), LIMITS)
    starts, plans = [], []

    def solve(problem, start):
        starts.append(start.copy())
        plans.append(ShapeMPC.solve(mpc, problem, start))
        return plans[-1]

    monkeypatch.setattr(mpc, "solve", solve)
    boundary = held()
    centerline = np.linspace(boundary.left[:3, 3], boundary.right[:3, 3], 7)
    goal = centerline + np.array([0.0, 0.05, 0.02])
    mpc.reset(goal, boundary, ROD)
    for _ in range(2):
        mpc.control(estimate_of(centerline), boundary, goal)
    assert not starts[0].any()
    assert_allclose(starts[1][:-1], plans[0].decisions[1:])
    assert_allclose(starts[1][-1], plans[0].decisions[-1])
    assert np.abs(plans[0].decisions[1:] - plans[0].decisions[:-1]).max() > 1e-3


def test_one_iteration_is_nearly_converged():
    problem, predictor = small_problem()
    mpc = ShapeMPC(SurrogateModel(predictor), LIMITS, problem.config)
    start = np.zeros((3, 10))
    once, often = mpc.solve(problem, start, 1), mpc.solve(problem, start, 30)
    plan = once.decisions
    true_shapes = mpc.model.linearise(
        problem.centerline, problem.boundary, plan, problem.directions, problem.disturbance
    ).shapes
    assert problem.cost(plan, true_shapes) == pytest.approx(often.cost, rel=0.02)


@pytest.mark.parametrize("qp_solver", ["osqp", "qpoases"])
def test_qp_solvers_agree(qp_solver):
    problem, predictor = small_problem()
    start = np.zeros((3, 10))
    model = SurrogateModel(predictor)
    daqp = ShapeMPC(model, LIMITS, problem.config).solve(problem, start, 5)
    config = replace(problem.config, qp_solver=qp_solver)
    other = ShapeMPC(model, LIMITS, config).solve(problem, start, 5)
    assert other.cost == pytest.approx(daqp.cost, rel=1e-3)


def goal_and_start(seed: int) -> tuple[CosseratRod, RodState, np.ndarray]:
    """A settled rod and a goal at least 60 mm away (mean), reached by another path."""
    rng = np.random.default_rng(seed)
    while True:
        rod = CosseratRod(ROD)
        start = rod.settle(held(tilt=rng.uniform(-0.15, 0.15, 3)))
        boundary = start.boundary
        for _ in range(3):
            target = held(
                np.array([-0.2, 0.0, 0.36]) + rng.uniform(-0.12, 0.12, 3),
                np.array([0.2, 0.0, 0.36]) + rng.uniform(-0.12, 0.12, 3),
                (*rng.uniform(-0.7, 0.7, 2), 0.0),
            )
            if not 0.16 < target.distance < 0.46:
                continue
            motion = boundary.displacement_to(target).scaled(0.1)
            for _ in range(10):
                boundary = rod.move(motion).boundary
        goal = rod.state.positions
        if np.linalg.norm(goal - start.positions, axis=1).mean() > 0.06:
            rod.restore(start)
            return rod, start, goal


def close_the_loop(seed: int, mpc: ShapeMPC, n_steps: int, noise: float = 0.0) -> np.ndarray:
    """Mean node error [m] to the goal after every step."""
    rng = np.random.default_rng(seed)
    rod, state, goal = goal_and_start(seed)
    gate = SafetyGate(mpc.limits)
    mpc.reset(goal, state.boundary, ROD)
    errors = []
    for _ in range(n_steps):
        seen = state.positions + noise * rng.normal(size=goal.shape)
        command = mpc.control(estimate_of(seen), state.boundary, goal)
        assert mpc.diagnostics.ok
        decision = gate.check(command, state.boundary)
        # The distances are linear in the QP, so only there may the gate have to cut a little.
        assert set(decision.reasons) <= {"overstretch", "gripper distance"}
        state = rod.move(decision.displacement)
        errors.append(np.linalg.norm(state.positions - goal, axis=1).mean())
    return np.array(errors)


@pytest.fixture(scope="module")
def surrogate() -> SurrogateModel:
    return SurrogateModel(ShapePredictor.load(properties=ROD))


def test_the_surrogate_is_told_of_the_rod():
    stiff = replace(ROD, youngs_modulus=1e7)
    model = SurrogateModel(ShapePredictor.load())
    _, state, _ = goal_and_start(0)
    displacement = BoundaryDisplacement.from_vector(np.full(12, 0.01))
    predicted = []
    for rod in (ROD, stiff):
        model.reset(state.boundary, rod)
        shape = model.step(state.positions, state.boundary, displacement)
        expected = ShapePredictor.load(properties=rod).predict(state.positions, displacement)
        assert_allclose(shape, expected, atol=1e-12)
        predicted.append(shape)
    assert np.abs(predicted[0] - predicted[1]).max() > 1e-4


@pytest.mark.parametrize("seed", range(2))
def test_closed_loop_on_the_true_rod(seed):
    errors = close_the_loop(seed, ShapeMPC(RodModel(), LIMITS), 30)
    assert errors[-1] < 1e-3


@pytest.mark.parametrize("seed", range(2, 5))
def test_closed_loop_on_the_surrogate(seed, surrogate):
    errors = close_the_loop(seed, ShapeMPC(surrogate, LIMITS), 30)
    assert errors[-1] < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("model", ["rod", "surrogate"])
def test_closed_loop_reaches_every_goal(model, surrogate):
    used = RodModel() if model == "rod" else surrogate
    final = [close_the_loop(seed, ShapeMPC(used, LIMITS), 60)[-1] for seed in range(30)]
    assert np.max(final) < 2e-3


def test_closed_loop_with_noisy_estimates_and_a_wrong_rod():
    class OtherRod(RodModel):
        def reset(self, boundary, properties):
            super().reset(boundary, replace(properties, youngs_modulus=3e6))

    errors = close_the_loop(1, ShapeMPC(OtherRod(), LIMITS), 60, noise=1e-3)
    assert errors[-5:].mean() < 2e-3


def test_the_disturbance_estimate_finds_the_models_bias():
    truth, model = SmoothPredictor(seed=1), SmoothPredictor(seed=1, bias=1e-3)
    problem, _ = small_problem(seed=1)
    mpc = ShapeMPC(SurrogateModel(model), LIMITS)
    mpc.reset(problem.goal, problem.boundary, ROD)
    centerline, boundary = problem.centerline, problem.boundary
    for _ in range(60):
        move = mpc.control(estimate_of(centerline), boundary, problem.goal)
        centerline = truth.predict(centerline, move)
        boundary = boundary.displaced(move)
    assert_allclose(mpc.disturbance.ravel(), -model.bias, atol=1e-5)


def test_no_solution_holds_still_and_says_so():
    problem, predictor = small_problem()

    class Broken(SurrogateModel):
        works = False

        def linearise(self, centerline, boundary, plan, directions, disturbance):
            rollout = super().linearise(centerline, boundary, plan, directions, disturbance)
            return rollout if self.works else rollout._replace(jacobians=rollout.jacobians * np.nan)

    model = Broken(predictor)
    mpc = ShapeMPC(model, LIMITS, MpcConfig(max_failures=3))
    mpc.reset(problem.goal, problem.boundary, ROD)
    estimate = estimate_of(problem.centerline)
    for _ in range(2):
        command = mpc.control(estimate, problem.boundary, problem.goal)
        assert not command.vector.any()
        assert mpc.diagnostics.status.startswith("SolverFailed")
    model.works = True
    assert mpc.control(estimate, problem.boundary, problem.goal).vector.any()
    assert mpc.diagnostics.ok
    model.works = False
    for _ in range(2):
        mpc.control(estimate, problem.boundary, problem.goal)
    with pytest.raises(SolverFailed, match="3 control steps in a row"):
        mpc.control(estimate, problem.boundary, problem.goal)


def test_an_estimate_that_is_not_finite_holds_still():
    problem, predictor = small_problem()
    mpc = ShapeMPC(SurrogateModel(predictor), LIMITS)
    mpc.reset(problem.goal, problem.boundary, ROD)
    broken = problem.centerline.copy()
    broken[2] = np.nan
    command = mpc.control(estimate_of(broken), problem.boundary, problem.goal)
    assert not command.vector.any()
    assert "not finite" in mpc.diagnostics.status


@pytest.mark.parametrize(("planar", "m"), [(False, 5), (True, 3)])
@pytest.mark.parametrize("n_clamps", [1, 2])
def test_no_decision_breaks_a_step_limit_and_the_largest_touch_it(planar, m, n_clamps):
    boundary = BoundaryPoses(*held(tilt=(0.4, 0.2, 0.1)).clamps[:n_clamps])
    directions = step_directions(boundary, LIMITS, planar)
    assert directions.shape == (6 * n_clamps, m * n_clamps)
    for corner in np.random.default_rng(0).choice([-1.0, 1.0], (20, m * n_clamps)):
        command = BoundaryDisplacement.from_vector(directions @ corner)
        assert SafetyGate(LIMITS).check(command, boundary).reasons == ()
        sizes = np.linalg.norm(command.vector.reshape(-1, 2, 3), axis=2)
        assert_allclose(sizes, [[LIMITS.translation_step, LIMITS.rotation_step]] * n_clamps)


def test_another_number_of_clamps_is_refused():
    one = BoundaryPoses(held().left)
    goal = CosseratRod(ROD).settle(one).positions
    with pytest.raises(ValueError, match=r"boundary: expected 2 clamps, .*n_clamps .* got 1"):
        ShapeMPC(RodModel(), LIMITS).reset(goal, one, ROD)
    settings = MpcConfig(n_clamps=1)
    with pytest.raises(ValueError, match=r"boundary: expected 1 clamps, .*n_clamps .* got 2"):
        ShapeMPC(RodModel(), LIMITS, settings).reset(goal, held(), ROD)
    with pytest.raises(ValueError, match="model: the surrogate knows rods held at both ends"):
        ShapeMPC(SurrogateModel(ShapePredictor.load()), LIMITS, settings).reset(goal, one, ROD)


def test_one_gripper_stops_at_the_wall():
    """The goal's clamp lies 50 mm behind it; tilted at the wall, the rod reaches further."""
    limits = replace(LIMITS, workspace=((-0.4, -0.25, 0.56), (-0.17, 0.25, 0.75)))
    rod, start = CosseratRod(ROD), BoundaryPoses(pose(ALONG_X, [-0.2, 0.0, 0.62]))
    estimate = rod.settle(start).positions
    goal = estimate + np.array([0.08, 0.03, 0.0])
    mpc = ShapeMPC(RodModel(), limits, MpcConfig(n_clamps=1))
    mpc.reset(goal, start, ROD)
    for _ in range(20):
        boundary = rod.state.boundary
        rod.move(mpc.control(estimate_of(rod.state.positions), boundary, goal))
        assert mpc.diagnostics.ok
    assert_allclose(rod.state.boundary.left[0, 3], -0.17, atol=1e-5)
    error = np.linalg.norm(rod.state.positions - goal, axis=1).mean()
    assert 0.03 < error < 0.046


def test_impossible_goals_are_refused():
    problem, predictor = small_problem()
    mpc = ShapeMPC(SurrogateModel(predictor), LIMITS)
    with pytest.raises(ValueError, match="overstretched"):
        mpc.reset(problem.goal * [2.0, 1.0, 1.0], problem.boundary, ROD)
    with pytest.raises(ValueError, match=r"goal: expected .* \(7, 3\)"):
        mpc.reset(problem.goal[:5], problem.boundary, ROD)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("n_clamps", 3),
        ("horizon", 0),
        ("error_scale", 0.0),
        ("damping", -1.0),
        ("qp_solver", "nothing"),
    ],
)
def test_senseless_settings_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        MpcConfig(**{field: value})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_shipped_surrogate_agrees_with_ipopt(surrogate, seed):
    _, state, goal = goal_and_start(seed)
    n = len(goal)
    problem = ShapeProblem(
        centerline=state.positions,
        boundary=state.boundary,
        goal=state.positions + 0.12 * (goal - state.positions),
        node_weights=np.ones(n),
        disturbance=np.zeros((n, 3)),
        previous=np.zeros(10),
        limits=LIMITS,
        config=MpcConfig(horizon=2),
    )
    start = np.zeros((2, 10))
    fast = ShapeMPC(surrogate, LIMITS, problem.config).solve(problem, start, iterations=40)
    exact = solve_with_ipopt(problem, casadi_step(load_weights(SHIPPED).for_rod(ROD)), start)
    assert fast.cost == pytest.approx(exact.cost, rel=1e-3)
