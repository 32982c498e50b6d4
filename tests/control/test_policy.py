import json
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from control.policy import (
    N_CLAMPS,
    N_POINTS,
    Policy,
    PolicyController,
    feature_map,
    sample_points,
)
from dlo_gym.envs.actions import ClampAction
from dlo_gym.exceptions import WeightsError
from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import BoundaryPoses, RodProperties, ShapeEstimate

ACTION = ClampAction(0.01, 0.08)
ROD = RodProperties(length=0.5)
N_INPUTS = 6 * N_POINTS + N_CLAMPS
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
APART = BoundaryPoses(pose(ALONG_X, [-0.2, 0.0, 0.34]), pose(ALONG_X, [0.2, 0.0, 0.34]))


@pytest.fixture
def policy():
    rng = np.random.default_rng(0)
    sizes = [N_INPUTS, 8, 8, 10]
    weights = [rng.normal(size=(b, a)) / np.sqrt(a) for a, b in pairwise(sizes)]
    return Policy(weights, [rng.normal(size=b) for b in sizes[1:]], ACTION)


def estimate(centerline):
    return ShapeEstimate(centerline, np.zeros((0, len(centerline)), bool), np.ones(len(centerline)))


def line(n=51):
    return np.linspace([-0.2, 0.0, 0.34], [0.2, 0.0, 0.34], n)


def test_points_are_read_at_the_same_places_of_any_resolution():
    points = sample_points(line(51)).reshape(-1, 3)
    np.testing.assert_allclose(points[[0, 6, -1]], line()[[0, 25, 50]], atol=1e-12)
    np.testing.assert_allclose(sample_points(line(101)), sample_points(line(51)), atol=1e-12)
    assert sample_points(np.stack([line(), line()])).shape == (2, 3 * N_POINTS)


def test_features_vanish_at_the_goal_and_do_not_depend_on_the_place_of_the_shape():
    matrix, offset = feature_map()
    clamps = np.zeros(N_CLAMPS)
    points = sample_points(line())
    at_goal = matrix @ np.concatenate([points, points, clamps]) + offset
    np.testing.assert_allclose(at_goal[: 6 * N_POINTS + 6], 0.0, atol=1e-9)
    away = points + np.tile([0.3, -0.1, 0.05], N_POINTS)
    moved = matrix @ np.concatenate([away, away, clamps]) + offset
    np.testing.assert_allclose(moved, at_goal, atol=1e-9)


def test_the_network_is_a_relu_perceptron_with_tanh(policy):
    inputs = np.random.default_rng(1).normal(size=N_INPUTS)
    (w0, w1, w2), (b0, b1, b2) = policy.weights, policy.biases
    hidden = np.maximum(w1 @ np.maximum(w0 @ inputs + b0, 0) + b1, 0)
    np.testing.assert_allclose(policy(inputs), np.tanh(w2 @ hidden + b2))


def test_a_saved_policy_comes_back_unchanged(policy, tmp_path):
    policy.save(tmp_path / "policy.safetensors", steps="7")
    loaded = Policy.load(tmp_path / "policy.safetensors")
    assert loaded.action == policy.action
    inputs = np.random.default_rng(2).normal(size=N_INPUTS)
    np.testing.assert_array_equal(loaded(inputs), policy(inputs))
    assert [path.name for path in tmp_path.iterdir()] == ["policy.safetensors"]


def test_a_missing_or_damaged_policy_is_named(policy, tmp_path):
    path = tmp_path / "policy.safetensors"
    with pytest.raises(WeightsError, match=r"policy\.safetensors: no such file"):
        PolicyController(path)
    policy.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(WeightsError, match=r"policy\.safetensors: damaged"):
        PolicyController(path)
    save_file({"weight_0": np.zeros((2, 2))}, path)
    with pytest.raises(WeightsError, match="expected format"):
        PolicyController(path)


def test_layers_that_do_not_fit_or_are_not_finite_are_refused(policy, tmp_path):
    path = tmp_path / "policy.safetensors"
    Policy(policy.weights[1:], policy.biases[1:], ACTION).save(path)
    with pytest.raises(WeightsError, match="layers that fit each other"):
        Policy.load(path)
    policy.weights[1][0, 0] = np.nan
    policy.save(path)
    with pytest.raises(WeightsError, match="finite layers"):
        Policy.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda tensors, metadata: metadata.update(format="dlo-gym policy 7"),
            "got 'dlo-gym policy 7",
        ),
        (lambda tensors, metadata: metadata.pop("action"), "incomplete: KeyError"),
        (lambda tensors, metadata: tensors.pop("bias_0"), "incomplete: KeyError"),
        (
            lambda tensors, metadata: tensors.update(bias_1=np.zeros(())),
            "matrices and their biases",
        ),
        (
            lambda tensors, metadata: tensors.update(weight_1=np.zeros(8)),
            "matrices and their biases",
        ),
        (lambda _, metadata: set_action(metadata, wobble=0.1), "wobble"),
        (lambda _, metadata: set_action(metadata, n_clamps=3), "n_clamps: expected 1 or 2, got 3"),
        (lambda _, metadata: set_action(metadata, max_rotation_step=-1), "max_rotation_step"),
        (lambda _, metadata: set_action(metadata, n_clamps=1), "to 5 actions"),
    ],
)
def test_a_policy_of_another_version_is_named_with_what_differs(policy, tmp_path, change, message):
    path = tmp_path / "policy.safetensors"
    policy.save(path)
    with safe_open(path, "numpy") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(tensors, metadata)
    save_file(tensors, path, metadata)
    with pytest.raises(WeightsError, match=message) as raised:
        Policy.load(path)
    assert str(path) in str(raised.value)


def set_action(metadata, **changes):
    metadata["action"] = json.dumps(json.loads(metadata["action"]) | changes)


def test_a_policy_for_one_clamp_reads_nothing_of_the_other_and_refuses_two():
    action = ClampAction(0.01, 0.08, n_clamps=1)
    rng = np.random.default_rng(0)
    policy = Policy([rng.normal(size=(5, N_INPUTS))], [np.zeros(5)], action)
    controller = PolicyController(policy)
    alone = BoundaryPoses(APART.left)
    controller.reset(line(), alone, ROD)
    command = controller.control(estimate(line()), alone, line())
    assert command.right is None
    read = np.zeros(N_CLAMPS)
    read[:9] = np.concatenate([APART.left[:3, 3], APART.left[:3, 0], APART.left[:3, 2]])
    inputs = np.concatenate([sample_points(line()), sample_points(line()), read])
    np.testing.assert_allclose(
        action.to_action(command, alone), np.tanh(policy.weights[0] @ inputs), atol=1e-12
    )
    with pytest.raises(ValueError, match="policy: expected one for the 2 clamps .* moves 1"):
        controller.reset(line(), APART, ROD)


def test_the_controller_stays_within_the_step_limits(policy):
    controller = PolicyController(policy)
    goal = line() + np.array([0.0, 0.1, 0.0])
    for _ in range(2):
        displacement = controller.control(estimate(line()), APART, goal)
        for twist, clamp in ((displacement.left, APART.left), (displacement.right, APART.right)):
            assert np.abs(twist[:3]).max() <= ACTION.max_translation_step
            in_clamp = clamp[:3, :3].T @ twist[3:]
            assert np.abs(in_clamp[:2]).max() <= ACTION.max_rotation_step
            assert abs(in_clamp[2]) < 1e-12
    assert controller.diagnostics.ok


def test_running_a_policy_needs_no_torch():
    code = "import sys, control.policy; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
