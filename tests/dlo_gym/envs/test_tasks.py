import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlo_gym.envs import goals, tasks
from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.rod import BoundaryDisplacement, RodProperties
from dlo_gym.scene.builder import SceneConfig

CONFIG = ShapeEnvConfig(n_elements=20)
REWARD = {"success_threshold": 0.005, "termination_penalty": 20.0}


@pytest.fixture(scope="module")
def cell():
    return SimulatedCell(RodProperties(length=0.5), 20, scene=SceneConfig(n_nodes=21))


def moved_by(vector):
    return BoundaryDisplacement.from_vector(vector)


def test_shape_error_is_the_mean_distance_of_nodes():
    achieved = np.zeros((2, 4, 3))
    desired = achieved.copy()
    desired[1, 0] = [0.3, 0.4, 0.0]
    np.testing.assert_allclose(tasks.shape_error(achieved, desired), [0.0, 0.125])
    np.testing.assert_allclose(
        tasks.shape_error(achieved.reshape(2, 12), desired.reshape(2, 12)), [0.0, 0.125]
    )


def test_shape_error_refuses_different_shapes():
    with pytest.raises(ValueError, match="achieved, desired"):
        tasks.shape_error(np.zeros((4, 3)), np.zeros((5, 3)))


def test_rewards():
    achieved = np.zeros((3, 12))
    desired = achieved.copy()
    desired[1, ::3] = 0.05
    desired[2, ::3] = 0.004
    failed = np.array([False, False, True])
    dense = tasks.compute_reward(achieved, desired, failed, kind="dense", **REWARD)
    np.testing.assert_allclose(dense, [0.0, -0.5, -20.04])
    sparse = tasks.compute_reward(achieved, desired, failed, kind="sparse", **REWARD)
    np.testing.assert_allclose(sparse, [0.0, -1.0, -20.0])


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    batch=st.integers(1, 300),
    kind=st.sampled_from(["dense", "sparse"]),
)
def test_a_batch_of_rewards_is_each_reward_to_the_last_bit(seed, batch, kind):
    rng = np.random.default_rng(seed)
    achieved, desired = rng.normal(scale=0.01, size=(2, batch, 153)).astype(np.float32)
    failed = rng.random(batch) < 0.3
    rewards = tasks.compute_reward(achieved, desired, failed, kind=kind, **REWARD)
    for i in range(min(batch, 5)):
        single = tasks.compute_reward(achieved[i], desired[i], failed[i], kind=kind, **REWARD)
        assert single == rewards[i]


def test_failures_are_read_from_one_info_or_many():
    ended, going = {"termination": "overstretch"}, {"termination": ""}
    assert tasks.failures(ended)
    assert not tasks.failures(going)
    assert not tasks.failures({})
    np.testing.assert_array_equal(
        tasks.failures(np.array([ended, going, {}])), [True, False, False]
    )


@pytest.mark.parametrize(
    ("motion", "check_arms", "reason"),
    [
        (np.zeros(12), True, ""),
        ([-0.1, *np.zeros(11)], True, "overstretch"),
        ([0.37, *np.zeros(11)], False, "collision"),
        ([0, 0, -0.3, 0, 0, 0, 0, 0, -0.3, 0, 0, 0], True, "collision"),
        ([0, 0, -0.3, 0, 0, 0, 0, 0, -0.3, 0, 0, 0], False, "table_contact"),
        ([0, 0, 2.0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0], True, "unreachable"),
    ],
)
def test_every_way_to_fail_has_its_name(motion, check_arms, reason):
    config = ShapeEnvConfig(n_elements=20, start_noise=(0.0, 0.0))
    cell = SimulatedCell(
        config.properties, 20, scene=SceneConfig(n_nodes=21), check_arms=check_arms
    )
    tasks.reset_to_random_start(cell, np.random.default_rng(0), config, ())
    assert tasks.advance(cell, moved_by(motion), config) == reason


def test_a_command_on_the_stretch_limit_passes(cell):
    config = ShapeEnvConfig(n_elements=20, start_noise=(0.0, 0.0))
    tasks.reset_to_random_start(cell, np.random.default_rng(0), config, ())
    room = config.max_stretch * 0.5 - cell.boundary.distance
    assert tasks.advance(cell, moved_by([-room, *np.zeros(11)]), config) == ""
    assert tasks.advance(cell, moved_by([-1e-6, *np.zeros(11)]), config) == "overstretch"


def test_starts_scatter_within_their_noise(cell):
    rng = np.random.default_rng(0)
    for _ in range(5):
        tasks.reset_to_random_start(cell, rng, CONFIG, ())
        offset = cell.boundary.left[:3, 3] - [-0.2, 0.0, 0.34]
        assert 0.0 < np.abs(offset).max() <= 0.02
        assert cell.boundary.left[0, 2] > np.cos(np.deg2rad(15.0))
        assert cell.stamp == 0.0


def test_options_that_leave_no_goal_or_start_say_so(cell, monkeypatch):
    monkeypatch.setattr(tasks, "ATTEMPTS", 3)
    monkeypatch.setattr(goals, "ATTEMPTS", 3)
    rng = np.random.default_rng(0)
    tasks.reset_to_random_start(cell, rng, CONFIG, ())
    here = cell.rod_state
    with pytest.raises(ValueError, match="no goal found in 3 attempts for goal_distance"):
        goals.sample_goal(cell, rng, ShapeEnvConfig(n_elements=20, goal_distance=(2.0, 3.0)))
    assert cell.rod_state is here
    with pytest.raises(ValueError, match="no start found in 3 attempts.*start_height=3"):
        tasks.reset_to_random_start(cell, rng, ShapeEnvConfig(n_elements=20, start_height=3.0), ())
