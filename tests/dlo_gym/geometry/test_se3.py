"""Group axioms and round trips of rotations and rigid transforms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from dlo_gym.geometry import se3

vectors = arrays(np.float64, 3, elements=st.floats(-1.5, 1.5))


@given(vectors, vectors)
def test_inverse_undoes(rotation_vector, translation):
    T = se3.pose(se3.exp_so3(rotation_vector), translation)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)


@given(vectors)
def test_log_undoes_exp(rotation_vector):
    np.testing.assert_allclose(
        se3.log_so3(se3.exp_so3(rotation_vector)), rotation_vector, atol=1e-9
    )


@settings(deadline=None)  # the first call compiles
@given(vectors)
def test_quaternions_are_the_same_rotation(rotation_vector):
    R = se3.exp_so3(rotation_vector)
    q = se3.matrix_to_quaternion(R)
    assert q[0] >= 0.0
    np.testing.assert_allclose(se3.quaternion_to_matrix(q), R, atol=1e-12)


def test_quaternion_order_is_wxyz():
    quarter_about_z = se3.exp_so3([0.0, 0.0, np.pi / 2])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(se3.matrix_to_quaternion(quarter_about_z), [half, 0, 0, half])


def test_batches_agree_with_single_calls():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(4, 5, 3))
    R = se3.exp_so3(vectors)
    assert R.shape == (4, 5, 3, 3)
    np.testing.assert_allclose(R[2, 3], se3.exp_so3(vectors[2, 3]))
    T = se3.pose(R, rng.normal(size=(4, 5, 3)))
    np.testing.assert_allclose(se3.inverse(T)[1, 2], np.linalg.inv(T[1, 2]), atol=1e-12)


def test_transform_points_applies_rotation_then_translation():
    T = se3.pose(se3.exp_so3([0.0, 0.0, np.pi / 2]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(se3.transform_points(T, [[1.0, 0.0, 0.0]]), [[1.0, 3.0, 3.0]])


@given(vectors, vectors)
def test_frame_along_is_right_handed_with_d3_along_the_tangent(tangent, reference):
    if np.linalg.norm(np.cross(tangent, reference)) < 1e-3:
        return
    R = se3.frame_along(tangent, reference)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R[:, 2], tangent / np.linalg.norm(tangent), atol=1e-9)
    assert R[:, 0] @ reference > 0


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda T: T[:3], "shape"),
        (lambda T: T * np.nan, "finite"),
        (lambda T: T * 1.01, "rigid"),
        (lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0]), "left-handed"),
        (lambda T: T + np.array([[0.0], [0], [0], [1]]) * np.ones(4) * 0.1, "last row"),
    ],
)
def test_check_pose_names_what_is_wrong(spoil, message):
    with pytest.raises(ValueError, match=f"clamp left.*{message}"):
        se3.check_pose(spoil(np.eye(4)), "clamp left")


def test_quaternions_are_scipys_to_the_last_bit():
    group = Rotation.create_group("O").as_matrix()  # every tie of the largest component
    turns = Rotation.from_rotvec(2.0 * np.random.default_rng(0).normal(size=(500, 3))).as_matrix()
    rotations = np.concatenate([group, np.round(group), turns])
    scipys = np.roll(Rotation.from_matrix(rotations).as_quat(canonical=True), 1, axis=-1)
    np.testing.assert_array_equal(se3.matrix_to_quaternion(rotations), scipys)


def test_quaternions_of_what_is_nearly_a_rotation_are_of_the_nearest():
    R = se3.exp_so3([0.0, 0.0, 0.3])
    stretched = R * [1.0 + 1e-5, 1.0, 1.0]
    np.testing.assert_allclose(
        se3.matrix_to_quaternion(stretched), se3.matrix_to_quaternion(R), atol=1e-5
    )
    with pytest.raises(ValueError, match="determinant"):
        se3.matrix_to_quaternion(np.diag([1.0, 1.0, -1.0]))
