"""Servo, MPC and gate on every task of the family: two arms, one arm, the vertical plane."""

import json

import numpy as np
import pytest

import dlo_gym
from control.evaluate import (
    control,
    default_model,
    gate_for,
    make_controller,
    make_env,
    run_episode,
)
from control.policy import N_CLAMPS, N_POINTS, Policy
from dlo_gym.envs.actions import ClampAction
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.rod.boundary import BoundaryDisplacement

ONE_ARM = "dlo_gym/ShapeControlOneArm-v0"


@pytest.fixture(scope="module", params=["Planar", "OneArm"])
def env(request):
    made = make_env(f"dlo_gym/ShapeControl{request.param}-v0")
    yield made
    made.close()


@pytest.mark.parametrize("controller", ["servo", "mpc"])
def test_the_goal_is_reached_through_the_gate(env, controller):
    config = env.unwrapped.config
    gate = gate_for(config)
    driver = make_controller(controller, gate.limits, config)
    for seed in (0, 1):
        *_, last = run_episode(env, driver, gate, seed=seed, max_steps=30)
        assert last.success
        assert last.termination == ""
        assert last.shape_error < 1e-3


def test_obstacles_bar_the_straight_way_and_can_be_gone_over():
    env = make_env("dlo_gym/ShapeControlObstacle-v0")
    config = env.unwrapped.config
    gate = gate_for(config)
    for seed in (0, 1):
        *_, straight = run_episode(
            env, make_controller("servo", gate.limits, config), gate, seed=seed, max_steps=80
        )
        *_, over = run_episode(
            env, make_controller("over", gate.limits, config), gate, seed=seed, max_steps=80
        )
        assert over.success
        assert not straight.success
    env.close()


def test_where_clamps_may_turn_about_the_rod_the_mpc_stays_within_the_action_box():
    env = make_env("dlo_gym/ShapeControl-v0", axial_rotation=True)
    inner = env.unwrapped
    gate = gate_for(inner.config)
    driver = make_controller("mpc", gate.limits, inner.config)
    env.reset(seed=3)
    driver.reset(inner.goal, inner.cell.boundary, inner.cell.properties)
    command = driver.control(inner.estimate, inner.cell.boundary, inner.goal)
    made = inner.action_to_displacement(inner.displacement_to_action(command)).vector
    np.testing.assert_allclose(made, command.vector, atol=1e-8)
    turns = np.linalg.norm(command.vector.reshape(4, 3)[1::2], axis=1)
    assert turns.max() > 0.9 * inner.config.max_rotation_step  # a step that could have been cut


@pytest.mark.parametrize("model", ["surrogate", "rod"])
def test_in_the_plane_the_mpc_asks_for_nothing_that_leaves_it(model):
    env = make_env("dlo_gym/ShapeControlPlanar-v0")
    inner = env.unwrapped
    gate = gate_for(inner.config)
    driver = make_controller("mpc", gate.limits, inner.config, model=model)
    env.reset(seed=3)
    driver.reset(inner.goal, inner.cell.boundary, inner.cell.properties)
    for _ in range(5):
        boundary = inner.cell.boundary
        command = driver.control(inner.estimate, boundary, inner.goal)
        np.testing.assert_allclose(command.vector[[1, 3, 5, 7, 9, 11]], 0.0, atol=1e-12)
        assert np.abs(command.vector).max() > 1e-4
        action = inner.displacement_to_action(command)
        made = inner.action_to_displacement(action).vector
        np.testing.assert_allclose(made, command.vector, atol=1e-8)  # nothing was cut
        env.step(action)
    env.close()


@pytest.mark.parametrize("task", dlo_gym.SHAPE_TASKS)
def test_the_gate_just_holds_the_largest_actions_of_the_task(task):
    env = make_env(f"dlo_gym/ShapeControl{task}-v0").unwrapped
    env.reset(seed=0)
    gate = gate_for(env.config)
    for size, cut in ((1.0, False), (1.01, True)):
        for corner in np.random.default_rng(0).choice([-1.0, 1.0], (5, env.action_space.shape[0])):
            vector = size * env.action_to_displacement(corner).vector
            gate.reset()
            decision = gate.check(BoundaryDisplacement.from_vector(vector), env.cell.boundary)
            assert ({"translation step", "rotation step"} <= set(decision.reasons)) == cut
    env.close()


def test_one_arm_is_planned_on_the_rod(tmp_path):
    control(env=ONE_ARM, episodes=1, max_steps=3, out=tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["model"] == "rod"
    assert metrics["episodes"][0]["held_still"] == 0
    assert default_model(ShapeEnvConfig()) == "surrogate"


def test_what_the_surrogate_does_not_know_is_refused(tmp_path):
    with pytest.raises(ValueError, match="model: expected rod .* free, got surrogate"):
        control(env=ONE_ARM, model="surrogate", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    coarse = ShapeEnvConfig(n_elements=20)
    with pytest.raises(ValueError, match="model: expected rod .* n_elements 20, got surrogate"):
        make_controller("mpc", gate_for(coarse).limits, coarse)
    with pytest.raises(ValueError, match="model: expected surrogate or rod, got 'oracle'"):
        make_controller("mpc", gate_for(coarse).limits, coarse, model="oracle")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"controller": "servo", "model": "rod"}, "model: the servo controller takes none"),
        ({"controller": "rl", "model": "rod"}, "model: the rl controller takes none"),
        ({"controller": "servo", "policy": "p"}, "policy: the servo controller takes none"),
        ({"env": "dlo_gym/RobotShapeControl-v0"}, "env: cannot make .*RobotShapeControl"),
        (
            {"env": "dlo_gym/WrapBar-v0"},
            "env: expected .* goal is a shape, got a WrapBar",
        ),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        control(**options, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("task", "moves", "message"),
    [
        ("OneArm", {}, "n_clamps 1, .* got 2"),
        ("", {"n_clamps": 1}, "n_clamps 2, .* got 1"),
        ("Planar", {}, "planar True, .* got False"),
        ("", {"planar": True}, "planar False, .* got True"),
    ],
)
def test_a_policy_for_other_grippers_is_refused(tmp_path, task, moves, message):
    action = ClampAction(0.01, 0.08, **moves)
    n_inputs = 6 * N_POINTS + N_CLAMPS
    policy = Policy([np.zeros((action.size, n_inputs))], [np.zeros(action.size)], action)
    policy.save(tmp_path / "policy.safetensors")
    with pytest.raises(ValueError, match=rf"policy\.safetensors: expected one with {message}"):
        control(
            controller="rl",
            env=f"dlo_gym/ShapeControl{task}-v0",
            policy=tmp_path / "policy.safetensors",
            out=tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()
