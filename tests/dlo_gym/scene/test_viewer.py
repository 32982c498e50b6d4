"""What the viewer writes, read back from the file."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_gym.exceptions import MissingExtra, RenderingUnavailable
from dlo_gym.geometry.camera import View
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene import viewer as module
from dlo_gym.scene.arms import DualArm
from dlo_gym.scene.builder import default_cameras
from dlo_gym.scene.clearance import capsule_axes
from dlo_gym.scene.viewer import SceneViewer
from tests.dlo_gym.rrd import read_rrd

ARMS = DualArm()
CURVE = np.linspace([-0.2, 0.0, 0.34], [0.2, 0.0, 0.34], 11)
CAMERAS = default_cameras(0.1)


@pytest.fixture
def shown(tmp_path):
    """A file of two moments, as {entity: {component: values}}."""
    pytest.importorskip("rerun")
    viewer = SceneViewer([c.name for c in CAMERAS], ARMS, ("error",), save=tmp_path / "a.rrd")
    for camera in CAMERAS:
        viewer.show_camera(camera, static=True)
    viewer.show_curve("goal", CURVE, (1, 2, 3), static=True)
    clamps = ARMS.forward_kinematics(ARMS.home)
    for stamp in (0.0, 0.5):
        viewer.set_time(stamp)
        viewer.show_curve("cable", CURVE + stamp, (200, 30, 20), radius=0.003)
        viewer.show_drawn("cable", CAMERAS[0], CURVE, (200, 30, 20))
        viewer.show_image(View(np.full((108, 192, 3), 90, np.uint8), CAMERAS[0], stamp))
        viewer.show_clamps(clamps)
        viewer.show_arms(ARMS.home)
        viewer.show_numbers({"error/goal_distance_mm": 10.0 + stamp})
    viewer.note("all is well", level="INFO")
    viewer.close()
    viewer.close()
    return read_rrd(tmp_path / "a.rrd")


def test_curves_are_where_and_when_they_were_shown(shown):
    strips = np.array(shown["/world/cable"]["LineStrips3D:strips"])[:, 0]
    np.testing.assert_allclose(strips, [CURVE, CURVE + 0.5], atol=1e-6)
    np.testing.assert_allclose(np.ravel(shown["/world/cable"]["LineStrips3D:radii"]), 0.003)
    assert shown["/world/cable"]["run"] == pytest.approx([0.0, 0.5])
    goal = shown["/world/goal"]
    assert len(goal["LineStrips3D:strips"]) == 1
    assert "run" not in goal  # static


def test_cameras_see_what_is_drawn_in_their_images(shown):
    side = CAMERAS[0]
    drawn = np.array(shown["/world/cameras/side/image/cable"]["LineStrips2D:strips"])[0, 0]
    np.testing.assert_allclose(drawn, side.project(CURVE), atol=1e-3)
    image = shown["/world/cameras/side/image"]
    assert len(image["EncodedImage:blob"]) == 2
    np.testing.assert_allclose(np.ravel(image["Pinhole:resolution"]), [192, 108])
    K = np.reshape(image["Pinhole:image_from_camera"], (3, 3)).T  # column by column
    np.testing.assert_allclose(K, side.K, rtol=1e-6)
    at = shown["/world/cameras/side"]["Transform3D:translation"]
    np.testing.assert_allclose(np.ravel(at), side.centre, atol=1e-6)
    assert "/world/cameras/top" in shown


def test_arms_are_their_capsules(shown):
    for side, ends in zip(
        ("left", "right"), capsule_axes(ARMS.T_world_base, ARMS.home), strict=True
    ):
        arm = shown[f"/world/arms/{side}"]
        np.testing.assert_allclose(arm["Capsules3D:translations"][0], ends[:, 0], atol=1e-6)
        turned = Rotation.from_quat(arm["Capsules3D:quaternions"][0])
        along = turned.apply([0.0, 0.0, 1.0]) * np.array(arm["Capsules3D:lengths"][0])[:, None]
        np.testing.assert_allclose(along, ends[:, 1] - ends[:, 0], atol=1e-6)
    clamps = ARMS.forward_kinematics(ARMS.home)
    at = shown["/world/grippers/right"]["Transform3D:translation"][0]
    np.testing.assert_allclose(np.ravel(at), clamps.right[:3, 3], atol=1e-6)


def test_numbers_and_notes_are_kept(shown):
    error = shown["/error/goal_distance_mm"]["Scalars:scalars"]
    assert np.ravel(error).tolist() == [10.0, 10.5]
    assert shown["/log"]["TextLog:text"] == [["all is well"]]


@pytest.mark.parametrize("vector", [(0, 0, 2), (0, 0, -1), (1, 0, 0), (0.2, -0.3, -0.9)])
def test_capsules_point_along_their_axes(vector):
    vector = np.array(vector, dtype=float)
    turned = Rotation.from_quat(module._from_z(vector[None])[0]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, vector / np.linalg.norm(vector), atol=1e-12)


def test_one_clamp_is_shown_alone(tmp_path):
    pytest.importorskip("rerun")
    viewer = SceneViewer([], ARMS, save=tmp_path / "a.rrd")
    viewer.set_time(0.0)
    viewer.show_clamps(BoundaryPoses(ARMS.forward_kinematics(ARMS.home).left))
    viewer.close()
    shown = read_rrd(tmp_path / "a.rrd")
    assert "Transform3D:translation" in shown["/world/grippers/left"]
    assert "/world/grippers/right" not in shown


def test_a_file_that_is_there_is_kept(tmp_path):
    pytest.importorskip("rerun")
    (tmp_path / "a.rrd").write_bytes(b"a run of last week")
    with pytest.raises(FileExistsError, match=r"a\.rrd exists"):
        SceneViewer([], ARMS, save=tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").read_bytes() == b"a run of last week"


def test_without_a_display_the_way_out_is_told(monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(module, "PORT", 1)  # no viewer there
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(
        RenderingUnavailable, match=r"no display .*DISPLAY.* \.rrd file .*ssh -R 1:"
    ):
        SceneViewer([], ARMS)


def test_without_rerun_the_command_that_adds_it_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match=r"rerun-sdk is not installed.*dlo-gym\[view\]"):
        SceneViewer([], ARMS)
