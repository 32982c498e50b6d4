import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import dlo_gym  # noqa: F401

STATE_ID = "dlo_gym/ShapeControl-v0"
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]


def make(mode, n=3, steps=6, **options):
    return gym.make_vec(
        STATE_ID, num_envs=n, autoreset_mode=mode, max_episode_steps=steps, **options
    )


def make_sync(mode, n=3, steps=6, **options):
    return gym.make_vec(
        STATE_ID,
        num_envs=n,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        max_episode_steps=steps,
        **options,
    )


def assert_same(first, second):
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, tuple):
        for a, b in zip(first, second, strict=True):
            assert_same(a, b)
    elif isinstance(first, np.ndarray):
        assert first.shape == second.shape
        assert first.dtype == second.dtype
        if first.dtype == object:
            for a, b in zip(first, second, strict=True):
                assert_same(a, b)
        else:
            np.testing.assert_array_equal(first, second)
    else:
        assert first == second


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_it_is_gymnasiums_own_vector_of_single_environments_to_the_last_bit(mode):
    options = {"termination_penalty": 7.0}
    native, sync = make(mode, **options), make_sync(mode, **options)
    assert native.single_observation_space == sync.single_observation_space
    assert native.observation_space == sync.observation_space
    assert native.action_space == sync.action_space
    rng = np.random.default_rng(0)
    assert_same(native.reset(seed=3), sync.reset(seed=3))
    ends = set()
    for _ in range(14):
        # The first pulls apart and ends early; the others run out of time.
        actions = rng.uniform(-1, 1, (3, 10)).astype(np.float32)
        actions[0, [0, 5]] = -1.0, 1.0
        left, right = native.step(actions), sync.step(actions)
        assert_same(left, right)
        assert native.observation_space.contains(left[0])
        over = left[2] | left[3]
        ends |= set(left[4]["termination"][left[2]])
        if mode is AutoresetMode.DISABLED and over.any():
            masks = [{"reset_mask": over.copy()} for _ in range(2)]
            assert_same(native.reset(options=masks[0]), sync.reset(options=masks[1]))
    assert "overstretch" in ends or mode is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_how_many_threads_does_not_show(mode):
    results = []
    for threads in (1, 4):
        envs = make(mode, n=6, steps=4, threads=threads)
        rng = np.random.default_rng(1)
        results.append([envs.reset(seed=11)])
        for _ in range(9):
            results[-1].append(envs.step(rng.uniform(-1, 1, (6, 10))))
            over = results[-1][-1][2] | results[-1][-1][3]
            if mode is AutoresetMode.DISABLED and over.any():
                results[-1].append(envs.reset(options={"reset_mask": over}))
        envs.close()
    assert_same(*map(tuple, results))


def test_metadata_says_how_it_starts_over():
    for mode in MODES:
        assert make(mode, n=1).metadata["autoreset_mode"] is mode


def test_an_episode_that_is_over_must_be_reset_where_nothing_else_does():
    envs = make(AutoresetMode.DISABLED, n=2, steps=1)
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros((2, 10)))
    envs.reset(seed=0)
    envs.step(np.zeros((2, 10)))
    with pytest.raises(gym.error.ResetNeeded, match=r"\[0, 1\]"):
        envs.step(np.zeros((2, 10)))


def test_results_are_not_shared_between_steps():
    envs = make(AutoresetMode.NEXT_STEP, n=2)
    first, _ = envs.reset(seed=0)
    kept = first["achieved_goal"].copy()
    envs.step(np.ones((2, 10)))
    np.testing.assert_array_equal(first["achieved_goal"], kept)


@pytest.mark.parametrize("actions", [np.zeros((2, 12)), np.zeros(10), np.full((2, 10), np.nan)])
def test_illegal_actions_are_refused(actions):
    envs = make(AutoresetMode.NEXT_STEP, n=2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="actions: expected"):
        envs.step(actions)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="observation_mode"):
        make(AutoresetMode.NEXT_STEP, observation_mode="images")
    with pytest.raises(ValueError, match="num_envs"):
        make(AutoresetMode.NEXT_STEP, n=0)
    with pytest.raises(ValueError, match="threads: expected at least 1, or None, got 0"):
        make(AutoresetMode.NEXT_STEP, threads=0)
    envs = make(AutoresetMode.NEXT_STEP, n=2)
    with pytest.raises(ValueError, match="seed: expected one per environment, 2, got 3"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.zeros(2, dtype=bool)})


def test_the_first_reset_is_of_all():
    envs = gym.make_vec("dlo_gym/ShapeControl-v0", 2, autoreset_mode="Disabled")
    with pytest.raises(gym.error.ResetNeeded, match="all environments the first time"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\)"):
        envs.step(envs.action_space.sample())
    envs.close()
