"""Goals: the ways that lead to them."""

import gymnasium as gym
import numpy as np
import pytest

import dlo_gym
from dlo_gym.envs import goals, tasks
from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.rod import RodProperties
from dlo_gym.scene.builder import SceneConfig

CONFIG = ShapeEnvConfig(n_elements=20)


@pytest.fixture
def cell():
    return SimulatedCell(CONFIG.properties, 20, scene=SceneConfig(n_nodes=21))


def test_goals_are_reachable_apart_and_off_the_straight_way(cell):
    rng = np.random.default_rng(1)
    for _ in range(3):
        tasks.reset_to_random_start(cell, rng, CONFIG, ())
        start = cell.save()
        goal = goals.sample_goal(cell, rng, CONFIG)
        assert cell.rod_state is start.rod
        assert cell.stamp == 0.0
        error = tasks.shape_error(goal.centerline, start.rod.positions)
        assert 0.06 <= error <= 0.25
        low, high = np.array(CONFIG.workspace)
        for clamp in (goal.boundary.left, goal.boundary.right):
            assert ((clamp[:3, 3] >= low - 1e-9) & (clamp[:3, 3] <= high + 1e-9)).all()
        assert goal.boundary.distance <= 0.95 * 0.98 * 0.5
        np.testing.assert_allclose(
            goal.centerline[[0, -1]],
            [goal.boundary.left[:3, 3], goal.boundary.right[:3, 3]],
            atol=1e-9,
        )


# The ways round obstacles have a test of their own, in test_obstacle_env.
@pytest.mark.parametrize(
    "task", [task for task, options in dlo_gym.SHAPE_TASKS.items() if "obstacles" not in options]
)
def test_the_way_to_a_goal_is_one_that_the_environment_allows(task, monkeypatch):
    env = gym.make(f"dlo_gym/ShapeControl{task}-v0").unwrapped
    follow, legs = goals._follow, []

    def recorded(cell, leg):
        legs.append((cell.rod_state, leg))
        return follow(cell, leg)

    monkeypatch.setattr(goals, "_follow", recorded)
    for seed in range(3):
        env.reset(seed=seed)
        cell, config = env.cell, env.config
        first = max(i for i, (state, _) in enumerate(legs) if state is cell.rod_state)
        for _, leg in legs[first:]:
            twists = np.abs(leg.step.vector.reshape(-1, 6))
            assert twists[:, :3].max() <= config.max_translation_step + 1e-12
            for _ in leg.clamps:
                assert tasks.advance(cell, leg.step, config) == ""
        np.testing.assert_allclose(cell.rod_state.positions, env.goal, atol=1e-6)


def test_a_way_that_touches_the_table_is_no_way(cell):
    cell.arms = None
    tasks.reset_to_random_start(cell, np.random.default_rng(0), CONFIG, ())
    room = tasks.above_table(cell)
    for down, allowed in ((room - 1e-3, True), (room + 1e-3, False)):
        start = cell.save()
        motion = np.tile([0.0, 0.0, -down, 0.0, 0.0, 0.0], 2)
        motion = goals.BoundaryDisplacement.from_vector(motion)
        leg = goals._leg(cell, cell.boundary, None, motion, CONFIG)
        assert goals._follow(cell, leg) is allowed
        if allowed:
            np.testing.assert_allclose(cell.boundary.clamps, leg.clamps[-1], atol=1e-12)
            assert tasks.above_table(cell) == pytest.approx(1e-3, abs=1e-6)
        cell.restore(start)


def test_a_rod_that_yields_takes_every_step_on_its_own(monkeypatch):
    moved, lengths = goals._moved, []

    def counted(cell, leg, begin, end, height):
        lengths.append(end - begin)
        return moved(cell, leg, begin, end, height)

    monkeypatch.setattr(goals, "_moved", counted)
    for yields, longest in ((None, goals.STRIDE), (4.0, 1)):
        properties = RodProperties(length=0.5, yield_curvature=yields)
        cell = SimulatedCell(properties, 20, scene=SceneConfig(n_nodes=21))
        rng = np.random.default_rng(0)
        tasks.reset_to_random_start(cell, rng, CONFIG, ())
        goals.sample_goal(cell, rng, CONFIG)
        assert max(lengths) == longest
        lengths.clear()
