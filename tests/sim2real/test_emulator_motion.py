"""The trajectory generator: it arrives, it lags as much as it should, it keeps its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.emulator import kinematics
from sim2real.emulator.motion import TICK, Mode, Motion, MotionFault, MotionLimits

HOME = np.array([2.21, -1.61, 2.30, -0.68, 0.64, 1.57])
T_FLANGE_TCP = kinematics.transform([0.0, 0.0, 0.163, 0.0, 0.0, 0.0])
LIMITS = MotionLimits()


def make(**limits):
    return Motion(HOME, T_FLANGE_TCP, MotionLimits(**limits))


def run(motion, ticks):
    """Joint angles (ticks + 1, 6) from now on."""
    path = [motion.q.copy()]
    for _ in range(ticks):
        motion.step()
        path.append(motion.q.copy())
    return np.array(path)


def run_until_hold(motion, most=5000):
    path = [motion.q.copy()]
    while motion.mode is not Mode.HOLD:
        motion.step()
        path.append(motion.q.copy())
        assert len(path) < most
    return np.array(path)


def velocities(path):
    return np.diff(path, axis=0) / TICK


def accelerations(path):
    return np.diff(velocities(path), axis=0) / TICK


def tool(motion):
    return kinematics.forward(motion.q, T_FLANGE_TCP)


def test_servo_lags_behind_a_ramp_by_its_time_constant():
    motion = make(servo_lag=0.035)
    speed = np.array([0.2, -0.1, 0.05, 0.3, -0.2, 0.1])
    for i in range(500):
        target = HOME + speed * TICK * i
        motion.servo_joints(target)
        motion.step()
    # The command of a tick has worked for one tick when it is compared.
    np.testing.assert_allclose((target - motion.q) / speed, 0.035 - TICK, rtol=1e-6)


def test_servo_covers_the_right_share_of_a_small_step_in_one_time_constant():
    motion = make(servo_lag=0.1, joint_acceleration=1e4)
    motion.servo_joints(HOME + 0.01)
    path = run(motion, 50)
    np.testing.assert_allclose((path[-1] - HOME) / 0.01, 1 - np.exp(-1), atol=0.01)


def test_servo_settles_on_its_target_without_overshoot():
    motion = make()
    target = HOME + np.array([0.5, -0.5, 0.4, 0.1, 0.01, -0.2])
    motion.servo_joints(target)
    path = run(motion, 1000)
    np.testing.assert_allclose(path[-1], target, atol=1e-9)
    assert ((path - target) * np.sign(HOME - target) >= -1e-6).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), hold=st.integers(1, 60))
def test_servo_never_exceeds_its_limits(seed, hold):
    rng = np.random.default_rng(seed)
    motion = make()
    path = [motion.q.copy()]
    for i in range(600):
        if i % hold == 0:
            motion.servo_joints(motion.q + rng.uniform(-0.59, 0.59, 6))
        motion.step()
        path.append(motion.q.copy())
    assert np.abs(velocities(np.array(path))).max() <= LIMITS.joint_speed * (1 + 1e-9)
    assert np.abs(accelerations(np.array(path))).max() <= LIMITS.joint_acceleration * (1 + 1e-6)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    acceleration=st.floats(0.01, 1000.0),
    speed=st.floats(0.0, 10.0),
)
def test_joint_speed_commands_never_exceed_their_limits(seed, acceleration, speed):
    rng = np.random.default_rng(seed)
    motion = make()
    path = [motion.q.copy()]
    for i in range(200):
        if i % 40 == 0:
            motion.speed_joints(rng.uniform(-speed, speed, 6), acceleration)
        motion.step()
        path.append(motion.q.copy())
    bound = min(acceleration, LIMITS.joint_acceleration)
    assert np.abs(velocities(np.array(path))).max() <= min(speed, np.pi) * (1 + 1e-6) + 1e-12
    assert np.abs(accelerations(np.array(path))).max() <= bound * (1 + 1e-6) + 1e-7


def test_tool_speed_moves_in_a_straight_line_at_the_speed_asked_for():
    motion = make()
    start = tool(motion)
    motion.speed_tool(np.array([0.05, -0.02, 0.03, 0.0, 0.0, 0.0]), 0.5)
    run(motion, 500)
    way = tool(motion)[:3, 3] - start[:3, 3]
    # The ramp of v / a seconds costs v^2 / (2 a) of the way.
    speed = np.linalg.norm([0.05, -0.02, 0.03])
    length = speed * 1.0 - speed**2 / (2 * 0.5)
    expected = length * np.array([0.05, -0.02, 0.03]) / speed
    np.testing.assert_allclose(way, expected, atol=2e-4)
    np.testing.assert_allclose(tool(motion)[:3, :3], start[:3, :3], atol=1e-4)


def test_tool_turn_integrates_to_its_angle():
    motion = make()
    start = tool(motion)
    motion.speed_tool(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2]), 100.0)
    run(motion, 500)
    difference = np.empty(6)
    kinematics.pose_difference(start, tool(motion), difference)
    np.testing.assert_allclose(difference[3:], [0.0, 0.0, 0.2], atol=2e-3)
    np.testing.assert_allclose(difference[:3], 0.0, atol=5e-4)


def test_move_of_joints_takes_the_time_of_its_trapezoid():
    motion = make()
    target = HOME + np.array([0.6, -0.3, 0.2, 0.1, 0.0, -0.1])
    motion.move_joints(target, 0.5, 1.0)
    path = run_until_hold(motion)
    assert (len(path) - 1) * TICK == pytest.approx(0.6 / 0.5 + 0.5 / 1.0, abs=2 * TICK)
    np.testing.assert_array_equal(path[-1], target)
    assert np.abs(velocities(path)).max() == pytest.approx(0.5, rel=1e-6)
    assert np.abs(accelerations(path)).max() <= 1.0 + 1e-6


def test_short_move_is_a_triangle():
    motion = make()
    motion.move_joints(HOME + 0.01, 1.0, 1.0)
    path = run_until_hold(motion)
    assert (len(path) - 1) * TICK == pytest.approx(2 * np.sqrt(0.01), abs=2 * TICK)


def test_move_of_joints_never_exceeds_the_arms_limits_whatever_is_asked():
    motion = make()
    motion.move_joints(HOME + 1.5, 100.0, 1e6)
    path = run_until_hold(motion)
    assert np.abs(velocities(path)).max() <= LIMITS.joint_speed * (1 + 1e-9)
    assert np.abs(accelerations(path)).max() <= LIMITS.joint_acceleration * (1 + 1e-6)


def test_move_of_the_tool_is_straight_and_keeps_its_speed():
    motion = make()
    start = tool(motion)
    goal = start.copy()
    goal[:3, 3] += [0.03, -0.06, 0.06]
    goal[:3, :3] = kinematics.transform([0, 0, 0, 0.1, 0.0, 0.2])[:3, :3] @ start[:3, :3]
    motion.move_tool(goal, 0.1, 0.4)
    places = np.array([kinematics.forward(q, T_FLANGE_TCP)[:3, 3] for q in run_until_hold(motion)])
    np.testing.assert_allclose(tool(motion), goal, atol=1e-8)
    direction = np.array([0.03, -0.06, 0.06]) / 0.09
    along = (places - places[0]) @ direction
    np.testing.assert_allclose(places - places[0], along[:, None] * direction, atol=1e-8)
    assert (np.diff(along) / TICK).max() == pytest.approx(0.1, rel=1e-4)
    assert (len(places) - 1) * TICK == pytest.approx(0.09 / 0.1 + 0.1 / 0.4, abs=2 * TICK)


def test_tool_stop_needs_the_distance_of_its_deceleration():
    motion = make()
    motion.speed_tool(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]), 10.0)
    run(motion, 200)
    before = tool(motion)[:3, 3].copy()
    motion.stop(0.5, by_tool=True)
    run_until_hold(motion)
    way = np.linalg.norm(tool(motion)[:3, 3] - before)
    assert way == pytest.approx(0.1**2 / (2 * 0.5), rel=0.05)


def test_joint_stop_decelerates_the_leading_joint_at_the_rate_asked_for():
    motion = make()
    motion.speed_joints(np.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.0]), 40.0)
    run(motion, 100)
    motion.stop(2.0)
    path = run_until_hold(motion)
    assert path[-1, 0] - path[0, 0] == pytest.approx(1.0**2 / (2 * 2.0), rel=0.01)
    assert path[-1, 1] - path[0, 1] == pytest.approx(0.5 * (path[-1, 0] - path[0, 0]), rel=1e-6)


def test_new_move_while_moving_stops_first_and_arrives():
    motion = make()
    motion.move_joints(HOME + 0.5, 1.0, 2.0)
    path = [run(motion, 200)]
    motion.move_joints(HOME - 0.2, 1.0, 2.0)
    path.append(run_until_hold(motion)[1:])
    joined = np.concatenate(path)
    np.testing.assert_array_equal(joined[-1], HOME - 0.2)
    assert np.abs(accelerations(joined)).max() <= LIMITS.stop_deceleration * (1 + 1e-6)


def test_paused_motion_goes_on_to_its_old_target():
    for command in (
        lambda motion: motion.move_joints(HOME + 0.3, 0.5, 1.0),
        lambda motion: motion.servo_joints(HOME + 0.3),
    ):
        motion = make()
        command(motion)
        run(motion, 20)
        paused = motion.pause()
        standing = run_until_hold(motion)[-1]
        assert np.abs(standing - HOME - 0.3).max() > 0.05
        motion.resume(paused)
        run(motion, 1500)
        np.testing.assert_allclose(motion.q, HOME + 0.3, atol=1e-9)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (lambda m: m.servo_joints(HOME + 1.0), "away from the joints"),
        (lambda m: m.servo_joints(np.full(6, np.nan)), "not a number"),
        (lambda m: m.servo_joints(np.full(6, 6.5)), "outside the joint's range"),
        (lambda m: m.move_joints(np.full(6, 6.5), 1.0, 1.0), "outside the joint's range"),
        (lambda m: m.move_joints(HOME + 0.1, 0.0, 1.0), "above 0"),
        (lambda m: m.move_joints(HOME + 0.1, np.nan, 1.0), "above 0"),
        (lambda m: m.speed_joints(np.zeros(6), -1.0), "above 0"),
        (lambda m: m.speed_tool(np.full(6, np.inf), 1.0), "not a number"),
        (lambda m: m.stop(0.0), "above 0"),
        (lambda m: m.servo_tool(kinematics.transform([2.0, 0, 0, 0, 0, 0])), "out of reach"),
    ],
)
def test_impossible_commands_are_faults(command, reason):
    motion = make()
    with pytest.raises(MotionFault, match=reason):
        command(motion)
    np.testing.assert_array_equal(motion.q, HOME)


def test_tool_speed_into_the_stretched_arm_is_a_fault_and_keeps_the_limits():
    motion = make()
    motion.speed_tool(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 2.0)
    path = [motion.q.copy()]

    def follow():
        for _ in range(2000):
            motion.step()
            path.append(motion.q.copy())

    with pytest.raises(MotionFault):
        follow()
    assert np.abs(velocities(np.array(path))).max() <= LIMITS.joint_speed * (1 + 1e-9)


def test_joint_driven_past_its_range_is_a_fault_at_the_range():
    motion = Motion(np.array([6.2, -1.5, 1.5, 0, 1.5, 0]), T_FLANGE_TCP, LIMITS)
    motion.speed_joints(np.array([1.0, 0, 0, 0, 0, 0]), 10.0)
    with pytest.raises(MotionFault, match="end of its range"):
        run(motion, 1000)
    assert 2 * np.pi - 0.01 < motion.q[0] <= 2 * np.pi


def test_slider_scales_the_speed_of_a_move():
    motion = make()
    motion.speed_slider = 0.5
    run(motion, 1)
    motion.move_joints(HOME + 0.5, 0.5, 5.0)
    path = run_until_hold(motion)
    middle = velocities(path)[len(path) // 2]
    assert np.abs(middle).max() == pytest.approx(0.25, rel=1e-6)


def test_limits_that_are_no_numbers_above_zero_are_refused():
    for value in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="joint_speed"):
            MotionLimits(joint_speed=value)
