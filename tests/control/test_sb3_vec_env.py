import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

pytest.importorskip("stable_baselines3")

from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from control.sb3_vec_env import ShapeVecEnv

STATE_ID = "dlo_gym/ShapeControl-v0"


def native(n, steps=4, **options):
    return ShapeVecEnv(
        gym.make_vec(
            STATE_ID, n, autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=steps, **options
        )
    )


def assert_same(first, second):
    assert first.keys() == second.keys()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key], strict=key != "termination")


def test_it_is_sb3s_own_vector_of_single_environments():
    own = make_vec_env(
        STATE_ID, 2, vec_env_cls=DummyVecEnv, env_kwargs={"max_episode_steps": 4}, seed=5
    )
    other = native(2)
    other.seed(5)
    assert other.observation_space == own.observation_space
    assert other.action_space == own.action_space
    assert_same(other.reset(), own.reset())
    rng = np.random.default_rng(0)
    over = 0
    for _ in range(9):
        actions = rng.uniform(-1, 1, (2, 10)).astype(np.float32)
        actions[0, [0, 5]] = -1.0, 1.0
        observations, rewards, dones, infos = other.step(actions)
        o, r, d, i = own.step(actions)
        assert_same(observations, o)
        np.testing.assert_array_equal(rewards, r)
        np.testing.assert_array_equal(dones, d)
        for info, expected in zip(infos, i, strict=True):
            expected.pop("episode", None)  # of SB3's Monitor
            if "terminal_observation" in expected:
                over += 1
                assert_same(info.pop("terminal_observation"), expected.pop("terminal_observation"))
            assert_same(info, expected)
    assert over >= 4


def test_hindsight_learns_on_it():
    model = SAC(
        "MultiInputPolicy", native(2), replay_buffer_class=HerReplayBuffer, learning_starts=12,
        batch_size=8, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0,
    )  # fmt: skip
    model.learn(24)
    assert model.num_timesteps == 24
    assert model.replay_buffer.size() == 12


def test_another_way_to_start_over_is_refused():
    with pytest.raises(ValueError, match="SameStep"):
        ShapeVecEnv(gym.make_vec(STATE_ID, 1))
