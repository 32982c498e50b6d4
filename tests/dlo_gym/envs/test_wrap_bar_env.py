import warnings
from math import pi, tau

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import dlo_gym  # noqa: F401
from dlo_gym.envs.randomization import Randomization
from dlo_gym.envs.wrap_bar_script import WrapScript
from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.rod import BoundaryDisplacement, RodProperties

ID = "dlo_gym/WrapBar-v0"
DOWN = np.array([0, 0, -1.0, 0, 0, 0, 0, -1.0, 0, 0])


def make(**options):
    return gym.make(ID, **options).unwrapped


def wrap(env, seed, steps=120):
    """Infos and rewards of the script's episode, until success."""
    _, info = env.reset(seed=seed)
    script = WrapScript(env)
    infos, rewards = [info], []
    while not info["success"] and len(rewards) < steps:
        _, reward, terminated, _, info = env.step(script.action())
        assert not terminated, info["termination"]
        infos.append(info)
        rewards.append(reward)
    return infos, rewards


def tightened(env, state):
    """The rod's state when both ends have been pulled apart from a wound one."""
    env.cell.restore(state)
    apart = BoundaryDisplacement(
        np.array([-0.004, 0, 0, 0, 0, 0]), np.array([0.004, 0, 0.0015, 0, 0, 0])
    )
    for _ in range(13):
        rod = env.cell.move(apart)
    return rod


@pytest.fixture(scope="module")
def wrapped():
    env = make()
    infos, rewards = wrap(env, 0)
    return env, infos, rewards, env.cell.save()


def test_the_script_winds_the_cable_round_the_bar(wrapped):
    _, infos, rewards, _ = wrapped
    windings = [info["winding"] for info in infos]
    assert -pi / 4 < windings[0] < 0
    assert windings[-1] >= tau
    assert (
        np.abs(np.diff(windings)).max() < 1.0
    )  # never over the bar's end, which is a jump by 2 pi
    assert infos[-1]["success"]
    assert [info["held_steps"] for info in infos[-5:]] == [1, 2, 3, 4, 5]
    assert not any(info["success"] for info in infos[:-1])
    assert rewards[-1] == 0.0
    assert rewards[0] < -1.0


def test_a_second_start_is_wound_by_the_same_script():
    infos, _ = wrap(make(), 3)
    assert infos[-1]["success"]


def test_pulled_tight_the_cable_meets_the_bar_all_the_way_round(wrapped):
    env, _, _, state = wrapped
    contact, axis = tightened(env, state).contact, env.bar.pose[:3, 2]
    at_bar = contact.points[contact.gaps[0] < 0] - env.bar.pose[:3, 3]
    directions = np.sort(np.arctan2(at_bar[:, 0], at_bar[:, 2]))
    assert np.diff(np.append(directions, directions[0] + tau)).max() < pi / 3
    away = np.linalg.norm(at_bar - np.outer(at_bar @ axis, axis), axis=1)
    np.testing.assert_allclose(away, env.bar.radius + 0.003, atol=3e-4)
    assert np.abs(contact.self_forces).max() > 0.0  # the two strands press on each other


def test_a_wound_cable_stays_wound_while_the_arms_hold_still(wrapped):
    env, infos, _, state = wrapped
    env.cell.restore(state)
    for _ in range(30):
        *_, info = env.step(np.zeros(10))
    assert info["success"]
    assert info["winding"] == pytest.approx(infos[-1]["winding"], abs=1e-6)
    np.testing.assert_allclose(env.cell.rod_state.positions, state.rod.positions, atol=1e-6)


def test_a_wound_cable_holds_against_a_pull_as_capstans_do(wrapped):
    env, _, _, state = wrapped
    before = tightened(env, state)
    pull = BoundaryDisplacement(np.zeros(6), np.array([0.002, 0, 0, 0, 0, 0]))
    for _ in range(6):
        after = env.cell.move(pull)
    left, right = (np.linalg.norm(w[:3]) for w in (after.wrench_left, after.wrench_right))
    assert right > 2 * np.linalg.norm(before.wrench_right[:3])
    assert left == pytest.approx(np.linalg.norm(before.wrench_left[:3]), rel=0.02)
    assert right / left < np.exp(env.config.friction * tau)


def test_starts_lie_across_the_bar():
    env = make()
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        assert info["touching"].tolist() == [True, False]
        assert abs(info["winding"]) < pi / 2
        assert observation["achieved_goal"][1] == 1.0
        np.testing.assert_allclose(observation["desired_goal"], [tau, 1.0], rtol=1e-6)
        assert env.observation_space.contains(observation)
        assert env.cell.stamp == 0.0
        assert env.cell.arms.clearance(env.cell.joint_angles).minimum > 0.0
        assert not env.cell.arms_at_obstacle()


def test_a_negative_winding_starts_under_the_bar():
    env = make(winding=-tau)
    observation, info = env.reset(seed=0)
    assert abs(info["winding"]) < pi / 2
    at_bar = np.abs(env.cell.rod_state.positions[:, 0] - env.bar.pose[0, 3]) < 0.02
    assert (env.cell.rod_state.positions[at_bar, 2] < env.bar.pose[2, 3]).all()
    reward = env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
    wound = np.array([-tau, 1.0])
    assert env.compute_reward(wound, wound, {}) == 0.0
    assert env.compute_reward(-wound, wound, {}) < reward < 0.0


def test_a_negative_winding_can_be_reached():
    env = make(winding=-tau)
    for seed in (0, 1, 4, 6):  # a slack cable may slip off the bar's free end
        _, info = env.reset(seed=seed)
        script, terminated = WrapScript(env), False
        for _ in range(100):
            _, _, terminated, _, info = env.step(script.action())
            if terminated or info["success"]:
                break
        if info["success"]:
            break
    assert info["success"]
    assert info["winding"] <= -tau


def test_rewards_count_missing_turns_touch_and_failure():
    env = make()
    goal = np.array([tau, 1.0])
    achieved = np.array([[tau, 1.0], [2 * tau, 1.0], [pi, 1.0], [tau, 0.0], [0.0, 1.0]])
    infos = [{}] * 4 + [{"termination": "collision"}]
    goals = np.tile(goal, (5, 1))
    np.testing.assert_allclose(
        env.compute_reward(achieved, goals, infos), [0.0, 0.0, -0.5, -0.1, -21.0]
    )
    singles = [env.compute_reward(a, goal, info) for a, info in zip(achieved, infos, strict=True)]
    np.testing.assert_array_equal(env.compute_reward(achieved, goals, infos), singles)
    sparse = make(reward="sparse")
    np.testing.assert_allclose(
        sparse.compute_reward(achieved, goals, infos), [0.0, 0.0, -1.0, -1.0, -21.0]
    )


def test_a_gripper_that_goes_into_the_bar_ends_the_episode():
    env = make()
    env.reset(seed=0)
    x, _, z = env.bar.pose[:3, 3]
    for way in ([x, 0.1, z + 0.16], [x, 0.1, z]):
        for _ in range(20):
            action = np.zeros(10)
            action[5:8] = np.clip((way - env.cell.boundary.right[:3, 3]) / 0.02, -1.0, 1.0)
            _, reward, terminated, _, info = env.step(action)
            if terminated or np.abs(action).max() < 0.1:
                break
    assert info["termination"] == "collision"
    assert reward < -env.config.termination_penalty


def test_two_environments_with_one_seed_agree_exactly():
    first, second = make(), make()
    second.reset(seed=1)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 10))
    runs = []
    for env in (first, second):
        observation, _ = env.reset(seed=4)
        runs.append([observation] + [env.step(action)[0] for action in actions])
    for one, other in zip(*runs, strict=True):
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


def test_both_checkers_find_nothing():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            check_env(make(image_scale=0.1))
        except RenderingUnavailable as error:
            pytest.skip(str(error))
        checker.check_env(make())


@pytest.mark.slow
@pytest.mark.parametrize("observed", ["Tracked", "Images"])
def test_both_checkers_find_nothing_in_what_sees_images(observed):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    options = {"image_scale": 0.1} if observed == "Images" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            check_env(gym.make(f"dlo_gym/WrapBar{observed}-v0", **options).unwrapped)
        except RenderingUnavailable as error:
            pytest.skip(str(error))
        checker.check_env(gym.make(f"dlo_gym/WrapBar{observed}-v0", **options).unwrapped)


def test_the_bar_hides_what_is_behind_and_above_it():
    env = make(observation_mode="images", image_scale=0.2, renderer="raster")
    env.reset(seed=0)
    top = env.cell.cameras[1].name
    assert env.cell._renderer.rod_mask(top).any()
    x = env.cell.rod_state.positions
    over = np.hypot(x[:, 0] - env.bar.pose[0, 3], x[:, 2] - env.bar.pose[2, 3]) < 0.025
    assert env.cell.visibility()[1][over].all()
    infos, _ = wrap(env, 0)
    assert infos[-1]["success"]
    # Now some of it is under the bar.
    x = env.cell.rod_state.positions
    away = x[:, [0, 2]] - env.bar.pose[[0, 2], 3]
    under = (np.abs(away[:, 0]) < 0.01) & (away[:, 1] < -0.015) & (away[:, 1] > -0.05)
    assert under.any()
    assert not env.cell.visibility()[1][under].any()
    env.close()


def test_the_tracker_follows_the_cable_round_the_bar():
    options = {"image_scale": 1 / 3, "renderer": "raster"}
    env = gym.make("dlo_gym/WrapBarTracked-v0", **options).unwrapped
    infos, _ = wrap(env, 0)
    assert infos[-1]["success"]
    errors = [info["tracking_ptp3d"] for info in infos]
    assert 0.0 < np.mean(errors) < 5e-3
    achieved = env.step(np.zeros(10))[0]["achieved_goal"]
    assert achieved[0] == pytest.approx(infos[-1]["winding"], abs=0.1)
    env.close()


def test_randomized_cables_are_wound_too():
    env = make(randomization=Randomization(friction=(0.2, 0.5), youngs_modulus=(8e5, 1.2e6)))
    infos, _ = wrap(env, 1)
    assert infos[-1]["success"]
    assert env.cell.rod._contact.friction == infos[0]["randomization"]["friction"]
    _, info = env.reset(seed=2)
    assert info["held_steps"] == 0
    assert not info["success"]


def test_vectors_of_it_are_gymnasiums_own():
    envs = gym.make_vec(ID, 2)
    assert isinstance(envs, gym.vector.SyncVectorEnv)
    observations, _ = envs.reset(seed=0)
    assert observations["achieved_goal"].shape == (2, 2)
    envs.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"self_contact": False}, "self_contact: expected True, for a cable that is wound"),
        ({"winding": 0.0}, "winding: expected an angle other than 0"),
        ({"winding": 12 * tau}, "winding: expected a cable longer than the way round the bar"),
        ({"hold_steps": 0}, "hold_steps: expected an integer of at least 1, got 0"),
        ({"bar_radius": 0.0}, "bar_radius: expected a finite positive number"),
        ({"bar_span": (0.3, 0.0)}, "bar_span: expected the free end's y below 0.1 m"),
        ({"bar_span": (0.15, 0.3)}, "bar_span: .* below 0.1 m, where the cable lies"),
        ({"bar_noise": -1.0}, "bar_noise"),
        ({"touch": "forbidden"}, "touch: expected .allowed. for the bar"),
        ({"goal_distance": (0.1, 0.2)}, "goal_distance: expected none"),
        ({"free_end": True}, "free_end: expected none"),
        ({"obstacles": ("bar",)}, "obstacles: expected none"),
        ({"start_distance": 0.69}, "start_distance"),
        ({"properties": RodProperties(length=0.3)}, "start_distance"),
        ({"windings": 1.0}, "unknown environment option 'windings'.*hold_steps"),
    ],
)
def test_wrong_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        gym.make(ID, **options)


def test_it_takes_no_reset_options():
    with pytest.raises(ValueError, match="unknown reset option 'goal'"):
        make().reset(options={"goal": np.zeros((51, 3))})


def test_using_the_bar_before_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        _ = make().bar
