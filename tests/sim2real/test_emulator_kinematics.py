"""The emulator's own kinematics against the package's, which shares no code with it."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, log_so3, pose
from dlo_gym.scene.ur5e import ik_branches, link_frames, nearest_turn
from sim2real.emulator import kinematics

TCP = [0.02, -0.01, 0.163, 0.2, -0.1, 0.4]
T_FLANGE_TCP = pose(exp_so3(TCP[3:]), TCP[:3])


def joint_angles(seed, size=200):
    """Joint angles away from singularities."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-3.0, 3.0, (size, 6))
    regular = (np.abs(np.sin(angles[:, 2])) > 0.2) & (np.abs(np.sin(angles[:, 4])) > 0.2)
    return np.array([q for q in angles[regular] if determinant(q) > 2e-3])


def jacobian(q):
    T, J = np.empty((4, 4)), np.empty((6, 6))
    kinematics.forward_and_jacobian(q, T_FLANGE_TCP, T, J)
    return T, J


def determinant(q):
    return abs(np.linalg.det(jacobian(q)[1]))


def test_forward_kinematics_agree_with_the_scenes():
    for q in joint_angles(0):
        expected = link_frames(q)[6] @ T_FLANGE_TCP
        np.testing.assert_allclose(kinematics.forward(q, T_FLANGE_TCP), expected, atol=1e-12)


def test_jacobian_is_the_derivative_of_the_pose():
    step = 1e-6
    for q in joint_angles(1, 60):
        T, J = jacobian(q)
        for i in range(6):
            ahead, behind = q.copy(), q.copy()
            ahead[i] += step
            behind[i] -= step
            T_ahead = kinematics.forward(ahead, T_FLANGE_TCP)
            T_behind = kinematics.forward(behind, T_FLANGE_TCP)
            shift = (T_ahead[:3, 3] - T_behind[:3, 3]) / (2 * step)
            turn = log_so3(T_ahead[:3, :3] @ T_behind[:3, :3].T) / (2 * step)
            np.testing.assert_allclose(J[:, i], np.concatenate([shift, turn]), atol=1e-8)
        np.testing.assert_array_equal(T, kinematics.forward(q, T_FLANGE_TCP))


def test_linear_solver_agrees_with_numpy():
    rng = np.random.default_rng(2)
    for _ in range(50):
        matrix, right = rng.normal(size=(6, 6)), rng.normal(size=6)
        expected, size = np.linalg.solve(matrix, right), abs(np.linalg.det(matrix))
        assert kinematics.solve6(matrix.copy(), right) == pytest.approx(size)
        np.testing.assert_allclose(right, expected, rtol=1e-8)
    assert kinematics.solve6(np.zeros((6, 6)), np.ones(6)) == 0.0


def test_pose_vectors_and_matrices_are_inverse_and_agree_with_scipys():
    rng = np.random.default_rng(3)
    axes = rng.normal(size=(100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([rng.uniform(0, np.pi - 1e-3, 97), [0.0, 1e-9, np.pi - 1e-7]])
    for axis, angle in zip(axes, angles, strict=True):
        vector = np.concatenate([rng.normal(size=3), angle * axis])
        T = kinematics.transform(vector)
        np.testing.assert_allclose(T[:3, :3], exp_so3(angle * axis), atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], vector[:3])
        np.testing.assert_allclose(kinematics.vector(T), vector, atol=1e-9)


def test_newton_returns_to_the_joints_it_was_moved_from():
    rng = np.random.default_rng(4)
    for q in joint_angles(5):
        T = kinematics.forward(q, T_FLANGE_TCP)
        found = q + rng.uniform(-0.02, 0.02, 6)
        assert kinematics.inverse_from(T, T_FLANGE_TCP, found, 1e-10) == pytest.approx(
            determinant(q), rel=1e-3
        )
        np.testing.assert_allclose(found, q, atol=1e-6)


def test_nearest_solution_is_one_of_the_closed_form_and_the_nearest_of_them():
    rng = np.random.default_rng(6)
    T_tcp_flange = np.linalg.inv(T_FLANGE_TCP)
    for q in joint_angles(7, 60):
        T = kinematics.forward(q, T_FLANGE_TCP)
        near = q + rng.uniform(-0.1, 0.1, 6)
        found = kinematics.inverse_nearest(T, T_FLANGE_TCP, near)
        assert found is not None
        branches = ik_branches(T @ T_tcp_flange, near[5])
        branches = nearest_turn(branches[np.isfinite(branches[:, 0])], near)
        nearest = branches[np.argmin(np.abs(branches - near).max(axis=1))]
        np.testing.assert_allclose(found, nearest, atol=1e-6)


def test_pose_out_of_reach_has_no_solution():
    far = kinematics.transform([1.5, 0.0, 0.3, 0.0, 3.0, 0.0])
    q = joint_angles(8)[0]
    assert kinematics.inverse_from(far, T_FLANGE_TCP, q.copy(), 1e-9) == 0.0
    assert kinematics.inverse_nearest(far, T_FLANGE_TCP, q) is None


def test_reported_speed_is_the_change_of_the_reported_pose():
    q, qd = joint_angles(9)[0], np.array([0.3, -0.2, 0.1, 0.4, -0.5, 0.2])
    wrench, zero = np.arange(6.0), np.array([0.0, -1.0, 0.0, 0.0, 0.0, 5.0])
    now, later = np.empty((2, 11, 6))
    step = 1e-6
    for live, joints in ((now, q), (later, q + step * qd)):
        force = kinematics.report(joints, qd, -qd, T_FLANGE_TCP, wrench, zero, live)
    turn = exp_so3(later[5, 3:]) @ exp_so3(now[5, 3:]).T
    np.testing.assert_allclose((later[5] - now[5])[:3] / step, now[7, :3], atol=1e-5)
    np.testing.assert_allclose(log_so3(turn) / step, now[7, 3:], atol=1e-5)
    np.testing.assert_array_equal(now[[0, 1, 2, 3, 4]], [q, q, qd, qd, -qd])
    np.testing.assert_array_equal(now[[9, 10]], [wrench - zero, wrench])
    assert force == 0.0**2 + 2.0**2 + 2.0**2
