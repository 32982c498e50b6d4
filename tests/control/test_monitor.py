"""Every violation in the readings is found and named; a clean, noisy stream has none."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.monitor import ArmReading, SafetyMonitor
from control.safety_limits import SafetyLimits
from dlo_gym.exceptions import SafetyStop
from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.ur5e import link_frames

ARMS = DualArm()
LIMITS = SafetyLimits(max_acceleration=1.0, max_rotation_acceleration=20.0)
NOW = 100.0
# Standard deviations of a UR5e's own readings: joint speed [rad/s], TCP speed [m/s, rad/s],
# force [N] and torque [N m].
NOISE = {"joint": 2e-3, "speed": 1e-3, "turn": 2e-3, "force": 1.5, "torque": 0.1}


def tcp(side: int, q: Array) -> Array:
    return link_frames(q)[6] @ ARMS.T_flange_tcp[side]


def reading(side: int, **changes) -> ArmReading:
    q = ARMS.home[side]
    values = {
        "stamp": NOW - 0.004,
        "robot_time": 7.0,
        "joint_angles": q,
        "joint_velocities": np.zeros(6),
        "T_base_tcp": tcp(side, q),
        "tcp_speed": np.zeros(6),
        "wrench": np.zeros(6),
        "safety": "normal",
        "running": True,
    }
    return ArmReading(**(values | changes))


def both(*, left=None, right=None) -> dict[str, ArmReading]:
    return {"left": reading(0, **(left or {})), "right": reading(1, **(right or {}))}


def unit(i: int, size: float) -> Array:
    return size * np.eye(6)[i]


def in_base(side: int, force: Array) -> Array:
    """A wrench of this world force, in the arm's base axes."""
    return np.concatenate([ARMS.T_world_base[side, :3, :3].T @ force, np.zeros(3)])


def towards(side: int) -> Array:
    boundary = ARMS.forward_kinematics(ARMS.home)
    gap = boundary.right[:3, 3] - boundary.left[:3, 3]
    return gap / np.linalg.norm(gap) * (1.0 if side == 0 else -1.0)


def test_arms_at_rest_break_nothing():
    assert SafetyMonitor(LIMITS, ARMS).violations(NOW, both(), {"top": NOW - 0.1}) == []
    SafetyMonitor(LIMITS).check(NOW, both())


FAULTS = [
    ({"safety": "emergency_stop"}, "emergency stop", nan, nan),
    ({"safety": "protective_stop"}, "protective stop", nan, nan),
    ({"safety": "safeguard_stop"}, "safeguard stop", nan, nan),
    ({"safety": "violation"}, "violation", nan, nan),
    ({"safety": "fault"}, "fault", nan, nan),
    ({"safety": "recovery"}, "recovery", nan, nan),
    ({"safety": "disconnected"}, "disconnected", nan, nan),
    ({"safety": "never heard of"}, "never heard of", nan, nan),
    ({"running": False}, "program", nan, nan),
    ({"stamp": NOW - 0.2}, "pose age", 0.2, 0.1),
    ({"stamp": NOW + 0.2}, "pose age", 0.2, 0.1),
    ({"tcp_speed": unit(1, -0.3)}, "speed", 0.3, 0.275),
    ({"tcp_speed": unit(4, 2.0)}, "rotation speed", 2.0, 1.65),
    ({"joint_velocities": unit(5, -4.0)}, "joint speed", 4.0, 1.1 * np.pi),
    ({"wrench": unit(2, 60.0)}, "force", 60.0, 50.0),
    ({"wrench": unit(3, 6.0)}, "torque", 6.0, 5.0),
]


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(("changes", "limit", "value", "bound"), FAULTS)
def test_one_fault_is_found_and_named(side, changes, limit, value, bound):
    arms = None if "wrench" in changes else ARMS
    readings = both(**{SIDES[side]: changes})
    with pytest.raises(SafetyStop, match=f"^{limit}") as caught:
        SafetyMonitor(LIMITS, arms).check(NOW, readings)
    stop = caught.value
    assert stop.limit == limit
    np.testing.assert_allclose([stop.value, stop.bound], [value, bound], rtol=1e-6)
    assert SIDES[side] in str(stop)
    assert SIDES[1 - side] not in str(stop)
    if not np.isnan(bound):
        assert f"at most {bound:.4g}" in str(stop)
    (only,) = SafetyMonitor(LIMITS, arms).violations(NOW, readings)
    assert only.limit == limit


@pytest.mark.parametrize(
    ("changes", "limits"),
    [
        ({"stamp": nan}, {"pose age"}),
        ({"wrench": np.full(6, nan)}, {"force", "torque", "tension"}),
        ({"tcp_speed": np.full(6, nan)}, {"speed", "rotation speed"}),
        ({"joint_velocities": np.full(6, nan)}, {"joint speed"}),
        ({"T_base_tcp": np.full((4, 4), nan)}, {"overstretch", "gripper distance", "tension"}),
    ],
)
def test_what_is_no_number_never_passes(changes, limits):
    found = SafetyMonitor(LIMITS, ARMS).violations(NOW, both(right=changes))
    assert limits <= {violation.limit for violation in found}


def test_a_missing_arm_and_cameras_that_are_late_or_silent_are_found():
    monitor = SafetyMonitor(LIMITS)
    with pytest.raises(SafetyStop, match=r"right arm.*at most 0\.1 s"):
        monitor.check(NOW, {"left": reading(0)})
    stamps = {"top": NOW - 0.1, "side": NOW - 0.7, "wrist": nan}
    found = monitor.violations(NOW, both(), stamps)
    assert [(v.limit, v.what) for v in found] == [
        ("image age", "camera side"),
        ("image age", "camera wrist"),
    ]
    assert "0.7 s, at most 0.5 s" in str(found[0])


def test_a_standing_program_is_no_fault_while_nothing_is_controlled():
    readings = both(left={"running": False})
    SafetyMonitor(LIMITS).check(NOW, readings, controlling=False)


@pytest.mark.parametrize("side", [0, 1])
def test_reduced_mode_is_no_fault(side):
    SafetyMonitor(LIMITS).check(NOW, both(**{SIDES[side]: {"safety": "reduced"}}))


def test_the_gravest_comes_first_and_the_others_are_told():
    readings = both(
        left={"tcp_speed": unit(0, 0.5), "safety": "protective_stop", "running": False},
        right={"safety": "emergency_stop", "stamp": NOW - 1.0},
    )
    with pytest.raises(SafetyStop) as caught:
        SafetyMonitor(LIMITS, ARMS).check(NOW, readings, {"top": 0.0})
    assert caught.value.limit == "emergency stop"
    found = SafetyMonitor(LIMITS, ARMS).violations(NOW, readings, {"top": 0.0})
    assert [violation.limit for violation in found] == [
        "emergency stop", "protective stop", "pose age", "program", "speed", "image age",
    ]  # fmt: skip
    for violation in found:
        assert str(violation) in str(caught.value)


def test_readings_that_arrive_anew_but_are_old_are_stale():
    """As from a client that returns its last values after the stream froze."""
    monitor = SafetyMonitor(LIMITS)
    for i in range(6):
        now = NOW + 0.02 * i
        fresh = {side: reading(k, stamp=now) for k, side in enumerate(SIDES)}
        fresh["left"] = replace(fresh["left"], robot_time=7.0 + 0.02 * i)
        monitor.check(now, fresh)
    late = {side: reading(k, stamp=NOW + 0.2, robot_time=7.1) for k, side in enumerate(SIDES)}
    late["left"] = replace(late["left"], robot_time=7.2)
    late["right"] = replace(late["right"], robot_time=7.0)
    with pytest.raises(SafetyStop, match="right arm's clock stands still"):
        monitor.check(NOW + 0.2, late)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("pull", [1.0, -1.0])
def test_a_pull_along_the_rod_is_tension(side, pull):
    wrench = in_base(side, 30.0 * pull * towards(side))
    found = SafetyMonitor(LIMITS, ARMS).violations(NOW, both(**{SIDES[side]: {"wrench": wrench}}))
    assert [(v.limit, v.what) for v in found] == [("tension", f"{SIDES[side]} gripper")]
    assert found[0].value == pytest.approx(30.0)


def test_a_push_across_the_rod_is_not_tension():
    wrench = in_base(0, 30.0 * np.cross(towards(0), [0.0, 0.0, 1.0]))
    assert SafetyMonitor(LIMITS, ARMS).violations(NOW, both(left={"wrench": wrench})) == []


def test_the_tare_is_taken_off():
    weight = np.array([0.0, 0.0, -60.0, 0.0, 8.0, 0.0])
    monitor = SafetyMonitor(LIMITS, ARMS)
    loaded = both(left={"wrench": weight})
    assert {v.limit for v in monitor.violations(NOW, loaded)} == {"force", "torque"}
    several = [replace(loaded["left"], wrench=weight + unit(2, d)) for d in (-1.0, 1.0)]
    monitor.tare({"left": several, "right": loaded["right"]})
    assert monitor.violations(NOW, loaded) == []
    assert {v.limit for v in monitor.violations(NOW, both())} == {"force", "torque"}


def test_measured_distance_between_the_grippers():
    far = ARMS.home.copy()
    boundary = ARMS.forward_kinematics(far)
    bound = boundary.distance / (1.0 - 0.5 * 0.02)
    fits = SafetyMonitor(replace(LIMITS, rod_length=bound * 1.0001), ARMS)
    assert fits.violations(NOW, both()) == []
    short = SafetyMonitor(replace(LIMITS, rod_length=bound * 0.9999), ARMS)
    (found,) = short.violations(NOW, both())
    assert (found.limit, found.value) == ("overstretch", pytest.approx(boundary.distance))
    near = SafetyMonitor(replace(LIMITS, min_gripper_distance=0.46), ARMS)
    (found,) = near.violations(NOW, both())
    assert (found.limit, found.bound) == ("gripper distance", pytest.approx(0.9 * 0.46))


def test_measured_clearance():
    between = ARMS.clearance(ARMS.home).between_arms
    monitor = SafetyMonitor(replace(LIMITS, min_arm_clearance=2.1 * between), ARMS)
    found = monitor.violations(NOW, both())
    assert {v.limit for v in found} == {"clearance"}
    (arms,) = [v for v in found if v.what == "between the arms"]
    assert (arms.value, arms.at_least) == (pytest.approx(between), True)
    broken = both(left={"joint_angles": np.full(6, nan)})
    assert "joint angles" in {v.limit for v in monitor.violations(NOW, broken)}


def test_readings_of_different_stamps_are_compared_at_one_time():
    """Both grippers move along x at 0.2 m/s; the left one's reading is 80 ms older."""
    distance = ARMS.forward_kinematics(ARMS.home).distance
    limits = replace(LIMITS, rod_length=(distance + 0.002) / 0.99)
    pose = tcp(0, ARMS.home[0])
    earlier = pose.copy()
    speed = np.concatenate([0.2 * ARMS.T_world_base[0, :3, :3].T @ [1.0, 0, 0], np.zeros(3)])
    earlier[:3, 3] -= 0.08 * speed[:3]
    left = {"stamp": NOW - 0.08, "T_base_tcp": earlier, "tcp_speed": speed}
    at_once = both(left=left, right={"stamp": NOW})
    assert SafetyMonitor(limits, ARMS).violations(NOW, at_once) == []
    same_stamp = both(left=left | {"stamp": NOW}, right={"stamp": NOW})
    assert [v.limit for v in SafetyMonitor(limits, ARMS).violations(NOW, same_stamp)] == [
        "overstretch"
    ]


def stream(rate: float, seconds: float, velocity, rng: np.random.Generator, noise: float = 1.0):
    """Readings of both arms whose TCPs move with ``velocity(t)`` (m, 3) [m/s], with noise."""
    times = np.arange(0.0, seconds, 1.0 / rate)
    speeds = np.zeros((len(times), 6))
    speeds[:, :3] = velocity(times)
    scale = [NOISE["speed"]] * 3 + [NOISE["turn"]] * 3
    for t, speed in zip(times, speeds, strict=True):
        readings = {}
        for side, name in enumerate(SIDES):
            readings[name] = reading(
                side,
                stamp=NOW + t - abs(rng.normal(0.0, 5e-4)),
                robot_time=7.0 + t,
                joint_velocities=rng.normal(0.0, NOISE["joint"] * noise, 6),
                tcp_speed=speed + rng.normal(0.0, noise, 6) * scale,
                wrench=rng.normal(0.0, noise, 6) * ([NOISE["force"]] * 3 + [NOISE["torque"]] * 3),
            )
        yield NOW + t, readings


def swinging(acceleration: float, speed: float):
    def velocity(times: Array) -> Array:
        return np.outer(speed * np.sin(acceleration / speed * times), [1.0, 0.0, 0.0])

    return velocity


@pytest.mark.parametrize("rate", [500.0, 50.0, 10.0])
def test_a_clean_noisy_stream_breaks_nothing(rate):
    """At the commands' own top speed and 90 % of their acceleration."""
    monitor = SafetyMonitor(LIMITS)
    rng = np.random.default_rng(0)
    for now, readings in stream(rate, 6.0, swinging(0.9, 0.25), rng):
        assert monitor.violations(now, readings, {"top": now - 0.08}) == []


def test_the_same_stream_with_arms_breaks_nothing():
    monitor = SafetyMonitor(LIMITS, ARMS)
    for now, readings in stream(500.0, 1.0, swinging(0.9, 0.25), np.random.default_rng(1)):
        assert monitor.violations(now, readings) == []


@pytest.mark.parametrize("rate", [500.0, 50.0, 10.0])
def test_too_high_an_acceleration_is_found_within_two_control_periods(rate):
    def braking(times: Array) -> Array:
        return np.outer(0.2 - 1.5 * np.clip(times - 0.5, 0.0, 0.25), [0.0, 1.0, 0.0])

    monitor = SafetyMonitor(LIMITS)
    for now, readings in stream(rate, 1.0, braking, np.random.default_rng(2)):
        found = monitor.violations(now, readings)
        if found:
            assert found[0].limit == "acceleration"
            assert found[0].value > found[0].bound == pytest.approx(1.1)
            break
    assert NOW + 0.5 < now <= NOW + 0.7


def test_a_controller_started_anew_gives_no_false_acceleration_and_hides_no_true_one():
    monitor = SafetyMonitor(LIMITS)
    for now, readings in stream(500.0, 0.2, swinging(0.9, 0.25), np.random.default_rng(3)):
        assert monitor.violations(now, readings) == []

    def later(t: float, speed: float) -> set[str]:
        restarted = {
            side: reading(k, stamp=NOW + t, robot_time=t - 0.3, tcp_speed=unit(0, speed))
            for k, side in enumerate(SIDES)
        }
        return {violation.limit for violation in monitor.violations(NOW + t, restarted)}

    for t in (0.3, 0.302, 0.34, 0.4):
        assert later(t, -0.2) == set()
    assert later(0.45, 0.2) == {"acceleration"}


@pytest.mark.parametrize("pause", [0.5, 3.0])
def test_no_slope_reaches_across_a_pause(pause):
    monitor = SafetyMonitor(replace(LIMITS, max_acceleration=0.05))
    for t, speed in ((0.0, 0.0), (0.05, 0.0), (0.05 + pause, 0.2), (0.1 + pause, 0.2)):
        at = {
            side: reading(k, stamp=NOW + t, robot_time=t, tcp_speed=unit(0, speed))
            for k, side in enumerate(SIDES)
        }
        assert monitor.violations(NOW + t, at) == []


numbers = st.floats(-3.0, 3.0)


@settings(max_examples=150, deadline=None)
@given(
    st.floats(-0.5, 0.5),
    st.lists(numbers, min_size=6, max_size=6),
    st.lists(numbers, min_size=6, max_size=6),
    st.lists(numbers, min_size=6, max_size=6),
)
def test_exactly_what_is_beyond_its_bound_is_found(age, speed, joints, wrench):
    """An oracle of one line per limit."""
    twist = 0.1 * np.array(speed)
    felt = 20.0 * np.array(wrench)
    rates = 1.5 * np.array(joints)
    motion = {"tcp_speed": twist, "joint_velocities": rates}
    changed = both(left=motion | {"stamp": NOW - age, "wrench": felt})
    expected = {
        "pose age": abs(age) > 0.1,
        "speed": np.linalg.norm(twist[:3]) > 0.275,
        "rotation speed": np.linalg.norm(twist[3:]) > 1.65,
        "force": np.linalg.norm(felt[:3]) > 50.0,
        "torque": np.linalg.norm(felt[3:]) > 5.0,
        "joint speed": np.abs(rates).max() > 1.1 * np.pi,
    }
    found = {v.limit for v in SafetyMonitor(LIMITS).violations(NOW, changed)}
    assert found == {limit for limit, broken in expected.items() if broken}


def test_infinite_limits_are_off():
    off = replace(LIMITS, max_force=inf, max_torque=inf, max_tension=inf)
    assert SafetyMonitor(off, ARMS).violations(NOW, both(left={"wrench": unit(2, 1e4)})) == []
