"""Cell files: what they mean, what is wrong with them, how single values are changed."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3
from dlo_gym.scene.arms import DualArm
from dlo_gym.scene.builder import default_cameras
from sim2real.config import TEMPLATES, CellConfig, CellFileError, update_cell_file

EMULATED = (TEMPLATES / "emulated.toml").read_text()


@pytest.fixture
def cell_file(tmp_path):
    file = tmp_path / "cell.toml"
    file.write_text(EMULATED)
    return file


@pytest.mark.parametrize("name", ["emulated", "uncalibrated", "ur5e"])
def test_templates_are_valid(name):
    config = CellConfig.load(TEMPLATES / f"{name}.toml")
    assert set(config.arms) == {"left", "right"}
    assert len(config.camera_models) == 2


def test_the_emulated_cell_is_the_simulated_one(cell_file):
    config, arms = CellConfig.load(cell_file), DualArm()
    np.testing.assert_allclose(config.dual_arm.T_world_base, arms.T_world_base, atol=1e-12)
    np.testing.assert_allclose(config.dual_arm.T_flange_tcp, arms.T_flange_tcp)
    np.testing.assert_allclose(config.dual_arm.home, arms.home)
    for ours, theirs in zip(config.camera_models, default_cameras(1 / 3), strict=True):
        np.testing.assert_allclose(ours.T_world_camera, theirs.T_world_camera, atol=1e-7)
        np.testing.assert_allclose(ours.K, theirs.K, atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("length_m = 0.5", "length_m = -0.5", "rod.length_m"),
        ("radius_m = 0.003", "radius_mm = 3", "rod.radius_mm"),
        ("[cameras.side]", "[cameras.side]\nbogus = 1", "cameras.side.bogus"),
        ('"mjpeg"', '"webcam"', "cameras.side.driver"),
        ("127.0.0.3", "127.0.0.2", "two addresses"),
        ("[arms.right]", "[arms.middle]", "arms"),
        ("466.6666667, 466.6666667", "-1.0, 466.0", "cameras.side.intrinsics_px"),
        ("[rod]", "[rod", "TOML"),
        ("dlo-cell/1", "dlo-cell/9", "schema"),
        ("radius_m = 0.003", "radius_m = nan", "rod.radius_m"),
    ],
)
def test_a_wrong_value_is_named_with_its_file(cell_file, old, new, said):
    cell_file.write_text(EMULATED.replace(old, new, 1))
    with pytest.raises(CellFileError) as error:
        CellConfig.load(cell_file)
    assert str(cell_file) in str(error.value)
    assert said in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CellFileError, match="nothing.toml"):
        CellConfig.load(tmp_path / "nothing.toml")


def test_changing_values_keeps_the_rest_of_the_file(cell_file):
    config = update_cell_file(
        cell_file,
        {"cameras.side.position_m": [0.1, -1.0, 0.4], "control.period_s": 0.05},
    )
    assert config.camera_models[0].centre == pytest.approx([0.1, -1.0, 0.4])
    assert config.safety_limits.control_period == 0.05
    kept = [line for line in EMULATED.splitlines() if line in cell_file.read_text().splitlines()]
    assert len(kept) == len(EMULATED.splitlines()) - 1


def test_a_change_that_is_not_valid_leaves_the_file_alone(cell_file):
    with pytest.raises(CellFileError, match="radius_m"):
        update_cell_file(cell_file, {"rod.radius_m": -1.0})
    assert cell_file.read_text() == EMULATED


def test_limits_reach_the_safety_gate(cell_file):
    plane = "\n[[limits.planes]]\npoint_m = [0.0, 0.2, 0.0]\nnormal = [0.0, -1.0, 0.0]\n"
    cell_file.write_text(EMULATED + "\n[limits]\nmax_force_n = 12.0\nmax_stretch = 0.9\n" + plane)
    limits = CellConfig.load(cell_file).safety_limits
    assert limits.max_force == 12.0
    assert limits.max_gripper_distance == pytest.approx(0.45)
    assert limits.planes == (((0.0, 0.2, 0.0), (0.0, -1.0, 0.0)),)


def test_rotations_are_rotation_vectors(cell_file):
    config = CellConfig.load(cell_file)
    side = config.cameras["side"]
    expected = exp_so3(np.array(side.rotation_rad))
    np.testing.assert_allclose(config.camera_models[0].T_world_camera[:3, :3], expected)
