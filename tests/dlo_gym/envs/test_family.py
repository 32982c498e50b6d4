import warnings

import gymnasium as gym
import numpy as np
import pytest

import dlo_gym
from dlo_gym.envs import goals, tasks
from dlo_gym.exceptions import RenderingUnavailable

TASKS = list(dlo_gym.SHAPE_TASKS)


def make(task, **options):
    return gym.make(f"dlo_gym/ShapeControl{task}-v0", **options)


@pytest.fixture(scope="module")
def opengl():
    env = make("", render_mode="rgb_array", image_scale=0.1)
    env.reset(seed=0)
    try:
        env.render()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    finally:
        env.close()


@pytest.mark.parametrize("task", TASKS[1:])
def test_both_checkers_find_nothing(task, opengl, gym_check):
    gym_check(f"dlo_gym/ShapeControl{task}-v0", image_scale=0.1)
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make(task).unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("observed", ["Tracked", "Images"])
def test_both_checkers_find_nothing_in_what_sees_images(task, observed, opengl, gym_check):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    options = {"image_scale": 0.1} if observed == "Images" else {}
    gym_check(f"dlo_gym/ShapeControl{task}{observed}-v0", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make(task + observed, **options).unwrapped)


@pytest.mark.parametrize("task", TASKS)
def test_one_seed_gives_one_episode(task):
    first, second = make(task), make(task)
    second.reset(seed=8)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, *first.action_space.shape))
    runs = []
    for env in (first, second):
        observation, _ = env.reset(seed=3)
        later = [env.step(action)[0]["observation"] for action in actions]
        runs.append([observation["desired_goal"], *later])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("task", TASKS)
def test_starts_and_goals_are_as_far_apart_as_the_task_says(task):
    env = make(task)
    low, high = env.unwrapped.config.goal_distance
    for seed in range(3):
        _, info = env.reset(seed=seed)
        assert low <= info["shape_error"] <= high


def test_the_straight_way_to_a_hard_goal_ends_in_a_collision():
    env = make("Hard").unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        cell, config = env.cell, env.config
        start = cell.save()
        goal = goals.sample_goal(cell, np.random.default_rng(seed), config)
        motion = cell.boundary.displacement_to(goal.boundary)
        twists = np.abs(motion.vector.reshape(2, 6)).max(axis=0)
        n_steps = int(np.ceil(max(twists[:3].max() / 0.01, twists[3:].max() / np.deg2rad(4.5))))
        step = motion.scaled(1.0 / n_steps)
        reasons = []
        for _ in range(n_steps):
            reasons.append(tasks.advance(cell, step, config))
            if reasons[-1]:
                break
        assert reasons[-1] in ("collision", "unreachable")
        cell.restore(start)


def test_the_planar_task_stays_in_its_plane():
    env = make("Planar").unwrapped
    assert env.action_space.shape == (6,)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(10):
        observation, _, terminated, _, info = env.step(rng.uniform(-1, 1, 6))
        points = observation["achieved_goal"].reshape(-1, 3)
        np.testing.assert_allclose(points[:, 1], 0.0, atol=1e-9)
        np.testing.assert_allclose(info["displacement"][[1, 3, 5, 7, 9, 11]], 0.0, atol=1e-12)
        assert not terminated
    np.testing.assert_allclose(env.goal[:, 1], 0.0, atol=1e-9)
    down = env.action_to_displacement([0, -1.0, 0.5, 0, 0, 0])
    assert down.left[2] == pytest.approx(-0.01)
    np.testing.assert_allclose(down.left[3:], [0, np.deg2rad(2.25), 0], atol=1e-9)


def test_one_arm_holds_a_rod_whose_other_end_hangs_free():
    env = make("OneArm").unwrapped
    assert env.action_space.shape == (5,)
    observation, info = env.reset(seed=0)
    assert observation["observation"].shape == (171,)
    np.testing.assert_array_equal(observation["observation"][-9:], 0.0)
    np.testing.assert_array_equal(info["wrench_right"], 0.0)
    weight = env.config.properties.linear_density * 0.5 * 9.81
    assert info["wrench_left"][2] == pytest.approx(weight, rel=0.02)
    tip = observation["achieved_goal"][-3:]
    later, *_, info = env.step(np.r_[1.0, np.zeros(4)])
    assert later["achieved_goal"][-3] - tip[0] == pytest.approx(0.01, abs=1e-5)
    np.testing.assert_allclose(info["displacement"], np.eye(12)[0] * 0.01, atol=1e-12)


def test_one_arm_is_tracked_with_the_rod_as_predictor(opengl):
    env = make("OneArmTracked", image_scale=1 / 3)
    env.reset(seed=7)
    errors = []
    for _ in range(12):
        *_, info = env.step(np.array([0.5, 0.5, 1.0, 0.5, -0.5], np.float32))
        errors.append(info["tracking_ptp3d"])
    assert max(errors) < 2e-3
    env.close()
    network = make("OneArmTracked", observer_options={"predictor": "network"})
    with pytest.raises(ValueError, match="predictor: expected rod .* free, got network"):
        network.reset(seed=7)
    network.close()


def test_one_arm_takes_one_clamp_and_a_free_goal():
    env = make("OneArm").unwrapped
    env.reset(seed=1)
    start, goal = env.cell.boundary, env.cell.rod_state.positions
    _, info = env.reset(seed=1, options={"start": start, "goal": goal})
    assert info["success"]
    two = make("").unwrapped
    two.reset(seed=1)
    with pytest.raises(ValueError, match="start: expected BoundaryPoses of one clamp"):
        env.reset(options={"start": two.cell.boundary})


@pytest.mark.parametrize("task", ["Planar", "OneArm"])
def test_a_vector_of_them_is_each_of_them(task):
    envs = gym.make_vec(f"dlo_gym/ShapeControl{task}-v0", 2)
    single = make(task)
    observations, _ = envs.reset(seed=[5, 6])
    own, _ = single.reset(seed=6)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, *envs.action_space.shape))
    for action in actions:
        np.testing.assert_array_equal(observations["observation"][1], own["observation"])
        observations, *_, infos = envs.step(action)
        own, *_, info = single.step(action[1])
        np.testing.assert_array_equal(infos["displacement"][1], info["displacement"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"straight_way": "winding"}, "straight_way: expected one of any, blocked"),
        ({"straight_way": "blocked", "check_arms": False}, "straight_way"),
        ({"straight_way": "blocked", "free_end": True}, "straight_way"),
        ({"planar": True, "axial_rotation": True}, "axial_rotation"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        make("", **options)
