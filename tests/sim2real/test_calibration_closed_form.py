"""The closed forms against the truth, and against OpenCV's own numbers."""

import cv2
import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, inverse, log_so3, pose
from sim2real.calibration.closed_form import HAND_EYE, METHODS, eye_to_hand
from tests.sim2real.calibration_data import apart

T_BASE_CAMERA = pose(exp_so3([0.4, -1.2, 0.7]), [0.7, -1.1, 0.5])
# What OpenCV 4.14.0 answers on `poses(1.0)`: position [m], rotation vector [rad].
OPENCV = {
    "TSAI": [0.702473127, -1.099438765, 0.499873685, 0.401494995, -1.200089496, 0.701505396],
    "PARK": [0.702649849, -1.099398106, 0.499968078, 0.401641994, -1.199908196, 0.701779329],
    "HORAUD": [0.702638531, -1.099399196, 0.499971317, 0.401623345, -1.199911588, 0.701765867],
    "ANDREFF": [0.702244236, -1.0961624, 0.499841733, 0.401092042, -1.199898216, 0.701935479],
    "DANIILIDIS": [0.703617661, -1.099395648, 0.500703739, 0.401060085, -1.199879251, 0.702121602],
    "SHAH": [0.703264815, -1.099490339, 0.500124409, 0.401623345, -1.199911588, 0.701765869],
    "LI": [0.70270858, -1.099526123, 0.500042916, 0.401469897, -1.199818554, 0.701851918],
}


def poses(noise, k=12):
    rng = np.random.default_rng(3)
    T_tcp_board = pose(exp_so3([0.3, 1.3, -0.2]), [0.02, -0.1, 0.05])
    T_base_tcp = pose(
        exp_so3(rng.uniform(-0.8, 0.8, (k, 3))) @ exp_so3([0.5, 1.0, 0.2]),
        rng.uniform(-0.2, 0.2, (k, 3)) + np.array([0.6, 0, 0.3]),
    )
    T_camera_board = inverse(T_BASE_CAMERA) @ T_base_tcp @ T_tcp_board
    T_base_tcp = T_base_tcp @ pose(
        exp_so3(noise * 1e-3 * rng.standard_normal((k, 3))),
        noise * 1e-3 * rng.standard_normal((k, 3)),
    )
    return T_base_tcp, T_camera_board @ pose(
        exp_so3(noise * 2e-3 * rng.standard_normal((k, 3))),
        noise * 1e-3 * rng.standard_normal((k, 3)),
    )


@pytest.mark.parametrize("method", METHODS)
def test_without_noise_every_method_finds_the_truth(method):
    mm, deg = apart(eye_to_hand(*poses(0.0), method), T_BASE_CAMERA)
    assert mm < 1e-8
    assert deg < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_with_noise_every_method_answers_as_opencv_does(method):
    found = eye_to_hand(*poses(1.0), method)
    vector = np.concatenate([found[:3, 3], log_so3(found[:3, :3])])
    np.testing.assert_allclose(vector, OPENCV[method], atol=2e-9)


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="left out of OpenCV 5.0's package")
@pytest.mark.parametrize("method", METHODS)
def test_the_installed_opencv_agrees(method):
    T_base_tcp, T_camera_board = poses(1.0)
    board = T_camera_board[:, :3, :3], T_camera_board[:, :3, 3]
    if method in HAND_EYE:
        T = inverse(T_base_tcp)
        flag = getattr(cv2, f"CALIB_HAND_EYE_{method}")
        R, t = cv2.calibrateHandEye(T[:, :3, :3], T[:, :3, 3], *board, method=flag)
        expected = pose(R, t.ravel())
    else:
        flag = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{method}")
        _, _, R, t = cv2.calibrateRobotWorldHandEye(
            *board, T_base_tcp[:, :3, :3], T_base_tcp[:, :3, 3], method=flag
        )
        expected = inverse(pose(R, t.ravel()))
    mm, deg = apart(eye_to_hand(T_base_tcp, T_camera_board, method), expected)
    assert mm < 1e-6
    assert deg < 1e-7


def test_poses_that_only_shift_are_refused_by_methods_that_need_rotation():
    T_base_tcp = pose(np.eye(3), np.random.default_rng(0).uniform(-1, 1, (6, 3)))
    with pytest.raises(ValueError, match="PARK"):
        eye_to_hand(T_base_tcp, inverse(T_BASE_CAMERA) @ T_base_tcp, "PARK")


def test_bad_arguments_are_named():
    T_base_tcp, T_camera_board = poses(0.0)
    with pytest.raises(ValueError, match="method: expected one of TSAI, PARK.*got 'KABSCH'"):
        eye_to_hand(T_base_tcp, T_camera_board, "KABSCH")
    with pytest.raises(ValueError, match="at least 3"):
        eye_to_hand(T_base_tcp[:2], T_camera_board[:2])
    with pytest.raises(ValueError, match="same number of poses"):
        eye_to_hand(T_base_tcp, T_camera_board[:-1])
