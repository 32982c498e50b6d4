import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import dlo_gym  # noqa: F401
from dlo_gym.envs import goals, obstacle_course, tasks
from dlo_gym.envs.obstacle_rows import obstacle_rows
from dlo_gym.envs.randomization import Randomization
from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.se3 import pose
from dlo_gym.rod import BoundaryPoses, Box, Capsule, Sphere
from dlo_gym.scene.clearance import obstacle_clearance

ID = "dlo_gym/ShapeControlObstacle-v0"
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
START = BoundaryPoses(pose(ALONG_X, [-0.2, 0.0, 0.34]), pose(ALONG_X, [0.2, 0.0, 0.34]))
FORWARD = np.array([0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0])  # both clamps along y


def make(**options):
    return gym.make(ID, **options).unwrapped


def post(y, height=0.4, x=0.0):
    return Capsule.between([x, y, 0.0], [x, y, height], 0.015)


def begin(env, *obstacles):
    env.reset(seed=0, options={"start": START, "goal": straight(env), "obstacles": obstacles})


def straight(env):
    n = env.config.n_nodes
    return np.column_stack([np.linspace(-0.2, 0.2, n), np.full(n, 0.1), np.full(n, 0.34)])


def straight_way(env, goal_boundary):
    """Reasons and touches on the clamps' straight way to ``goal_boundary``."""
    motion = env.cell.boundary.displacement_to(goal_boundary)
    n = goals.n_steps(motion, env.cell.boundary, env.config)
    touched, reasons = False, set()
    for _ in range(n):
        reasons.add(tasks.advance(env.cell, motion.scaled(1.0 / n), env.config))
        touched |= bool(env.cell.touching.any())
    return touched, reasons - {""}


@pytest.mark.parametrize("touch", ["forbidden", "allowed"])
def test_the_first_obstacle_stands_in_the_straight_way_and_the_start_is_clear(touch, monkeypatch):
    boundaries = []
    far_enough = goals.far_enough

    def recorded(cell, start, config):
        boundaries.append(cell.boundary)
        return far_enough(cell, start, config)

    monkeypatch.setattr(goals, "far_enough", recorded)
    env = make(touch=touch)
    for seed in range(4):
        _, info = env.reset(seed=seed)
        assert not info["touching"].any()
        cell = env.cell
        assert (cell.rod_state.contact.gaps > 0.005).all()
        assert (
            obstacle_clearance(cell.arms.T_world_base, cell.joint_angles, cell.obstacles).min()
            > 0.005
        )
        start = cell.save()
        cell.place_obstacles(cell.obstacles[:1])
        touched, reasons = straight_way(env, boundaries[-1])
        assert touched or "collision" in reasons or "unreachable" in reasons
        if touch == "forbidden":
            assert reasons
        cell.restore(start)
        assert len(cell.obstacles) == len(start.rod.contact.obstacles)


@pytest.mark.parametrize(
    ("touch", "careless"), [("forbidden", False), ("allowed", False), ("forbidden", True)]
)
def test_a_way_round_was_simulated_and_ends_at_the_goal(touch, careless, monkeypatch):
    env, way = make(touch=touch, friction=0.2), []
    advance, clear = tasks.advance, obstacle_course._clear
    if careless:  # obstacles are placed beside the way's first step alone

        def clear_of_the_first(cell, start, around, body, touch):
            first = around._replace(
                positions=around.positions[:1], joint_angles=around.joint_angles[:1]
            )
            return clear(cell, start, first, body, touch)

        monkeypatch.setattr(obstacle_course, "_clear", clear_of_the_first)

    def recorded(cell, displacement, config):
        way.append((len(cell.obstacles), cell.stamp, displacement))
        return advance(cell, displacement, config)

    monkeypatch.setattr(tasks, "advance", recorded)
    for seed in range(5):
        way.clear()
        env.reset(seed=seed)
        last = max(i for i, (n, stamp, _) in enumerate(way) if n and stamp == 0.0)
        for _, _, displacement in way[last:]:
            twists = displacement.vector.reshape(2, 6)
            assert np.abs(twists[:, :3]).max() <= env.config.max_translation_step + 1e-12
            assert advance(env.cell, displacement, env.config) == ""
        np.testing.assert_allclose(env.cell.rod_state.positions, env.goal, atol=1e-12)


def test_the_number_that_stand_varies_and_missing_ones_are_zeros():
    env = make(standing_obstacles=(1, 3))
    numbers = set()
    for seed in range(8):
        observation, info = env.reset(seed=seed)
        rows = observation["obstacles"].reshape(3, 15)
        n = len(env.cell.obstacles)
        numbers.add(n)
        np.testing.assert_array_equal(rows[:, 0], np.arange(3) < n)
        assert not rows[n:].any()
        assert info["touching"].shape == (3,)
        assert env.observation_space.contains(observation)
    assert len(numbers) > 1


def test_rows_describe_the_bodies():
    box = Box(pose(ALONG_X, [0.1, 0.2, 0.3]), (0.01, 0.02, 0.03))
    rows = obstacle_rows([box, post(0.1), Sphere.at([1, 0, 0], 0.2)], ("allowed",) * 3, 4)
    rows = rows.reshape(4, 15)
    np.testing.assert_allclose(
        rows[0], [1, 1, 0.1, 0.2, 0.3, 0, 1, 0, 1, 0, 0, 0.01, 0.02, 0.03, 0], atol=1e-7
    )
    np.testing.assert_allclose(rows[1, [2, 3, 4, 13, 14]], [0, 0.1, 0.2, 0.2, 0.015], atol=1e-7)
    np.testing.assert_allclose(rows[2, [2, 11, 12, 13, 14]], [1, 0, 0, 0, 0.2], atol=1e-7)
    assert not rows[3].any()


def test_forbidden_contact_ends_the_episode_where_the_cable_meets_the_post():
    env = make()
    begin(env, post(0.05))
    # The post's surface is 0.035 m away, the cable's radius 0.003 m: the fourth step of 0.01 m.
    for _ in range(3):
        assert not env.step(FORWARD)[2]
    _, reward, terminated, _, info = env.step(FORWARD)
    assert terminated
    assert info["termination"] == "obstacle_contact"
    assert info["touching"].tolist() == [True, False, False]
    assert reward < -env.config.termination_penalty
    assert not info["success"]


def test_allowed_contact_bends_the_cable_round_the_post():
    env = make(touch="allowed", friction=0.3)
    begin(env, post(0.05))
    for _ in range(8):
        _, _, terminated, _, info = env.step(FORWARD)
        assert not terminated
    assert info["touching"][0]
    x = env.cell.rod_state.positions
    assert x[[0, -1], 1] == pytest.approx(0.08)
    assert x[np.abs(x[:, 0]) < 0.01, 1].max() < 0.04  # held back
    assert np.abs(info["wrench_left"][1] + info["wrench_right"][1]) > 1e-3  # pressed against it


def test_each_obstacle_has_its_own_rule():
    env = make(touch=("allowed", "allowed", "forbidden"))
    begin(env, post(0.05), post(0.3), post(0.07, x=0.1))
    touches = []
    for _ in range(10):
        _, _, terminated, _, info = env.step(FORWARD)
        touches.append(info["touching"].tolist())
        if terminated:
            break
    assert info["termination"] == "obstacle_contact"
    assert touches[3] == [True, False, False]
    assert touches[-1] == [True, False, True]


def test_arms_never_touch_even_where_the_cable_may():
    env = make(touch="allowed")
    # In the way of the gripper's palm, 7 cm to the side of the clamp.
    begin(env, post(0.12, x=0.27))
    reasons = [env.step(FORWARD)[4]["termination"] for _ in range(8)]
    assert next(reason for reason in reasons if reason) == "collision"


def test_a_clamp_that_would_enter_an_obstacle_is_refused():
    env = make(touch="allowed", check_arms=False)
    begin(env, post(0.05, x=-0.2))
    for _ in range(6):
        before = env.cell.rod_state
        _, _, terminated, _, info = env.step(FORWARD)
        if terminated:
            break
    assert info["termination"] == "collision"
    assert env.cell.rod_state is before
    np.testing.assert_array_equal(info["displacement"], 0.0)


@pytest.mark.parametrize(
    ("obstacle", "said"),
    [
        (post(0.0, x=-0.2), "clamp left: expected outside of obstacles.0., got Capsule"),
        (post(0.0, x=0.3), "obstacles: expected clear of the arms"),
        (post(0.017, x=0.0), "obstacles: expected clear of the cable at the start, got .0. touch"),
    ],
)
def test_obstacles_must_be_clear_of_clamps_arms_and_cable_at_the_start(obstacle, said):
    with pytest.raises(ValueError, match=said):
        begin(make(), obstacle)


def test_a_given_goal_comes_with_obstacles_and_they_with_it():
    env = make()
    for options in ({"goal": straight(env)}, {"obstacles": [post(0.1)]}):
        with pytest.raises(ValueError, match="goal, obstacles: expected both or neither"):
            env.reset(options=options)
    with pytest.raises(ValueError, match="obstacles: expected at most 3, got 4"):
        begin(env, *[post(0.1, x=0.05 * k) for k in range(4)])


def test_the_next_episode_has_other_obstacles_and_one_seed_the_same():
    env, other = make(), make()
    first, _ = env.reset(seed=5)
    second, _ = env.reset()
    assert (first["obstacles"] != second["obstacles"]).any()
    other.reset(seed=9)
    again, _ = other.reset(seed=5)
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 10))
    env.reset(seed=5)
    for action in actions:
        ours, theirs = env.step(action), other.step(action)
        for key in first:
            np.testing.assert_array_equal(ours[0][key], theirs[0][key])
        np.testing.assert_equal(ours[4], theirs[4])


def test_a_vector_of_them_is_each_of_them_to_the_last_bit():
    options = {"touch": ("allowed", "forbidden", "forbidden"), "friction": 0.2}
    envs = gym.make_vec(ID, 2, autoreset_mode=AutoresetMode.DISABLED, **options)
    singles = [make(**options) for _ in range(2)]
    observations, infos = envs.reset(seed=3)
    expected = [env.reset(seed=3 + i) for i, env in enumerate(singles)]
    rng = np.random.default_rng(1)
    for _ in range(12):
        for i, (observation, info) in enumerate(expected):
            for key in observation:
                np.testing.assert_array_equal(observations[key][i], observation[key])
            for key in ("touching", "shape_error", "displacement", "termination"):
                np.testing.assert_array_equal(infos[key][i], info[key])
        actions = rng.uniform(-1, 1, (2, 10))
        observations, rewards, ended, _, infos = envs.step(actions)
        steps = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        expected = [(step[0], step[4]) for step in steps]
        np.testing.assert_array_equal(rewards, [step[1] for step in steps])
        np.testing.assert_array_equal(ended, [step[2] for step in steps])
        if ended.any():
            break


@pytest.mark.parametrize("renderer", ["opengl", "raster"])
def test_obstacles_hide_the_cable_from_the_cameras(renderer):
    env = make(observation_mode="images", image_scale=0.2, renderer=renderer)
    try:
        begin(env, post(0.2))
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    clear = env.cell.visibility()[0]
    begin(env, post(-0.1))
    hidden = ~env.cell.visibility()[0] & clear
    assert 3 <= hidden.sum() <= 8
    middle = np.abs(env.cell.rod_state.positions[hidden, 0])
    assert middle.max() < 0.04
    env.reset(seed=0)
    assert env.cell.visibility()[0][~hidden].any()
    env.close()


def test_friction_is_sampled_said_and_reaches_the_rod():
    env = make(touch="allowed", randomization=Randomization(friction=(0.2, 0.6)))
    values = []
    for seed in range(3):
        _, info = env.reset(seed=seed)
        values.append(info["randomization"]["friction"])
        assert env.cell.rod._contact.friction == values[-1]
        assert env.cell.rod_state.contact.anchors.shape[0] == len(env.cell.obstacles)
    assert len(set(values)) == 3
    assert min(values) >= 0.2
    assert max(values) <= 0.6


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"obstacles": ("post", "wall")}, "obstacles: expected a sequence of post, box, got"),
        ({"obstacles": "post"}, "obstacles: expected a sequence"),
        ({"touch": "never"}, "touch: expected forbidden or allowed, for all of 3"),
        ({"touch": ("allowed",)}, "touch: expected forbidden or allowed, for all of 3"),
        ({"standing_obstacles": (0, 2)}, "standing_obstacles: expected .* of 3 obstacles, got"),
        ({"standing_obstacles": (1, 4)}, "standing_obstacles"),
        ({"standing_obstacles": 2}, "standing_obstacles"),
        ({"standing_obstacles": ()}, "standing_obstacles"),
        ({"standing_obstacles": (1.5, 2.5)}, "standing_obstacles"),
        ({"friction": -0.1}, "friction: expected a finite non-negative number, got -0.1"),
        ({"straight_way": "blocked"}, "straight_way: expected .any. with obstacles"),
    ],
)
def test_wrong_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        gym.make(ID, **options)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"friction": 0.3}, "friction: expected none without obstacles to rub on, got 0.3"),
        (
            {"randomization": Randomization(friction=(0.1, 0.3))},
            r"randomization.friction: expected none without obstacles to rub on, got \(0.1, 0.3\)",
        ),
        ({"touch": ("allowed",)}, "touch: expected forbidden or allowed, for all of 0"),
        ({"standing_obstacles": (1, 1)}, "standing_obstacles: expected .* of 0 obstacles"),
    ],
)
def test_options_about_obstacles_need_some(options, said):
    with pytest.raises(ValueError, match=said):
        gym.make("dlo_gym/ShapeControl-v0", **options)


def test_an_unsolvable_course_says_so(monkeypatch):
    monkeypatch.setattr(obstacle_course, "ATTEMPTS", 2)
    with pytest.raises(ValueError, match="no way round obstacles found in 2 attempts"):
        make(goal_distance=(2.0, 3.0)).reset(seed=0)
