import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest

import dlo_gym  # noqa: F401
from dlo_gym.envs import tasks
from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.envs.shape_env import ShapeControlEnv
from dlo_gym.exceptions import RenderingUnavailable, TrackLost
from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses
from dlo_gym.scene import renderer

STATE_ID, TRACKED_ID = "dlo_gym/ShapeControl-v0", "dlo_gym/ShapeControlTracked-v0"
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def env():
    env = gym.make(STATE_ID)
    yield env
    env.close()


@pytest.fixture(scope="module")
def opengl():
    env = gym.make(STATE_ID, render_mode="rgb_array", image_scale=0.1)
    env.reset(seed=0)
    try:
        env.render()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    finally:
        env.close()


class BlindObserver:
    """Sees the start and nothing after it."""

    def reset(self, cell):
        from dlo_gym.envs.observers import PrivilegedObserver

        return PrivilegedObserver().reset(cell)

    def update(self, cell, displacement):
        raise TrackLost("nothing was seen")

    def close(self):
        pass


def rollout(env, seed, n_steps):
    rng = np.random.default_rng(5)
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, info)]
    for _ in range(n_steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        steps.append((observation, reward, terminated, info))
    return steps


def assert_equal_rollouts(first, second):
    for (o1, r1, d1, i1), (o2, r2, d2, i2) in zip(first, second, strict=True):
        assert r1 == r2
        assert d1 == d2
        for key in o1:
            np.testing.assert_array_equal(o1[key], o2[key])
        for key in i1:
            np.testing.assert_array_equal(i1[key], i2[key])


@pytest.mark.parametrize("options", [{}, {"reward": "sparse", "axial_rotation": True}])
def test_gymnasiums_checker_finds_nothing(options, opengl, gym_check):
    gym_check(STATE_ID, image_scale=0.1, **options)


@pytest.mark.parametrize("options", [{}, {"reward": "sparse", "axial_rotation": True}])
def test_stable_baselines_checker_finds_nothing(options):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gym.make(STATE_ID, **options).unwrapped)


@pytest.mark.slow
def test_both_checkers_find_nothing_in_the_tracked_environment(opengl, gym_check):
    gym_check(TRACKED_ID)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker = pytest.importorskip("stable_baselines3.common.env_checker")
        checker.check_env(gym.make(TRACKED_ID).unwrapped)


def test_importing_the_package_stays_light():
    code = (
        "import sys, dlo_gym;"
        "heavy = {'mujoco', 'numba', 'cv2', 'torch', 'casadi', 'tracking', 'control'};"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_two_environments_with_one_seed_agree_exactly(env):
    other = gym.make(STATE_ID)
    rollout(other, 1, 3)
    assert_equal_rollouts(rollout(env, 42, 12), rollout(other, 42, 12))


def test_different_seeds_differ(env):
    first, _ = env.reset(seed=1)
    second, _ = env.reset(seed=2)
    assert (first["desired_goal"] != second["desired_goal"]).any()
    assert (first["achieved_goal"] != second["achieved_goal"]).any()


def test_the_random_generator_can_be_copied_and_pickled(env):
    env.reset(seed=3)
    rng = env.unwrapped.np_random
    twin, thawed = copy.deepcopy(rng), pickle.loads(pickle.dumps(rng))
    expected = rng.random(4)
    np.testing.assert_array_equal(twin.random(4), expected)
    np.testing.assert_array_equal(thawed.random(4), expected)


def test_observation_and_info_tell_one_story(env):
    observation, info = env.reset(seed=4)
    inner = env.unwrapped
    centerline = inner.estimate.centerline
    np.testing.assert_allclose(observation["achieved_goal"].reshape(-1, 3), centerline, atol=1e-6)
    np.testing.assert_allclose(observation["desired_goal"].reshape(-1, 3), inner.goal, atol=1e-6)
    np.testing.assert_array_equal(observation["observation"][:153], observation["achieved_goal"])
    left = inner.cell.boundary.left
    np.testing.assert_allclose(
        observation["observation"][153:162], [*left[:3, 3], *left[:3, 0], *left[:3, 2]], atol=1e-6
    )
    assert info["shape_error"] == tasks.shape_error(centerline, inner.goal)
    assert info["tracking_ptp3d"] == 0.0
    weight = inner.config.properties.linear_density * 0.5 * 9.81
    assert info["wrench_left"][2] + info["wrench_right"][2] == pytest.approx(weight, rel=0.05)


def test_the_goal_is_a_success_and_holding_still_there_keeps_it(env):
    env.reset(seed=5)
    inner = env.unwrapped
    centerline = inner.cell.rod_state.positions
    start = inner.cell.boundary
    _, info = env.reset(seed=5, options={"start": start, "goal": centerline})
    assert info["success"]
    assert info["is_success"]
    _, reward, _, _, info = env.step(np.zeros(10))
    assert info["success"]
    assert reward == pytest.approx(0.0, abs=1e-4)


def test_reward_is_that_of_compute_reward_exactly(env):
    for observation, reward, _, info in rollout(env, 6, 5)[1:]:
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        assert reward == env.unwrapped.compute_reward(achieved, desired, info)
        batch = env.unwrapped.compute_reward(
            np.stack([achieved] * 3), np.stack([desired] * 3), np.array([info] * 3)
        )
        assert batch.shape == (3,)
        assert batch[0] == reward


def test_an_overstretching_action_ends_the_episode_by_name(env):
    apart = BoundaryPoses(pose(ALONG_X, [-0.242, 0, 0.34]), pose(ALONG_X, [0.242, 0, 0.34]))
    observation, _ = env.reset(seed=7)
    observation, _ = env.reset(
        seed=7, options={"start": apart, "goal": observation["desired_goal"].reshape(-1, 3)}
    )
    before = env.unwrapped.cell.rod_state
    action = np.array([-1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0])
    after, reward, terminated, truncated, info = env.step(action)
    assert terminated
    assert not truncated
    assert info["termination"] == "overstretch"
    np.testing.assert_array_equal(info["displacement"], np.zeros(12))
    assert env.unwrapped.cell.rod_state is before
    np.testing.assert_array_equal(after["achieved_goal"], observation["achieved_goal"])
    assert reward < -env.unwrapped.config.termination_penalty


def test_a_lost_track_ends_the_episode_by_name(monkeypatch):
    monkeypatch.setattr("dlo_gym.envs.observers.BlindObserver", BlindObserver, raising=False)
    monkeypatch.setattr(SimulatedCell, "visibility", lambda cell: np.ones((2, 51), dtype=bool))
    env = gym.make(STATE_ID, observer="dlo_gym.envs.observers:BlindObserver")
    env.reset(seed=0)
    _, _, terminated, _, info = env.step(np.ones(10))
    assert terminated
    assert info["termination"] == "track_lost"
    assert info["tracking_ptp3d"] > 1e-3


def test_time_runs_out_as_truncation():
    env = gym.make(STATE_ID, max_episode_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.zeros(10))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_actions_are_scaled_to_the_step_limits(env):
    env.reset(seed=8)
    before = env.unwrapped.cell.boundary
    env.step(np.array([0, 0, 0.5, 0, 0, 0, 0, 5.0, 0, 0]))
    after = env.unwrapped.cell.boundary
    np.testing.assert_allclose(after.left[:3, 3] - before.left[:3, 3], [0, 0, 0.005], atol=1e-12)
    np.testing.assert_allclose(after.right[:3, 3] - before.right[:3, 3], [0, 0, 0.01], atol=1e-12)


def test_displacements_become_actions_and_back(env):
    env.reset(seed=9)
    inner = env.unwrapped
    action = inner.action_space.sample()
    displacement = inner.action_to_displacement(action)
    np.testing.assert_allclose(inner.displacement_to_action(displacement), action, atol=1e-6)
    held = inner.displacement_to_action(BoundaryDisplacement.zero())
    np.testing.assert_array_equal(held, np.zeros(10))


@pytest.mark.parametrize("action", [np.full(10, np.nan), np.zeros(12), np.zeros((2, 5))])
def test_illegal_actions_are_refused_and_change_nothing(env, action):
    env.reset(seed=10)
    before = env.unwrapped.cell.rod_state
    with pytest.raises(ValueError, match="action: expected 10 numbers"):
        env.unwrapped.step(action)
    assert env.unwrapped.cell.rod_state is before


def test_unknown_options_are_refused_with_the_valid_ones(env):
    with pytest.raises(ValueError, match="unknown environment option 'gaol_moves'.*goal_moves"):
        gym.make(STATE_ID, gaol_moves=4)
    with pytest.raises(ValueError, match="unknown reset option 'goals'.*start, goal"):
        env.reset(options={"goals": None})
    with pytest.raises(ValueError, match="render_mode.*rgb_array.*'ansi'"):
        ShapeControlEnv(render_mode="ansi")
    with pytest.raises(ValueError, match=r"goal: expected a finite centerline of shape \(51, 3\)"):
        env.reset(options={"goal": np.zeros((10, 3))})
    with pytest.raises(ValueError, match="start: expected BoundaryPoses of two clamps"):
        env.reset(options={"start": np.eye(4)})


@pytest.mark.parametrize(
    "goal",
    [
        np.linspace([-0.4, 0.0, 0.3], [0.4, 0.0, 0.3], 51),
        np.tile([[0.0, 0.0, 0.3], [0.1, 0.0, 0.3], [0.2, 0.0, 0.3]], (17, 1)),
    ],
    ids=["ends too far apart", "too long in between"],
)
def test_an_overstretched_goal_is_refused_with_both_lengths(env, goal):
    with pytest.raises(ValueError, match=r"goal: overstretched.* a rod of 0\.5000 m"):
        env.reset(options={"goal": goal})


def test_an_overstretched_start_is_refused(env):
    apart = BoundaryPoses(pose(ALONG_X, [-0.3, 0, 0.34]), pose(ALONG_X, [0.3, 0, 0.34]))
    with pytest.raises(ValueError, match="0.6000 m apart, the rod is 0.5000 m long"):
        env.reset(options={"start": apart})


def test_using_the_environment_before_reset_is_refused():
    env = gym.make(STATE_ID).unwrapped
    for use in (lambda: env.step(np.zeros(10)), lambda: env.estimate, lambda: env.goal):
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            use()


def test_the_state_environment_builds_no_renderer(monkeypatch):
    def refuse(*arguments):
        raise AssertionError("a renderer was built")

    monkeypatch.setattr(renderer.SceneRenderer, "__init__", refuse)
    env = gym.make(STATE_ID)
    rollout(env, 0, 2)


def test_images_are_observed_on_request(opengl):
    env = gym.make(STATE_ID, observation_mode="images", image_scale=0.1)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["image_side"].shape == observation["image_top"].shape == (108, 192, 3)
    later, *_, info = env.step(np.ones(10, dtype=np.float32))
    assert (later["image_side"] != observation["image_side"]).any()
    assert 0.0 <= info["occlusion_ratio"] <= 1.0
    env.close()


def test_rendering_shows_both_views_with_the_goal_drawn_in(opengl):
    env = gym.make(STATE_ID, render_mode="rgb_array", image_scale=0.2)
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (216, 768, 3)
    plain = np.hstack([view.image for view in env.unwrapped.cell.views()])
    drawn = (image != plain).any(axis=-1)
    for index, camera in enumerate(env.unwrapped.cell.cameras):
        pixels = np.rint(camera.project(env.unwrapped.goal)).astype(int)
        pixels = pixels[camera.sees(pixels)]
        assert drawn[pixels[:, 1], pixels[:, 0] + 384 * index].mean() > 0.9
    env.close()
    env.close()


def test_the_tracked_environment_follows_the_rod(opengl):
    env = gym.make(TRACKED_ID, n_occluders=1)
    errors = [info["tracking_ptp3d"] for *_, info in rollout(env, 1, 8)]
    assert max(errors) < 3e-3
    assert min(errors) > 0.0
    env.close()


def test_the_tracker_does_as_well_on_the_rasterisers_images(opengl):
    means = {}
    for name in ("opengl", "raster"):
        env = gym.make(TRACKED_ID, n_occluders=1, image_scale=1 / 3, renderer=name)
        steps = rollout(env, 1, 15)
        means[name] = np.mean([info["tracking_ptp3d"] for *_, info in steps[1:]])
        env.close()
    assert 1e-5 < means["raster"] < 1.25 * means["opengl"] + 1e-4


@pytest.mark.parametrize("name", ["opengl", "raster"])
def test_tracked_environments_with_one_seed_agree_exactly(opengl, name):
    options = {"n_occluders": 1, "image_scale": 0.35, "renderer": name}
    envs = [gym.make(TRACKED_ID, **options) for _ in range(2)]
    assert_equal_rollouts(*[rollout(env, 3, 3) for env in envs])
    for env in envs:
        env.close()


def test_vector_environments_run():
    envs = gym.make_vec(STATE_ID, num_envs=2, vectorization_mode="sync")
    observations, _ = envs.reset(seed=0)
    assert observations["achieved_goal"].shape == (2, 153)
    _, rewards, *_ = envs.step(np.zeros((2, 10), dtype=np.float32))
    assert rewards.shape == (2,)
    envs.close()


def test_one_seed_gives_one_sequence_of_images_with_moving_occluders(opengl):
    options = {"observation_mode": "images", "n_occluders": 2, "image_scale": 0.1}
    envs = [gym.make(STATE_ID, **options) for _ in range(2)]
    rollouts = [rollout(env, 2, 4) for env in envs]
    assert_equal_rollouts(*rollouts)
    for env in envs:
        env.close()
