"""The environment over a simulated cell: spaces, motion, stops, recovery."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import dlo_gym
from dlo_gym.exceptions import DeviceError, SafetyStop
from dlo_gym.geometry.camera import View
from dlo_gym.rod.boundary import BoundaryDisplacement
from sim2real.config import CellConfig
from sim2real.robot_env import RobotShapeEnv
from tests.sim2real.simulated_cell import make_cell, opengl_missing, write_cell

if reason := opengl_missing():
    pytest.skip(reason, allow_module_level=True)

assert dlo_gym.__doc__  # registers the environment that the spaces are compared with


@pytest.fixture(scope="module")
def shared_env(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cell")
    config = CellConfig.load(write_cell(folder))
    t = np.linspace(0.0, 1.0, 51)
    goal = np.column_stack([-0.2 + 0.4 * t, 0.02 + 0 * t, 0.36 - 0.12 * np.sin(np.pi * t) ** 2])
    np.save(folder / "goal.npy", goal)
    env = RobotShapeEnv(
        config, str(folder / "goal.npy"), render_mode="rgb_array", robot_cell=make_cell(config)
    )
    yield env
    env.close()


@pytest.fixture
def env(shared_env):
    """The arms stand wherever the last test left them, ready again."""
    for arm in shared_env.cell.arms.values():
        arm.set_safety("normal")
    return shared_env


def numbers(observation):
    return observation["observation"][-18:].reshape(2, 3, 3)


def test_spaces_are_those_of_the_simulated_environment(env):
    with gym.make("dlo_gym/ShapeControlTracked-v0") as simulated:
        assert env.action_space == simulated.action_space
        assert env.observation_space == simulated.observation_space
        expected = simulated.unwrapped.clamp_action.scale
        assert env.clamp_action.scale == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_gymnasium_checker(env):
    # Two episodes on a cell in real time are never equal to the last bit, and the second starts
    # where the first left the arms; the registered environment says so in the same way. The checks
    # of rendering and closing would make further environments.
    env.spec = gym.envs.registration.EnvSpec(
        "RobotShapeControl-v0", entry_point=lambda: env, nondeterministic=True
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env, skip_render_check=True, skip_close_check=True)
    finally:
        env.spec = None


def test_steps_move_the_clamps_by_what_is_reported(env):
    before, _ = env.reset(seed=1)
    action = np.zeros(10, np.float32)
    action[[2, 7]] = 0.5
    total = np.zeros(12)
    for _ in range(4):
        observation, reward, terminated, truncated, info = env.step(action)
        assert not terminated, info["message"]
        assert not truncated
        total += info["displacement"]
        assert reward == pytest.approx(-10.0 * info["shape_error"], rel=1e-4)
    moved = numbers(observation)[:, 0] - numbers(before)[:, 0]
    assert total.reshape(2, 6)[:, :3] == pytest.approx(moved, abs=1e-5)
    assert moved[:, 2] == pytest.approx([0.02, 0.02], abs=2e-3)
    # Node 0 is at the commanded clamp, and the cable went along with it.
    ends = observation["achieved_goal"].reshape(-1, 3)[[0, -1]]
    assert ends == pytest.approx(numbers(observation)[:, 0], abs=2e-3)


def test_start_and_goal_as_told(env):
    env.reset(seed=2)
    start = env.cell.boundary.displaced(
        BoundaryDisplacement([-0.01, 0.02, 0.0, 0, 0, 0.1], [0.0, 0.02, 0.01, 0, 0, 0])
    )
    goal = env.goal + np.array([0.0, 0.0, 0.01])
    observation, info = env.reset(options={"start": start, "goal": goal})
    away = env.cell.boundary.displacement_to(start).vector.reshape(2, 2, 3)
    assert np.linalg.norm(away, axis=-1).max(axis=0) == pytest.approx([0, 0], abs=5e-3)
    assert observation["desired_goal"] == pytest.approx(goal.ravel().astype(np.float32))
    assert info["termination"] == ""


def test_start_out_of_reach_of_the_limits(env):
    env.reset(seed=2)
    apart = env.cell.boundary.displaced(
        BoundaryDisplacement([-0.05, 0, 0, 0, 0, 0], [0.06, 0, 0, 0, 0, 0])
    )
    with pytest.raises(ValueError, match="start: .*cannot get there.*overstretch"):
        env.reset(options={"start": apart})
    assert env.cell.boundary.distance < env.limits.max_gripper_distance + 1e-4


@pytest.mark.parametrize(
    "options",
    [
        {"place": 1},
        {"start": [0.0]},
        {"goal": np.zeros((3, 3))},
        {"goal": np.full((51, 3), np.nan)},
    ],
)
def test_wrong_options(env, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}"):
        env.reset(options=options)


@pytest.mark.slow
def test_sampled_goal_is_that_of_the_seed(env, monkeypatch):
    monkeypatch.setattr(env, "_goal_spec", "sampled")
    env.reset(seed=5)
    first = env.goal
    env.reset(seed=5)
    assert np.array_equal(env.goal, first)
    env.reset(seed=6)
    assert not np.array_equal(env.goal, first)


def test_protective_stop_ends_the_episode_and_reset_recovers(env):
    env.reset(seed=3)
    env.cell.arms["right"].set_safety("protective_stop")
    observation, reward, terminated, _, info = env.step(np.ones(10, np.float32))
    assert terminated
    assert info["termination"] == "safety_stop"
    assert "protective stop" in info["message"]
    assert reward < -env.config.termination_penalty
    assert env.observation_space.contains(observation)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(10, np.float32))
    with pytest.raises(SafetyStop, match="protective stop"):  # a person has to release it
        env.reset()
    env.cell.arms["right"].set_safety("normal")
    stood = env.cell.boundary
    env.reset(seed=3)
    assert not env.step(np.zeros(10, np.float32))[2]
    away = stood.displacement_to(env.cell.boundary).vector
    assert np.abs(away).max() < 1e-3  # no former target was taken up


def test_lost_link_ends_the_episode_and_both_arms_stand(env, monkeypatch):
    env.reset(seed=3)

    def gone():
        raise DeviceError("left arm: no data for 0.5 s")

    left, right = env.cell.arms["left"], env.cell.arms["right"]
    with monkeypatch.context() as patch:
        patch.setattr(left, "reading", gone)
        info = env.step(np.ones(10, np.float32))[-1]
    assert info["termination"] == "device_error"
    assert info["message"] == "left arm: no data for 0.5 s"
    assert not info["displacement"].any()
    assert np.abs(right.reading().tcp_speed).max() < 1e-3
    env.reset(seed=3)
    assert not env.step(np.zeros(10, np.float32))[2]


def test_dark_images_end_the_episode_as_track_lost(env, monkeypatch):
    env.reset(seed=3)
    wait_for_sample = env.cell.wait_for_sample

    def dark(**how):
        sample = wait_for_sample(**how)
        views = tuple(View(0 * view.image, view.camera, view.stamp) for view in sample.views)
        return sample._replace(views=views)

    monkeypatch.setattr(env.cell, "wait_for_sample", dark)
    for _ in range(60):
        terminated, _, info = env.step(np.zeros(10, np.float32))[2:]
        if terminated:
            break
    assert info["termination"] == "track_lost"


def test_success_and_sparse_reward(env):
    env.reset(seed=3)
    at_goal = env.estimate.centerline * [0.99, 1.0, 1.0]  # surely not overstretched
    _, info = env.reset(options={"goal": at_goal})
    assert info["success"]
    assert info["is_success"]
    far = np.add(at_goal, [0.0, 0.0, 0.05])
    _, info = env.reset(options={"goal": far})
    assert info["shape_error"] == pytest.approx(0.05, abs=3e-3)
    assert not info["success"]


def test_command_beyond_the_workspace_is_cut(env):
    env.reset(seed=3)
    low = env.limits.workspace[0][2]
    down = np.zeros(10, np.float32)
    down[[2, 7]] = -1.0
    start = env.cell.boundary.displaced(
        BoundaryDisplacement(*[[0, 0, low + 0.004 - env.cell.boundary.left[2, 3], 0, 0, 0]] * 2)
    )
    env.reset(options={"start": start})
    info = env.step(down)[-1]
    assert "workspace" in info["safety_cuts"]
    assert env.cell.commanded.left[2, 3] >= low - 1e-9


def test_render_draws_all_views(env):
    env.reset(seed=3)
    image = env.render()
    models = env.cell_config.camera_models
    assert image.shape == (models[0].height, sum(model.width for model in models), 3)
    assert np.ptp(image) > 100


def test_closed_environment_opens_again(env):
    env.reset(seed=3)
    env.close()
    with pytest.raises(DeviceError, match="not connected"):
        env.cell.readings()
    env.cell.arms["right"].set_safety("emergency_stop")
    with pytest.raises(SafetyStop, match="emergency stop"):
        env.reset(seed=3)
    env.cell.arms["right"].set_safety("normal")
    env.reset(seed=3)
    assert not env.step(np.zeros(10, np.float32))[2]


def test_wrong_arguments(env):
    with pytest.raises(ValueError, match="render_mode"):
        RobotShapeEnv(env.cell_config, render_mode="human")
    with pytest.raises(ValueError, match="reward"):
        RobotShapeEnv(env.cell_config, reward="none")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="speed"):
        RobotShapeEnv(env.cell_config, speed=2.0)
