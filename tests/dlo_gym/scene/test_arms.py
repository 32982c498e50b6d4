"""Dual-arm kinematics: closed-form inverse against forward, limits, clearances."""

import numpy as np
import pytest

from dlo_gym.exceptions import UnreachablePose
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import DualArm
from dlo_gym.scene.clearance import CAPSULE_RADII, capsule_axes, clearance, segment_distances
from dlo_gym.scene.ur5e import JOINT_LIMIT, ik_branches, link_frames, nearest_turn

CLAMP_ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def boundary_at(left, right, left_tilt=(0, 0, 0), right_tilt=(0, 0, 0)):
    return BoundaryPoses(
        pose(exp_so3(left_tilt) @ CLAMP_ALONG_X, left),
        pose(exp_so3(right_tilt) @ CLAMP_ALONG_X, right),
    )


def random_tilt(rng):
    """Up to 60 degrees about any axis across the rod."""
    axis = rng.normal(size=2)
    angle = np.deg2rad(60) * np.sqrt(rng.uniform())
    return [0.0, *(axis / np.linalg.norm(axis) * angle)]


def test_flange_of_the_zero_configuration_is_universal_robots_own():
    flange = link_frames(np.zeros(6))[6]
    np.testing.assert_allclose(flange[:3, 3], [-0.8172, -0.2329, 0.0628], atol=1e-12)
    np.testing.assert_allclose(flange[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)


def test_every_branch_reaches_the_pose_and_one_is_the_configuration_it_came_from():
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (500, 6))
    flange = link_frames(q)[:, 6]
    branches = ik_branches(flange)
    reached = link_frames(branches)[..., 6, :, :]
    error = np.abs(reached - flange[:, None]).max(axis=(-1, -2))
    assert np.nanmax(error) < 1e-9
    off = np.abs((branches - q[:, None] + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
    assert np.nanmin(off, axis=1).max() < 1e-7


def test_a_singular_wrist_keeps_the_last_joint_where_it_was():
    q = np.array([0.3, -1.2, 1.1, 0.4, 0.0, 0.9])
    flange = link_frames(q)[6]
    branches = ik_branches(flange, wrist_3=0.9)
    branches = branches[np.isfinite(branches[:, 0])]
    reached = link_frames(branches)[:, 6]
    np.testing.assert_allclose(reached, np.broadcast_to(flange, reached.shape), atol=1e-7)
    assert np.abs(branches - q).max(axis=1).min() < 1e-6


def test_nearest_turn_stays_within_the_joint_limits():
    np.testing.assert_allclose(nearest_turn([3.0], [-3.0]), [3.0 - 2 * np.pi])
    np.testing.assert_allclose(nearest_turn([1.0], [6.0]), [1.0])  # 1 + 2 pi is out of limits
    assert np.abs(nearest_turn(np.linspace(-np.pi, np.pi, 99), 6.2)).max() <= JOINT_LIMIT


def test_home_holds_the_typical_start_with_elbows_up_and_free_of_collision():
    arms = DualArm()
    boundary = arms.forward_kinematics(arms.home)
    np.testing.assert_allclose(boundary.left[:3, 3], [-0.2, 0.0, 0.34], atol=0.01)
    np.testing.assert_allclose(boundary.right[:3, 3], [0.2, 0.0, 0.34], atol=0.01)
    np.testing.assert_allclose(boundary.left[:3, :3], CLAMP_ALONG_X, atol=0.02)
    elbows = arms.T_world_base @ link_frames(arms.home)[:, 2]
    assert (elbows[:, 2, 3] > 0.55).all()
    assert arms.clearance(arms.home).minimum > 0.05


def test_the_whole_workspace_is_reached_within_limits():
    rng = np.random.default_rng(2)
    arms = DualArm()
    free = 0
    for _ in range(200):
        y, z = rng.uniform(-0.2, 0.2, 2), rng.uniform(0.15, 0.55, 2)
        boundary = boundary_at(
            [rng.uniform(-0.35, 0.0), y[0], z[0]],
            [rng.uniform(0.0, 0.35), y[1], z[1]],
            random_tilt(rng),
            random_tilt(rng),
        )
        q = arms.inverse_kinematics(boundary)
        assert np.abs(q).max() <= JOINT_LIMIT
        held = arms.forward_kinematics(q)
        np.testing.assert_allclose(held.left, boundary.left, atol=1e-9)
        np.testing.assert_allclose(held.right, boundary.right, atol=1e-9)
        free += arms.clearance(q).minimum > 0
    assert free > 0.85 * 200


def test_small_moves_of_the_clamps_move_the_joints_little():
    arms = DualArm()
    q = arms.home
    for t in np.linspace(0.0, 1.0, 60):
        left, right = [-0.2 + 0.1 * t, 0.1 * t, 0.34], [0.2, -0.1 * t, 0.34 - 0.1 * t]
        boundary = boundary_at(left, right, [0.0, 0.6 * t, 0.3 * t])
        moved = arms.inverse_kinematics(boundary, q)
        assert np.abs(moved - q).max() < 0.1
        q = moved


def test_a_free_right_end_leaves_the_right_arm_where_it_is():
    arms = DualArm()
    boundary = BoundaryPoses(boundary_at([-0.25, 0.05, 0.3], [0.2, 0, 0.34]).left)
    q = arms.inverse_kinematics(boundary, arms.home)
    np.testing.assert_array_equal(q[1], arms.home[1])
    assert np.abs(q[0] - arms.home[0]).max() > 0.01


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ([0.7, 0, 0.3], [0.2, 0, 0.34], r"left arm .*\[0.7, 0.0, 0.3\].*span 1\.\d+ m.*0.817 m"),
        ([-0.2, 0, 0.34], [0.48, 0.15, 0.3], r"right arm .*from the base's axis, at least 0.133 m"),
    ],
)
def test_an_unreachable_pose_names_the_arm_and_the_limit(left, right, said):
    with pytest.raises(UnreachablePose, match=said):
        DualArm().inverse_kinematics(boundary_at(left, right))


def test_bad_arguments_are_named():
    arms = DualArm()
    with pytest.raises(ValueError, match=r"guess: .*\(2, 6\)"):
        arms.inverse_kinematics(boundary_at([-0.2, 0, 0.3], [0.2, 0, 0.3]), np.zeros(6))
    with pytest.raises(ValueError, match=r"joint_angles: .*within"):
        arms.forward_kinematics(np.full((2, 6), 7.0))
    with pytest.raises(ValueError, match="T_world_base"):
        DualArm(T_world_base=np.eye(4))


def test_segment_distances_against_dense_sampling():
    rng = np.random.default_rng(3)
    first, second = rng.normal(size=(2, 60, 2, 3))
    first[0, 1], second[1, 1] = first[0, 0], second[1, 0]  # points
    second[2] = first[2] + [0.0, 0.0, 0.3]  # parallel
    t = np.linspace(0.0, 1.0, 301)[:, None]
    for a, b, distance in zip(first, second, segment_distances(first, second), strict=True):
        on_a, on_b = a[0] + t * (a[1] - a[0]), b[0] + t * (b[1] - b[0])
        sampled = np.linalg.norm(on_a[:, None] - on_b[None], axis=-1).min()
        assert sampled - 0.02 < distance <= sampled + 1e-9


def test_clearance_sees_arms_that_meet_and_a_gripper_in_the_table():
    arms = DualArm()
    # In line, tip to tip, the fingers stay as far apart as the clamps but for their rounding.
    near = arms.inverse_kinematics(boundary_at([-0.05, 0, 0.34], [0.05, 0, 0.34]))
    np.testing.assert_allclose(
        arms.clearance(near).between_arms, 0.1 + 2 * (0.163 - 0.14 - 0.035), atol=1e-6
    )
    crossed = arms.inverse_kinematics(boundary_at([0.1, 0.0, 0.34], [-0.1, 0.0, 0.34]), near)
    assert arms.clearance(crossed).between_arms < 0
    low = arms.inverse_kinematics(boundary_at([-0.2, 0, 0.02], [0.2, 0, 0.34]))
    near = arms.clearance(low)
    assert near.to_table[0] < 0 < min(near.to_table[1], near.between_arms)


def test_clearance_sees_an_arm_folded_into_itself():
    arms = DualArm()
    folded = arms.home.copy()
    folded[0, 2] = 3.1
    assert arms.clearance(folded).within_arm[0] < 0 < arms.clearance(folded).within_arm[1]
    stretched = arms.home.copy()
    stretched[0] = [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0]
    assert arms.clearance(stretched).within_arm.min() > 0


def test_clearance_of_an_arm_out_of_reach_is_not_known():
    arms = DualArm()
    q = np.stack([arms.home, arms.home])
    q[1, 1] = np.nan
    known, unknown = clearance(arms.T_world_base, q[0]), clearance(arms.T_world_base, q)
    np.testing.assert_array_equal(unknown.to_table[0], known.to_table)
    np.testing.assert_array_equal(unknown.to_table[1], [known.to_table[0], np.nan])
    np.testing.assert_array_equal(unknown.within_arm[1], [known.within_arm[0], np.nan])
    assert np.isnan(unknown.between_arms).tolist() == [False, True]


def test_following_a_way_is_reaching_each_pose_from_the_last_one_that_was_reached():
    arms, guess = DualArm(), DualArm().home
    steps = np.linspace([0.0, 0.0, 0.0], [-0.5, 0.3, 0.1], 30)
    steps[12] = [-3.0, 0.0, 0.0]  # out of the left arm's reach alone
    way = np.repeat(arms.forward_kinematics(guess).clamps[None], len(steps), axis=0)
    way[:, 0, :3, 3] += steps
    followed = arms.follow(way, guess)
    assert np.isnan(followed[12, 0]).all()
    for clamps, joint_angles in zip(way, followed, strict=True):
        np.testing.assert_array_equal(joint_angles, arms.reach(clamps, guess))
        guess = np.where(np.isnan(joint_angles), guess, joint_angles)
    alone = arms.follow(way[:, :1], arms.home)
    np.testing.assert_array_equal(alone[:, 0], followed[:, 0])
    np.testing.assert_array_equal(alone[:, 1], np.broadcast_to(arms.home[1], (len(way), 6)))


def test_clearances_are_the_smallest_over_all_pairs_of_capsules():
    rng = np.random.default_rng(7)
    bases = DualArm().T_world_base
    joint_angles = DualArm().home + rng.normal(0.0, 0.6, (200, 2, 6))
    axes = capsule_axes(bases, joint_angles)
    pairs = segment_distances(axes[:, 0, :, None], axes[:, 1, None])
    gaps = pairs - CAPSULE_RADII[:, None] - CAPSULE_RADII
    found = clearance(bases, joint_angles)
    np.testing.assert_allclose(found.between_arms, gaps.min(axis=(1, 2)), atol=1e-14)
    assert (found.smallest < 0.0).any()
    assert (found.smallest > 0.0).any()
