"""Whatever the targets, the setpoints are smooth, bounded and never pass a target that stays."""

from math import dist, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sim2real.ur5e.setpoint import (
    JointSetpoints,
    MovingAverage,
    PoseSetpoints,
    SetpointLimits,
    from_pose_vector,
    pose_distance,
    to_pose_vector,
)

LIMITS = SetpointLimits()
START = (0.3, -0.2, 0.4, 1.0, 0.0, 0.0, 0.0)
SETTLED = round((LIMITS.window + LIMITS.jerk_window) / LIMITS.period)

positions = st.tuples(*[st.floats(-0.5, 0.5)] * 3)
rotation_vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3)
poses = st.builds(lambda p, r: from_pose_vector((*p, *r)), positions, rotation_vectors)
streams = st.lists(st.tuples(poses, st.floats(1e-3, 0.5), st.integers(1, 120)), max_size=8)


def run(setpoints, ticks: int) -> np.ndarray:
    return np.array([setpoints.step() for _ in range(ticks)])


def rotation_rates(path: np.ndarray) -> np.ndarray:
    rotations = Rotation.from_quat(path[:, [4, 5, 6, 3]])
    return (rotations[1:] * rotations[:-1].inv()).as_rotvec() / LIMITS.period


@settings(max_examples=25, deadline=None)
@given(streams)
def test_speed_and_acceleration_stay_within_bounds_for_any_stream(stream):
    setpoints = PoseSetpoints(START, LIMITS)
    parts = [np.array([START] * 2)]
    for target, duration, ticks in stream:
        setpoints.move_to(target, duration)
        parts.append(run(setpoints, ticks))
    setpoints.stop()
    path = np.concatenate([*parts, run(setpoints, SETTLED + 1)])
    velocities = np.diff(path[:, :3], axis=0) / LIMITS.period
    accelerations = np.diff(velocities, axis=0) / LIMITS.period
    rates = rotation_rates(path)
    assert np.linalg.norm(velocities, axis=1).max() <= LIMITS.max_speed * (1 + 1e-9)
    assert np.linalg.norm(accelerations, axis=1).max() <= LIMITS.max_acceleration * (1 + 1e-6)
    # Quaternions are averaged by component: exact to second order in the turn within a window.
    assert np.linalg.norm(rates, axis=1).max() <= LIMITS.max_rotation_speed * 1.01
    angular = np.diff(rates, axis=0) / LIMITS.period
    assert np.linalg.norm(angular, axis=1).max() <= LIMITS.max_rotation_acceleration * 1.05
    assert_allclose(velocities[-1], 0.0, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(poses, st.floats(0.01, 1.0))
def test_a_target_that_stays_is_reached_exactly_and_never_passed(target, duration):
    setpoints = PoseSetpoints(START, LIMITS)
    setpoints.move_to(target, duration)
    ticks = setpoints.ticks_left
    path = run(setpoints, ticks)
    left = np.linalg.norm(path[:, :3] - target[:3], axis=1)
    assert np.diff(left).max() <= 1e-12
    angles = np.array([pose_distance(pose, target).rotation for pose in path])
    assert np.diff(angles).max() <= 1e-7
    assert_allclose(path[-1, :3], target[:3], atol=1e-12)
    assert angles[-1] < 1e-7


def test_the_first_setpoint_is_where_the_arm_stands():
    setpoints = PoseSetpoints(START, LIMITS)
    assert setpoints.setpoint == START
    assert_allclose(setpoints.step(), START, atol=1e-15)
    setpoints.move_to((0.35, -0.2, 0.4, 1.0, 0.0, 0.0, 0.0), 0.1)
    assert dist(setpoints.step()[:3], START[:3]) < 1e-5


@pytest.mark.parametrize("duration", [0.1, 0.12, 0.15])
def test_an_even_stream_of_targets_gives_an_even_speed(duration):
    setpoints = PoseSetpoints(START, LIMITS)
    parts = []
    for k in range(1, 31):
        setpoints.move_to((START[0] + 0.01 * k, *START[1:]), duration)
        parts.append(run(setpoints, 50))
    speed = np.diff(np.concatenate(parts)[:, 0]) / LIMITS.period
    steady = speed[1000:]
    assert_allclose(steady, 0.1, rtol=2e-3)


def test_late_and_early_targets_ripple_the_speed_little():
    rng = np.random.default_rng(3)
    setpoints = PoseSetpoints(START, LIMITS)
    parts = []
    for k in range(1, 61):
        setpoints.move_to((START[0] + 0.01 * k, *START[1:]), 0.12)
        parts.append(run(setpoints, int(rng.integers(45, 56))))  # 90 to 110 ms
    steady = np.diff(np.concatenate(parts)[:, 0])[1000:] / LIMITS.period
    assert np.abs(steady - 0.1).max() < 0.03
    assert steady.std() < 0.01


def test_it_trails_a_steady_motion_by_the_lag():
    setpoints = PoseSetpoints(START, LIMITS)
    setpoints.move_to((START[0] + 0.2, *START[1:]), 2.0)
    path = run(setpoints, 500)
    behind = START[0] + 0.1 * 500 * LIMITS.period - path[-1, 0]
    assert_allclose(behind / 0.1, LIMITS.lag, atol=1.1 * LIMITS.period)


def test_stop_brings_it_to_rest_in_time_without_turning_back():
    setpoints = PoseSetpoints(START, LIMITS)
    setpoints.move_to((START[0] + 0.5, *START[1:]), 2.0)
    before = run(setpoints, 300)
    setpoints.stop()
    after = run(setpoints, SETTLED + 2)
    speed = np.diff(np.concatenate([before[-1:], after])[:, 0]) / LIMITS.period
    assert speed[0] == pytest.approx(0.25, rel=1e-2)
    assert np.diff(speed).max() <= 1e-9
    assert_allclose(speed[-2:], 0.0, atol=1e-9)
    assert after[-1, 0] - before[-1, 0] <= LIMITS.max_speed * LIMITS.lag * 1.05


def test_a_new_target_replaces_the_old_one():
    setpoints = PoseSetpoints(START, LIMITS)
    setpoints.move_to((START[0] + 0.5, *START[1:]), 2.0)
    run(setpoints, 200)
    setpoints.move_to(START, 0.2)
    path = run(setpoints, 2000)
    assert_allclose(path[-1], START, atol=1e-12)
    assert path[:, 0].max() < START[0] + 0.12


def test_a_turn_takes_the_short_way_round_for_either_sign_of_the_quaternion():
    target = from_pose_vector((*START[:3], 0.0, 0.0, 0.4))
    for sign in (1.0, -1.0):
        setpoints = PoseSetpoints(START, LIMITS)
        setpoints.move_to((*target[:3], *(sign * value for value in target[3:])), 0.5)
        path = run(setpoints, 1000)
        turned = np.linalg.norm(rotation_rates(path), axis=1).sum() * LIMITS.period
        assert turned == pytest.approx(0.4, abs=1e-3)


def test_joint_setpoints_keep_their_bounds_and_arrive():
    setpoints = JointSetpoints([0.0] * 6, LIMITS)
    setpoints.move_to([1.0, -0.5, 0.2, 0.0, 0.0, 3.0], 0.1)
    path = run(setpoints, 1500)
    velocities = np.diff(path, axis=0) / LIMITS.period
    assert np.abs(velocities).max() <= LIMITS.max_joint_speed * (1 + 1e-9)
    accelerations = np.diff(velocities, axis=0) / LIMITS.period
    assert np.abs(accelerations).max() <= LIMITS.max_joint_acceleration * (1 + 1e-6)
    assert_allclose(path[-1], [1.0, -0.5, 0.2, 0.0, 0.0, 3.0], atol=1e-12)
    setpoints.move_to([0.0] * 6, 0.1)
    run(setpoints, 100)
    setpoints.stop()
    halted = run(setpoints, SETTLED + 20)
    assert_allclose(halted[-1], halted[-2], atol=1e-12)


def test_the_moving_average_is_the_mean_of_the_last_vectors():
    values = np.random.default_rng(0).normal(size=(100, 3))
    average = MovingAverage(7, (0.0, 0.0, 0.0))
    padded = np.concatenate([np.zeros((7, 3)), values])
    for k, value in enumerate(values):
        assert_allclose(average.push(tuple(value)), padded[k + 1 : k + 8].mean(axis=0), atol=1e-14)


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3), rotation_vectors)
def test_pose_vectors_there_and_back(position, rotation):
    vector = (*position, *rotation)
    numbers = from_pose_vector(vector)
    expected = Rotation.from_rotvec(rotation).as_quat(canonical=True)
    actual = np.array([*numbers[4:], numbers[3]])
    assert min(np.abs(actual - expected).max(), np.abs(actual + expected).max()) < 1e-8
    back = Rotation.from_rotvec(to_pose_vector(numbers)[3:])
    assert (back * Rotation.from_rotvec(rotation).inv()).magnitude() < 1e-7
    assert np.linalg.norm(to_pose_vector(numbers)[3:]) <= pi + 1e-9


@pytest.mark.parametrize(
    ("target", "duration", "name"),
    [
        ((0.0,) * 6, 0.1, "target"),
        ((float("nan"),) * 7, 0.1, "target"),
        (START, 0.0, "duration"),
        (START, float("inf"), "duration"),
    ],
)
def test_bad_targets_are_refused_by_name(target, duration, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        PoseSetpoints(START, LIMITS).move_to(target, duration)


def test_limits_are_positive():
    with pytest.raises(ValueError, match="max_speed: expected a positive number"):
        SetpointLimits(max_speed=0.0)
