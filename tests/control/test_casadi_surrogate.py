"""The CasADi network is the NumPy network, in value and derivative."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from control.casadi_surrogate import casadi_step
from control.models import SurrogateModel
from control.mpc import ShapeMPC
from control.mpc_reference import solve_with_ipopt
from control.problem import MpcConfig, ShapeProblem
from control.safety import SafetyLimits
from dlo_gym.geometry.se3 import exp_so3, frame_along, pose
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.weights_file import SHIPPED, Layers, Scales, Weights, load_weights

N_NODES = 11


def random_weights(seed: int = 0, n_nodes: int = N_NODES, hidden: int = 16) -> Weights:
    rng = np.random.default_rng(seed)

    def block(*sizes: int) -> list:
        return [
            (
                (rng.normal(size=(b, a)) * np.sqrt(2.0 / a)).astype(np.float32),
                (0.3 * rng.normal(size=b)).astype(np.float32),
            )
            for a, b in pairwise(sizes)
        ]

    size, half = 3 * n_nodes, hidden // 2
    # A guess that carries the nodes along with the nearer clamp, as a trained one does.
    share = np.linspace(1.0, 0.0, n_nodes)
    guess = np.zeros((14, n_nodes, 3))
    for axis in range(3):
        guess[axis, :, axis], guess[7 + axis, :, axis] = share, 1.0 - share
    layers = Layers(
        block(size, hidden, hidden, hidden),
        block(7, half, half),
        block(2 * hidden, hidden, hidden, hidden, size),
        (guess.reshape(14, size) + 0.05 * rng.normal(size=(14, size))).astype(np.float32),
    )
    layers.prediction[-1][0][:] *= 0.1
    return Weights(layers, Scales(), {})


def random_arc(rng: np.random.Generator, n_nodes: int = N_NODES) -> np.ndarray:
    s = np.linspace(0.0, 1.0, n_nodes)
    line = np.column_stack([0.4 * (s - 0.5), 0.05 * np.sin(2 * s), 0.34 - 0.1 * np.sin(np.pi * s)])
    return line @ exp_so3(rng.uniform(-1, 1, 3)).T + 0.002 * rng.normal(size=line.shape)


@pytest.fixture(scope="module", params=["relu", "silu"])
def weights(request) -> Weights:
    return random_weights()._replace(activation=request.param)


def test_value_is_the_predictors(weights):
    rng = np.random.default_rng(1)
    predictor, step = ShapePredictor(weights), casadi_step(weights)
    for scale in (0.0, 1e-6, 1.0, 10.0):
        line = random_arc(rng)
        move = scale * rng.uniform(-1, 1, 12) * np.tile([0.01, 0.01, 0.01, 0.08, 0.08, 0.08], 2)
        expected = predictor.predict(line, BoundaryDisplacement.from_vector(move))
        got = np.asarray(step(line.ravel(), move)).reshape(-1, 3)
        # The predictor's network runs in float32.
        assert_allclose(got, expected, atol=2e-7 * max(1.0, scale))


def test_derivatives_are_the_predictors(weights):
    rng = np.random.default_rng(2)
    predictor, jacobian = ShapePredictor(weights), casadi_step(weights).jacobian()
    for scale in (0.0, 1.0):
        line = random_arc(rng)
        move = scale * rng.uniform(-1, 1, 12) * np.tile([0.01, 0.01, 0.01, 0.08, 0.08, 0.08], 2)
        d_line, d_move = rng.normal(size=(N_NODES, 3, 5)), rng.normal(size=(12, 5))
        _, expected = predictor.predict_with_tangents(
            line, BoundaryDisplacement.from_vector(move), d_line, d_move
        )
        by_line, by_move = jacobian(line.ravel(), move, np.zeros(3 * N_NODES))
        got = by_line @ d_line.reshape(-1, 5) + by_move @ d_move
        assert_allclose(np.asarray(got), expected.reshape(-1, 5), atol=2e-5)


def test_value_of_the_shipped_weights():
    rng = np.random.default_rng(4)
    rod = RodProperties(0.4, youngs_modulus=3e6)
    predictor = ShapePredictor.load(properties=rod)
    step = casadi_step(load_weights(SHIPPED).for_rod(rod))
    line = random_arc(rng, predictor.n_nodes)
    move = rng.uniform(-1, 1, 12) * np.tile([0.01, 0.01, 0.01, 0.08, 0.08, 0.08], 2)
    expected = predictor.predict(line, BoundaryDisplacement.from_vector(move))
    got = np.asarray(step(line.ravel(), move)).reshape(-1, 3)
    assert_allclose(got, expected, atol=1e-6)


def test_weights_for_many_rods_are_refused():
    with pytest.raises(ValueError, match="for_rod"):
        casadi_step(load_weights(SHIPPED))


def test_ends_above_each_other_are_no_trouble(weights):
    line = np.zeros((N_NODES, 3))
    line[:, 2] = np.linspace(0.2, 0.5, N_NODES)
    move = np.full(12, 0.004)
    expected = ShapePredictor(weights).predict(line, BoundaryDisplacement.from_vector(move))
    got = np.asarray(casadi_step(weights)(line.ravel(), move)).reshape(-1, 3)
    assert_allclose(got, expected, atol=2e-7)


@pytest.mark.parametrize("seed", range(3, 6))
def test_the_mpc_on_the_network_agrees_with_ipopt(seed):
    rng = np.random.default_rng(seed)
    weights = random_weights(seed)._replace(activation="silu")  # IPOPT may stall on ReLU's kinks
    predictor = ShapePredictor(weights)
    line = random_arc(rng)
    boundary = BoundaryPoses(
        pose(frame_along(line[1] - line[0], [0, 1, 0]), line[0]),
        pose(frame_along(line[-1] - line[-2], [0, 1, 0]), line[-1]),
    )
    problem = ShapeProblem(
        centerline=line,
        boundary=boundary,
        goal=line + np.array([0.004, -0.003, 0.005]),
        node_weights=np.ones(N_NODES),
        disturbance=np.zeros_like(line),
        previous=np.zeros(10),
        limits=SafetyLimits(),
        config=MpcConfig(horizon=2, translation_weight=1e-2, rotation_weight=1e-2),
    )
    mpc = ShapeMPC(SurrogateModel(predictor), problem.limits, problem.config)
    start = np.zeros((2, 10))
    fast = mpc.solve(problem, start, iterations=40)
    exact = solve_with_ipopt(problem, casadi_step(weights), start)
    assert fast.cost == pytest.approx(exact.cost, rel=1e-5)
