"""Whatever command comes in, what comes out satisfies every limit."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from control.safety import SafetyDecision, SafetyGate, SafetyLimits, Violation
from dlo_gym.exceptions import SafetyStop
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses

LIMITS = SafetyLimits(workspace=((-0.4, -0.25, 0.2), (0.4, 0.25, 0.55)))
ROUNDING = 1.0 + 1.1e-6

numbers = st.one_of(
    st.floats(-0.02, 0.02),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-300, 1e308, -1e308, 0.01, -0.01, pi, 2 * pi]),
)
commands = st.lists(numbers, min_size=12, max_size=12).map(BoundaryDisplacement.from_vector)
inside = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.25, 0.25), st.floats(0.2, 0.55))
rotation_vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


def boundary_at(left, right, left_rotation=(0, 0, 0), right_rotation=(0, 0, 0)) -> BoundaryPoses:
    return BoundaryPoses(pose(exp_so3(left_rotation), left), pose(exp_so3(right_rotation), right))


START = boundary_at((-0.2, 0.0, 0.34), (0.2, 0.0, 0.34))


@st.composite
def poses_within_limits(draw) -> BoundaryPoses:
    """Poses inside every limit; often exactly on one."""
    left, right = np.array(draw(inside)), np.array(draw(inside))
    gap = right - left
    distance = float(np.linalg.norm(gap))
    if distance < 1e-3:
        gap, distance = np.array([1.0, 0.0, 0.0]), 1.0
    shortest, longest = LIMITS.min_gripper_distance, LIMITS.max_gripper_distance
    choice = draw(st.sampled_from(["as drawn", "stretched", "close"]))
    wanted = {"stretched": longest, "close": shortest}.get(choice, distance)
    wanted = min(max(wanted, shortest), longest)
    # Moves both towards the middle of the workspace first, so that both fit in.
    middle = np.array([0.0, 0.0, 0.375])
    half = 0.5 * wanted * gap / distance
    scale = min(1.0, float(np.min(np.array([0.4, 0.25, 0.175]) / np.maximum(abs(half), 1e-9))))
    half *= scale if wanted * scale >= shortest else 1.0
    room = np.maximum(np.array([0.4, 0.25, 0.175]) - abs(half), 0.0)
    centre = middle + np.clip(0.5 * (left + right) - middle, -room, room)
    return boundary_at(centre - half, centre + half, draw(rotation_vectors), draw(rotation_vectors))


def assert_within_limits(
    before: BoundaryPoses, decision: SafetyDecision, limits: SafetyLimits
) -> None:
    """Within the limits, or no further outside than before."""
    steps = np.linalg.norm(decision.displacement.vector.reshape(2, 2, 3), axis=2)
    assert steps[:, 0].max() <= limits.translation_step * ROUNDING
    assert steps[:, 1].max() <= limits.rotation_step * ROUNDING
    after = decision.target
    origins = np.array([after.left[:3, 3], after.right[:3, 3]])
    former = np.array([before.left[:3, 3], before.right[:3, 3]])
    lower, upper = np.asarray(limits.workspace)
    assert (origins >= np.minimum(lower, former) - 1e-12).all()
    assert (origins <= np.maximum(upper, former) + 1e-12).all()
    assert after.distance <= max(limits.max_gripper_distance, before.distance) * ROUNDING
    assert after.distance >= min(limits.min_gripper_distance, before.distance) - 1e-9
    for point, normal in limits.planes:
        unit = np.asarray(normal) / np.linalg.norm(normal)
        assert ((origins - point) @ unit >= np.minimum((former - point) @ unit, 0) - 1e-9).all()


@settings(max_examples=300, deadline=None)
@given(poses_within_limits(), commands)
def test_no_command_leaves_the_limits(boundary, command):
    decision = SafetyGate(LIMITS).check(command, boundary)
    assert_within_limits(boundary, decision, LIMITS)
    if not decision.was_cut:
        assert_array_equal(decision.displacement.vector, command.vector)


@settings(max_examples=150, deadline=None)
@given(inside, inside, commands)
def test_poses_outside_a_limit_never_get_worse(left, right, command):
    tight = replace(LIMITS, workspace=((-0.1, -0.1, 0.3), (0.1, 0.1, 0.4)), rod_length=0.3)
    boundary = boundary_at(left, right)
    decision = SafetyGate(tight).check(command, boundary)
    assert_within_limits(boundary, decision, tight)


@settings(max_examples=60, deadline=None)
@given(st.lists(commands, min_size=2, max_size=15), st.booleans())
def test_sequences_stay_within_the_limits(sequence, alternate):
    gate, boundary = SafetyGate(LIMITS), START
    for i, command in enumerate(sequence):
        if alternate and i % 2:
            command = sequence[i - 1].scaled(-1.0)
        decision = gate.check(command, boundary)
        assert_within_limits(boundary, decision, LIMITS)
        boundary = decision.target


@settings(max_examples=100, deadline=None)
@given(commands, st.lists(st.floats(-0.02, 0.02), min_size=12, max_size=12))
def test_the_step_counts_from_the_last_command_sent(command, lag):
    gate = SafetyGate(LIMITS)
    sent = gate.check(BoundaryDisplacement.zero(), START).target
    measured = START.displaced(BoundaryDisplacement.from_vector(lag))
    decision = gate.check(command, measured)
    step = sent.displacement_to(decision.target).vector.reshape(2, 2, 3)
    assert np.linalg.norm(step[:, 0], axis=1).max() <= LIMITS.translation_step * ROUNDING
    assert np.linalg.norm(step[:, 1], axis=1).max() <= LIMITS.rotation_step * ROUNDING
    again = measured.displaced(decision.displacement)
    assert_allclose(again.left, decision.target.left, atol=1e-9)
    assert_allclose(again.right, decision.target.right, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(commands)
def test_a_command_cut_by_the_step_keeps_its_direction(command):
    decision = SafetyGate(replace(LIMITS, rod_length=5.0, min_gripper_distance=0.0)).check(
        command, boundary_at((-0.2, 0.0, 0.34), (0.2, 0.0, 0.34))
    )
    largest = np.abs(command.vector).max()
    if largest == 0.0:
        return
    asked = command.vector / largest
    fraction = decision.displacement.vector @ asked / (asked @ asked)
    assert_allclose(decision.displacement.vector, fraction * asked, atol=1e-15, rtol=1e-9)


PLANES = (((0.0, 0.1, 0.0), (0.0, -1.0, 0.0)), ((0.0, 0.0, 0.3), (0.3, 0.0, 2.0)))


@settings(max_examples=150, deadline=None)
@given(inside, inside, commands)
def test_no_command_crosses_a_plane(left, right, command):
    limits = replace(LIMITS, planes=PLANES)
    boundary = boundary_at(left, right)
    assert_within_limits(boundary, SafetyGate(limits).check(command, boundary), limits)


def test_at_a_plane_the_command_slides_along_it():
    limits = replace(LIMITS, planes=(((0.0, 0.0, 0.3), (0.0, 0.0, 2.0)),))
    on_it = boundary_at((-0.2, 0.0, 0.3), (0.2, 0.0, 0.34))
    decision = SafetyGate(limits).check(moved(left=(0.004, 0, -0.004)), on_it)
    assert decision.reasons == ("plane",)
    assert_allclose(decision.displacement.left[:3], [0.004, 0, 0], atol=1e-9)
    assert decision.cuts[0].value == pytest.approx(-0.004)
    assert decision.cuts[0].bound == pytest.approx(0.0)


ACCELERATION = replace(LIMITS, max_acceleration=0.3, max_rotation_acceleration=2.0)


@settings(max_examples=60, deadline=None)
@given(st.lists(commands, min_size=3, max_size=10))
def test_velocities_change_by_no_more_than_the_acceleration_unless_they_shrink(sequence):
    gate, boundary = SafetyGate(ACCELERATION), START
    before = np.zeros((2, 2, 3))
    bounds = np.array([0.3, 2.0]) * ACCELERATION.control_period**2
    for command in sequence:
        decision = gate.check(command, boundary)
        assert_within_limits(boundary, decision, ACCELERATION)
        step = decision.displacement.vector.reshape(2, 2, 3)
        # The nearest of many points between the former velocity and standing still.
        between = before * np.linspace(0.0, 1.0, 2001)[:, None, None, None]
        change = np.linalg.norm(step - between, axis=3).min(axis=0)
        assert (change <= bounds * (1 + 1e-5) + np.linalg.norm(before, axis=2) / 4000).all()
        boundary, before = decision.target, step


def test_a_start_is_slow_a_stop_is_at_once_and_a_turn_waits():
    gate = SafetyGate(ACCELERATION)
    forwards = moved(left=(0.01, 0, 0), right=(0.01, 0, 0))
    steps, boundary = [], START
    for command in (forwards, forwards, forwards, forwards.scaled(-1.0), forwards.scaled(0.0)):
        decision = gate.check(command, boundary)
        steps.append(decision.displacement.left[0])
        boundary = decision.target
        if command is forwards and len(steps) < 3:
            assert decision.reasons == ("acceleration",)
    assert_allclose(steps, [0.003, 0.006, 0.009, -0.003, 0.0], atol=1e-8)
    gate.reset()
    assert gate.check(forwards, boundary).displacement.left[0] == pytest.approx(0.003)


def test_cuts_name_limit_value_and_bound():
    near = boundary_at((-0.2, 0.0, 0.202), (0.2, 0.0, 0.34))
    decision = SafetyGate(LIMITS).check(moved(left=(0.004, 0, -0.006)), near)
    (cut,) = decision.cuts
    assert (cut.limit, cut.what, cut.unit) == ("workspace", "left clamp's z", "m")
    assert cut.value == pytest.approx(0.196)
    assert cut.bound == pytest.approx(0.2)
    assert str(cut) == "workspace: left clamp's z 0.196 m, at least 0.2 m"
    assert str(cut) in str(decision)
    assert str(decision).startswith("left [1.3, 0.0, -2.0] mm")


def test_values_close_to_the_bound_are_told_from_it():
    assert "0.400004 m, at most 0.4 m" in str(Violation("w", "z", 0.4000040001, 0.4, "m"))


def test_the_stop_says_limit_value_and_bound():
    gate = SafetyGate(LIMITS)
    gate.check(BoundaryDisplacement.zero(), START)
    with pytest.raises(SafetyStop) as caught:
        gate.check(BoundaryDisplacement.zero(), START.displaced(moved(left=(0, 0, 0.1))))
    assert caught.value.limit == "deviation"
    assert caught.value.value == pytest.approx(0.1)
    assert caught.value.bound == LIMITS.max_deviation


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(bad):
    command = BoundaryDisplacement.zero()
    command.right[4] = bad
    with pytest.raises(SafetyStop, match="finite"):
        SafetyGate(LIMITS).check(command, START)


def test_a_command_within_the_limits_passes_unchanged():
    vector = np.array([0.01, 0.01, -0.01, 0.0, 0.05, 0.0, -0.01, 0.0, 0.0, 0.05, 0.0, 0.0])
    decision = SafetyGate(LIMITS).check(BoundaryDisplacement.from_vector(vector), START)
    assert decision.reasons == ()
    assert_array_equal(decision.displacement.vector, vector)


def test_speed_limits_the_step():
    slow = replace(LIMITS, max_speed=0.02, control_period=0.1)
    decision = SafetyGate(slow).check(BoundaryDisplacement.from_vector([0.01, *[0.0] * 11]), START)
    assert decision.reasons == ("translation step",)
    assert decision.displacement.left[0] == pytest.approx(0.002)


def moved(*, left=(0, 0, 0), right=(0, 0, 0)) -> BoundaryDisplacement:
    return BoundaryDisplacement.from_vector([*left, 0, 0, 0, *right, 0, 0, 0])


def test_a_stretched_rod_may_shorten_but_not_lengthen():
    taut = boundary_at((-0.25, 0.0, 0.34), (0.25, 0.0, 0.34))
    shorter = SafetyGate(LIMITS).check(moved(right=(-0.005, 0, 0)), taut)
    assert shorter.reasons == ()
    longer = SafetyGate(LIMITS).check(moved(right=(0.005, 0, 0)), taut)
    assert longer.reasons == ("overstretch",)
    assert_allclose(longer.displacement.vector, 0.0, atol=1e-9)


def test_a_stretched_rod_may_be_moved_and_turned():
    half = LIMITS.max_gripper_distance / 2
    taut = boundary_at((-half, 0.0, 0.34), (half, 0.0, 0.34))
    both = SafetyGate(LIMITS).check(moved(left=(0, 0.005, 0), right=(0, 0.005, 0)), taut)
    assert both.reasons == ()
    turned = SafetyGate(LIMITS).check(moved(left=(0, -0.005, 0), right=(0, 0.005, 0)), taut)
    assert turned.reasons == ("overstretch",)
    assert turned.displacement.right[1] == pytest.approx(0.005, rel=0.01)


def test_at_a_wall_the_command_slides_along_it():
    wall = boundary_at((-0.2, 0.0, 0.2), (0.2, 0.0, 0.34))
    decision = SafetyGate(LIMITS).check(moved(left=(0.004, 0, -0.004), right=(0, 0.005, 0)), wall)
    assert decision.reasons == ("workspace",)
    assert_allclose(decision.displacement.left[:3], [0.004, 0, 0], atol=1e-9)
    assert_allclose(decision.displacement.right[:3], [0, 0.005, 0], atol=1e-9)


def test_before_a_wall_the_command_is_cut_along_its_own_direction():
    near = boundary_at((-0.2, 0.0, 0.202), (0.2, 0.0, 0.34))
    decision = SafetyGate(LIMITS).check(moved(left=(0.004, 0, -0.004), right=(0, 0.006, 0)), near)
    assert decision.reasons == ("workspace",)
    assert_allclose(decision.displacement.vector[[0, 2, 7]], [0.002, -0.002, 0.003], atol=1e-9)


def test_grippers_keep_their_distance():
    close = boundary_at((0.0, 0.0, 0.34), (LIMITS.min_gripper_distance + 1e-3, 0.0, 0.34))
    decision = SafetyGate(LIMITS).check(moved(left=(0.005, 0, 0), right=(-0.005, 0, 0)), close)
    assert decision.reasons == ("gripper distance",)
    assert decision.target.distance == pytest.approx(LIMITS.min_gripper_distance, abs=1e-9)


def test_arms_moved_by_others_stop_the_gate_until_it_is_reset():
    gate = SafetyGate(LIMITS)
    gate.check(BoundaryDisplacement.zero(), START)
    elsewhere = START.displaced(moved(left=(0, 0, 0.1)))
    with pytest.raises(SafetyStop, match=r"100\.0 mm"):
        gate.check(BoundaryDisplacement.zero(), elsewhere)
    turned = START.displaced(BoundaryDisplacement.from_vector([*[0] * 9, 0.6, 0, 0]))
    with pytest.raises(SafetyStop, match="degrees"):
        gate.check(BoundaryDisplacement.zero(), turned)
    gate.reset()
    assert gate.check(BoundaryDisplacement.zero(), elsewhere).reasons == ()


def test_a_rod_with_a_free_end():
    held = BoundaryPoses(START.left)
    decision = SafetyGate(LIMITS).check(BoundaryDisplacement(np.full(6, 1.0)), held)
    assert decision.reasons == ("translation step", "rotation step")
    assert decision.displacement.right is None
    with pytest.raises(ValueError, match="right clamp"):
        SafetyGate(LIMITS).check(BoundaryDisplacement.zero(), held)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_translation_step", 0.0),
        ("max_rotation_step", 3.0),
        ("max_speed", np.nan),
        ("control_period", -1.0),
        ("rod_length", np.inf),
        ("overstretch_margin", 1.0),
        ("min_gripper_distance", 0.6),
        ("workspace", ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))),
        ("planes", (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),)),
        ("planes", ((0.0, 0.0, 1.0),)),
        ("max_acceleration", 0.0),
        ("max_joint_speed", np.nan),
        ("max_force", -1.0),
        ("max_pose_age", np.inf),
        ("min_arm_clearance", -0.01),
        ("measured_tolerance", np.inf),
    ],
)
def test_senseless_limits_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        SafetyLimits(**{field: value})
