"""The gate with arms: what it lets through, the arms can follow without touching anything."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from control.evaluate import gate_for, make_controller, make_env, run_episode
from control.safety import SafetyGate, SafetyLimits
from control.safety_arms import CLEARANCES, ArmSteps, clearances
from dlo_gym.exceptions import SafetyStop, UnreachablePose
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.scene.arms import DualArm

ARMS = DualArm()
# Steps far larger than one period's, so that limits of the arms are met often.
WIDE = SafetyLimits(
    max_translation_step=0.2,
    max_rotation_step=1.0,
    max_speed=2.0,
    max_rotation_speed=10.0,
    rod_length=3.0,
    min_gripper_distance=0.0,
    workspace=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)),
    max_joint_speed=inf,
    min_arm_clearance=0.02,
)

angles = st.lists(st.floats(-0.8, 0.8), min_size=12, max_size=12)
joint_angles = angles.map(lambda offsets: ARMS.home + np.reshape(offsets, (2, 6)))
commands = st.lists(st.floats(-0.4, 0.4), min_size=12, max_size=12).map(
    BoundaryDisplacement.from_vector
)


def held(q) -> BoundaryPoses:
    return ARMS.forward_kinematics(q)


def moved(*, left=(0, 0, 0), right=(0, 0, 0)) -> BoundaryDisplacement:
    return BoundaryDisplacement.from_vector([*left, 0, 0, 0, *right, 0, 0, 0])


def joint_step(decision, q) -> np.ndarray:
    return ARMS.inverse_kinematics(decision.target, q) - ARMS.inverse_kinematics(held(q), q)


def nearness(q) -> np.ndarray:
    return np.concatenate([np.ravel(distances) for distances in ARMS.clearance(q)])


@settings(max_examples=30, deadline=None)
@given(st.lists(joint_angles, min_size=1, max_size=4))
def test_batched_clearances_are_those_of_the_arms(several):
    batch = clearances(ARMS, np.array(several))
    assert batch.shape == (len(several), len(CLEARANCES))
    for one, q in zip(batch, several, strict=True):
        assert_allclose(one, nearness(q), atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(joint_angles, commands)
def test_batched_inverse_kinematics_is_that_of_the_arms(q, command):
    start = held(q)
    clamps = np.array([start.left, start.right])
    steps = np.array([[0.0], [0.3], [1.0]]) * command.vector
    batch = ArmSteps(WIDE, ARMS, clamps, q, np.zeros((2, 6))).reached(steps.reshape(-1, 2, 2, 3))
    for reached, step in zip(batch, steps, strict=True):
        target = start.displaced(BoundaryDisplacement.from_vector(step))
        try:
            expected = ARMS.inverse_kinematics(target, q)
        except UnreachablePose:
            assert np.isnan(reached).any()
        else:
            assert_allclose(reached, expected, atol=1e-7)


@settings(max_examples=80, deadline=None)
@given(joint_angles, commands)
def test_whatever_comes_out_can_be_reached_and_keeps_the_clearance(q, command):
    decision = SafetyGate(WIDE, ARMS).check(command, held(q), q)
    after = ARMS.inverse_kinematics(decision.target, q)  # raises where it is out of reach
    assert (nearness(after) >= np.minimum(WIDE.min_arm_clearance, nearness(q)) - 1e-7).all()


@settings(max_examples=80, deadline=None)
@given(joint_angles, commands, st.floats(0.05, 3.0))
def test_joints_turn_no_faster_than_allowed(q, command, speed):
    limits = replace(WIDE, max_joint_speed=speed)
    decision = SafetyGate(limits, ARMS).check(command, held(q), q)
    fastest = np.abs(joint_step(decision, q)).max() / limits.control_period
    assert fastest <= speed + 1e-6
    if "joint speed" in decision.reasons:
        largest = max(cut.value for cut in decision.cuts if cut.limit == "joint speed")
        assert largest > speed


def test_a_command_cut_by_the_joint_speed_uses_most_of_it():
    limits = replace(WIDE, max_joint_speed=0.4)
    command = moved(left=(0.0, 0.05, 0.05), right=(0.0, 0.05, 0.0))
    decision = SafetyGate(limits, ARMS).check(command, held(ARMS.home), ARMS.home)
    assert decision.reasons == ("joint speed",)
    fastest = np.abs(joint_step(decision, ARMS.home)).max() / limits.control_period
    assert 0.75 * 0.4 < fastest <= 0.4 + 1e-9
    # Along the command's own direction.
    fraction = decision.displacement.vector @ command.vector / (command.vector @ command.vector)
    assert_allclose(decision.displacement.vector, fraction * command.vector, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.lists(commands, min_size=2, max_size=5))
def test_joint_velocities_change_by_no_more_than_the_acceleration(sequence):
    limits = replace(WIDE, max_joint_acceleration=6.0)
    gate = SafetyGate(limits, ARMS)
    q, boundary, before = ARMS.home, held(ARMS.home), np.zeros((2, 6))
    for command in sequence:
        decision = gate.check(command.scaled(0.2), boundary, q)
        after = ARMS.inverse_kinematics(decision.target, q)
        step = after - q
        slower = np.clip(step, np.minimum(before, 0), np.maximum(before, 0))
        assert (np.abs(step - slower) / limits.control_period**2).max() <= 6.0 + 1e-3
        q, boundary, before = after, decision.target, step


def test_a_command_out_of_reach_stops_where_reach_ends():
    gate = SafetyGate(WIDE, ARMS)
    boundary, q = held(ARMS.home), ARMS.home
    outwards = moved(left=(0.0, 0.0, 0.1), right=(0.0, 0.0, 0.1))
    reasons = set()
    for _ in range(15):
        decision = gate.check(outwards, boundary, q)
        boundary = decision.target
        q = ARMS.inverse_kinematics(boundary, q)
        reasons |= set(decision.reasons)
    assert reasons == {"reach"}
    assert gate.check(outwards.scaled(-0.2), boundary, q).reasons == ()


def test_a_wrist_stays_out_of_its_singularity():
    gate, q = SafetyGate(replace(WIDE, min_wrist_angle=0.1), ARMS), ARMS.home.copy()
    sides, boundary, reasons = np.sign(np.sin(q[:, 4])), held(q), set()
    for _ in range(30):  # turns that take both wrists to zero and beyond
        turns = [
            sign * 0.05 * clamp[:3, 1] for sign, clamp in zip((1, -1), boundary.clamps, strict=True)
        ]
        step = np.concatenate([[0, 0, 0, *turn] for turn in turns])
        decision = gate.check(BoundaryDisplacement.from_vector(step), boundary, q)
        boundary = decision.target
        q = ARMS.inverse_kinematics(boundary, q)
        reasons |= set(decision.reasons)
        assert (sides * q[:, 4]).min() > 0.1 - 1e-6
    assert "singularity" in reasons


def pressed_together(clearance: float) -> SafetyLimits:
    return replace(WIDE, min_arm_clearance=clearance)


def test_arms_are_kept_apart_and_the_cut_says_how_near_they_would_have_come():
    gap = ARMS.clearance(ARMS.home).between_arms
    command = moved(left=(0.15, 0, 0), right=(-0.15, 0, 0))
    limits = replace(pressed_together(0.3), max_rotation_step=1.0)
    boundary, q = held(ARMS.home), ARMS.home
    gate = SafetyGate(replace(limits, min_arm_clearance=gap - 0.1), ARMS)
    decision = gate.check(command, boundary, q)
    cuts = [cut for cut in decision.cuts if cut.what == "between the arms"]
    assert cuts[0].limit == "clearance"
    assert cuts[0].value < cuts[0].bound == pytest.approx(gap - 0.1)
    after = ARMS.clearance(ARMS.inverse_kinematics(decision.target, q)).between_arms
    assert gap - 0.1 - 1e-9 <= after < gap - 0.05


def test_arms_too_near_already_may_part_or_pass_but_not_come_nearer():
    gap = ARMS.clearance(ARMS.home).between_arms
    limits = pressed_together(gap + 0.02)  # broken where they stand
    boundary, q = held(ARMS.home), ARMS.home
    apart = moved(left=(-0.01, 0, 0), right=(0.01, 0, 0))
    # One arm's clearance to itself also is below the bound at home and shrinks with some motions.
    kept = SafetyGate(limits, ARMS).check(apart, boundary, q)
    nearer = SafetyGate(limits, ARMS).check(apart.scaled(-1.0), boundary, q)
    assert "clearance" in nearer.reasons
    for decision in (kept, nearer):
        after = ARMS.inverse_kinematics(decision.target, q)
        assert (nearness(after) >= np.minimum(gap + 0.02, nearness(q)) - 1e-7).all()
    assert kept.target.distance >= boundary.distance


def test_a_blocked_command_slides_past_the_other_arm():
    gap = ARMS.clearance(ARMS.home).between_arms
    limits = pressed_together(gap)
    boundary, q = held(ARMS.home), ARMS.home
    command = moved(left=(0.02, 0.02, 0), right=(-0.02, 0.02, 0))
    decision = SafetyGate(limits, ARMS).check(command, boundary, q)
    assert "clearance" in decision.reasons
    assert decision.displacement.left[1] > 0.005
    assert decision.displacement.right[1] > 0.005
    after = ARMS.inverse_kinematics(decision.target, q)
    assert ARMS.clearance(after).between_arms >= gap - 1e-9


@settings(max_examples=60, deadline=None)
@given(commands)
def test_sliding_keeps_every_other_limit(command):
    """Arms too near to themselves, in a corner of the workspace."""
    start = held(ARMS.home)
    origins = np.array([start.left[:3, 3], start.right[:3, 3]])
    x, y, z = origins.min(axis=0).tolist()
    limits = SafetyLimits(
        min_arm_clearance=ARMS.clearance(ARMS.home).minimum + 0.05,
        workspace=((x, y, z), (0.6, 0.5, 0.9)),
    )
    decision = SafetyGate(limits, ARMS).check(command, start, ARMS.home)
    steps = np.linalg.norm(decision.displacement.vector.reshape(2, 2, 3), axis=2)
    assert steps[:, 0].max() <= limits.translation_step * (1 + 2e-6)
    assert steps[:, 1].max() <= limits.rotation_step * (1 + 2e-6)
    after = np.array([decision.target.left[:3, 3], decision.target.right[:3, 3]])
    assert (after >= np.minimum(limits.workspace[0], origins) - 1e-9).all()
    reached = ARMS.inverse_kinematics(decision.target, ARMS.home)
    assert (
        nearness(reached) >= np.minimum(limits.min_arm_clearance, nearness(ARMS.home)) - 1e-7
    ).all()


def test_without_arms_nothing_of_them_is_checked():
    command = moved(left=(0.2, 0, 0), right=(-0.2, 0, 0))
    for position in (held(ARMS.home), held(ARMS.home).displaced(command)):
        assert "clearance" not in SafetyGate(pressed_together(0.4)).check(command, position).reasons


def test_arms_that_cannot_be_where_they_are_stop():
    far = held(ARMS.home).displaced(moved(left=(-3.0, 0, 0)))
    with pytest.raises(SafetyStop, match="left arm") as caught:
        SafetyGate(WIDE, ARMS).check(BoundaryDisplacement.zero(), far)
    assert caught.value.limit == "reach"


def test_joint_angles_are_checked():
    boundary = held(ARMS.home)
    with pytest.raises(ValueError, match="joint_angles"):
        SafetyGate(WIDE, ARMS).check(BoundaryDisplacement.zero(), boundary, np.zeros(6))
    with pytest.raises(SafetyStop, match="finite"):
        SafetyGate(WIDE, ARMS).check(BoundaryDisplacement.zero(), boundary, np.full((2, 6), np.nan))


def test_a_rod_with_a_free_end_needs_one_arm():
    held_left = BoundaryPoses(held(ARMS.home).left)
    command = BoundaryDisplacement(np.array([0.0, 0.1, 0.1, 0, 0, 0]))
    decision = SafetyGate(replace(WIDE, max_joint_speed=0.3), ARMS).check(command, held_left)
    assert decision.reasons == ("joint speed",)
    assert decision.displacement.right is None


@pytest.mark.slow
def test_an_episode_that_ended_in_a_collision_reaches_its_goal():
    env = make_env("dlo_gym/ShapeControl-v0", "state", goal_distance=(0.15, 0.35))
    gate = gate_for(env.unwrapped.config)
    ends = {}
    for arms in (None, gate.arms):
        blind = SafetyGate(gate.limits, arms)
        controller = make_controller("mpc", gate.limits, env.unwrapped.config)
        *_, last = run_episode(env, controller, blind, seed=18, max_steps=45)
        ends[arms is not None] = (last.success, last.termination)
    env.close()
    assert ends[False][1] == "collision"
    assert ends[True] == (True, "")
