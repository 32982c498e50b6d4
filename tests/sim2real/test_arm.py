"""The simulated arm: where it goes, when it refuses, how it stops. The clock is the test's own."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from control.monitor import ArmReading
from dlo_gym.exceptions import DeviceError, SafetyStop, UnreachablePose
from dlo_gym.geometry.se3 import exp_so3, log_so3
from dlo_gym.scene.arms import T_FLANGE_TCP, DualArm
from sim2real.arm import Arm, SimulatedArm
from sim2real.ur5e.kinematics import tcp_poses

HOME = DualArm().home[0]
T_HOME = tcp_poses(HOME, T_FLANGE_TCP)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def arm(clock) -> SimulatedArm:
    arm = SimulatedArm("left", HOME, clock=clock, sleep=clock.sleep)
    arm.connect(control=True)
    return arm


def moved(by, turn=(0.0, 0.0, 0.0)) -> np.ndarray:
    target = T_HOME.copy()
    target[:3, 3] += by
    target[:3, :3] = exp_so3(turn) @ target[:3, :3]
    return target


def stream(arm, clock, steps: int, step=(0.01, 0.0, 0.0), period=0.1) -> ArmReading:
    for k in range(1, steps + 1):
        arm.servo_to(moved(k * np.array(step)), period)
        clock.sleep(period)
    return arm.reading()


def test_it_is_an_arm(arm):
    assert isinstance(arm, Arm)


def test_it_reaches_a_target_and_returns_what_it_accepted(arm, clock):
    target = moved([0.02, -0.01, 0.03], [0.1, 0.0, -0.05])
    assert_array_equal(arm.servo_to(target, 0.2), target)
    clock.sleep(1.0)
    reading = arm.reading()
    assert_allclose(reading.T_base_tcp, target, atol=1e-6)
    assert_allclose(tcp_poses(reading.joint_angles, T_FLANGE_TCP), target, atol=1e-6)
    assert_allclose(reading.joint_velocities, 0.0, atol=1e-4)


def test_nothing_moves_before_a_command_and_nothing_jumps_after(arm, clock):
    clock.sleep(5.0)
    assert_allclose(arm.reading().T_base_tcp, T_HOME, atol=1e-12)
    arm.servo_to(moved([0.03, 0, 0]), 0.1)
    clock.sleep(1.0)
    path = np.array([r.T_base_tcp[:3, 3] for r in arm.readings(104.9)])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.25 * 0.0081


def test_readings_are_the_history_after_a_stamp_oldest_first(arm, clock):
    clock.sleep(1.0)
    arm.reading()
    clock.sleep(2.0)
    stamps = np.array([reading.stamp for reading in arm.readings(100.5)])
    assert stamps[0] > 100.5
    assert stamps[-1] == pytest.approx(103.0, abs=0.009)
    assert (np.diff(stamps) > 0).all()
    assert np.diff(stamps).max() < 0.009


def test_the_reported_velocities_are_those_of_the_motion(arm, clock):
    reading = stream(arm, clock, 10)
    assert_allclose(reading.tcp_speed[:3], [0.1, 0.0, 0.0], atol=3e-3)
    before, after = arm.readings(reading.stamp - 0.1)[:: len(arm.readings(reading.stamp - 0.1)) - 1]
    slope = (after.joint_angles - before.joint_angles) / (after.stamp - before.stamp)
    assert_allclose(reading.joint_velocities, slope, atol=0.02)


def test_stop_comes_to_rest_and_the_next_target_starts_from_there(arm, clock):
    stream(arm, clock, 10)
    arm.stop()
    arm.stop()
    clock.sleep(0.5)
    halted = arm.reading()
    clock.sleep(0.5)
    assert_allclose(arm.reading().T_base_tcp, halted.T_base_tcp, atol=1e-6)
    travelled = halted.T_base_tcp[0, 3] - T_HOME[0, 3]
    assert travelled < 0.1 + 1e-9
    arm.servo_to(halted.T_base_tcp, 0.1)
    clock.sleep(0.5)
    assert_allclose(arm.reading().T_base_tcp, halted.T_base_tcp, atol=1e-6)


def test_a_jump_is_refused_with_value_and_bound(arm):
    with pytest.raises(DeviceError, match=r"0\.06 m from .* at most 0\.05 m"):
        arm.servo_to(moved([0.06, 0, 0]), 0.1)
    with pytest.raises(DeviceError, match=r"0\.5 rad from .* at most 0\.4 rad"):
        arm.servo_to(moved([0, 0, 0], [0, 0, 0.5]), 0.1)
    arm.servo_to(moved([0.049, 0, 0]), 0.1)


def test_an_unreachable_pose_is_refused_and_the_arm_stays(arm, clock):
    arm = SimulatedArm("left", HOME, clock=clock, sleep=clock.sleep, max_step=0.5)
    arm.connect(control=True)
    out = T_HOME.copy()
    direction = out[:3, 3] / np.linalg.norm(out[:3, 3])
    for reach in (0.05, 0.1, 0.15):
        out[:3, 3] = T_HOME[:3, 3] + reach * direction
        arm.servo_to(out, 0.1)
        clock.sleep(1.0)
    reached = out.copy()
    out[:3, 3] = T_HOME[:3, 3] + 0.64 * direction
    with pytest.raises(UnreachablePose, match="left arm cannot reach"):
        arm.servo_to(out, 0.1)
    clock.sleep(1.0)
    assert_allclose(arm.reading().T_base_tcp, reached, atol=1e-6)


@pytest.mark.parametrize("safety", ["protective_stop", "emergency_stop"])
def test_after_a_stop_nothing_moves_until_recover_and_then_from_the_present_pose(
    arm, clock, safety
):
    stream(arm, clock, 5)
    arm.set_safety(safety)
    halted = arm.reading()
    assert halted.safety == safety
    assert not halted.running
    with pytest.raises(SafetyStop, match=safety.replace("_", " ")):
        arm.servo_to(halted.T_base_tcp, 0.1)
    with pytest.raises(SafetyStop, match="release"):
        arm.recover()
    arm.set_safety("normal")  # released, but not recovered
    with pytest.raises(SafetyStop, match="recover"):
        arm.servo_to(halted.T_base_tcp, 0.1)
    arm.recover()
    clock.sleep(1.0)
    assert_allclose(arm.reading().T_base_tcp, halted.T_base_tcp, atol=1e-12)
    arm.servo_to(halted.T_base_tcp, 0.1)


def test_recover_releases_a_protective_stop_only_where_allowed(clock):
    arm = SimulatedArm("left", HOME, clock=clock, unlock_protective_stop=True)
    arm.connect(control=True)
    arm.set_safety("protective_stop")
    arm.recover()
    assert arm.reading().safety == "normal"
    arm.set_safety("emergency_stop")
    with pytest.raises(SafetyStop):
        arm.recover()


def test_move_to_arrives_at_pose_and_at_joint_angles_within_the_speed(arm, clock):
    goal = HOME + np.array([0.3, -0.2, 0.1, 0.0, 0.2, -0.4])
    began = clock.now
    arm.move_to(goal, speed=0.5)
    assert clock.now - began == pytest.approx(0.4 / 0.5 + 0.5, abs=0.05)
    assert_allclose(arm.reading().joint_angles, goal, atol=1e-12)
    speeds = [np.abs(r.joint_velocities).max() for r in arm.readings(began)]
    assert max(speeds) <= 0.5 + 1e-6
    arm.move_to(T_HOME, speed=0.5)
    assert_allclose(arm.reading().T_base_tcp, T_HOME, atol=1e-9)


def test_stop_breaks_a_move_off(arm, clock):
    def sleep(seconds: float) -> None:
        clock.now += seconds
        if clock.now > 100.5:
            arm.stop()

    arm._sleep = sleep
    with pytest.raises(DeviceError, match="stop\\(\\) was called"):
        arm.move_to(HOME + 1.0, speed=0.5)
    halted = arm.reading().joint_angles
    assert_allclose(halted, HOME + 0.125, atol=0.02)  # half a second of acceleration
    clock.now += 1.0
    assert_allclose(arm.reading().joint_angles, halted, atol=1e-12)


def test_a_long_pause_of_the_caller_costs_little_and_ends_at_the_target(arm, clock):
    target = moved([0.04, 0, 0])
    arm.servo_to(target, 0.1)
    clock.sleep(3600.0)
    assert_allclose(arm.reading().T_base_tcp, target, atol=1e-9)
    assert arm.reading().stamp == pytest.approx(clock.now, abs=0.01)


def test_listening_reads_and_refuses_to_move(clock):
    arm = SimulatedArm("right", HOME, clock=clock)
    with pytest.raises(DeviceError, match="right arm is not connected"):
        arm.reading()
    arm.connect(control=False)
    assert not arm.reading().running
    with pytest.raises(DeviceError, match="only listens"):
        arm.servo_to(T_HOME, 0.1)
    with pytest.raises(DeviceError, match="only listens"):
        arm.move_to(HOME, 0.1)
    arm.close()
    arm.close()
    arm.stop()


def test_wrench_is_what_was_set(arm):
    arm.set_wrench([1, 2, 3, 0.1, 0.2, 0.3])
    arm._clock.sleep(0.1)
    assert_array_equal(arm.reading().wrench, [1, 2, 3, 0.1, 0.2, 0.3])


def test_bad_arguments_are_refused_by_name(arm):
    with pytest.raises(ValueError, match="^T_base_tcp: expected"):
        arm.servo_to(np.eye(3), 0.1)
    with pytest.raises(ValueError, match="^duration: expected"):
        arm.servo_to(T_HOME, -1.0)
    with pytest.raises(ValueError, match="^target: expected"):
        arm.move_to(np.full(6, np.nan), 0.1)
    with pytest.raises(ValueError, match="^speed: expected"):
        arm.move_to(HOME, 0.0)
    with pytest.raises(ValueError, match="^joint_angles: expected"):
        SimulatedArm("left", np.zeros(5))


def test_rotation_only_targets_keep_the_tcp_in_place(arm, clock):
    arm.servo_to(moved([0, 0, 0], [0.0, 0.3, 0.0]), 0.3)
    clock.sleep(1.0)
    path = arm.readings(100.0)
    assert max(np.linalg.norm(r.T_base_tcp[:3, 3] - T_HOME[:3, 3]) for r in path) < 1.5e-3
    turned = log_so3(path[-1].T_base_tcp[:3, :3] @ T_HOME[:3, :3].T)
    assert_allclose(turned, [0.0, 0.3, 0.0], atol=1e-5)
