"""What the cameras see, against what the camera model says they must see."""

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from dlo_gym.exceptions import RenderingUnavailable, UnreachablePose
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene import opengl_canvas
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.renderer import SceneRenderer

CLAMP_ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
N_NODES = 51


def hanging(sag=0.11):
    """A curve from clamp to clamp, level at both, ``sag`` deep [m]."""
    t = np.linspace(0.0, 1.0, N_NODES)
    depth = sag * np.sin(np.pi * t) ** 2
    positions = np.column_stack([-0.2 + 0.4 * t, 0.03 * np.sin(2 * np.pi * t), 0.34 - depth])
    return positions, BoundaryPoses(
        pose(CLAMP_ALONG_X, positions[0]), pose(CLAMP_ALONG_X, positions[-1])
    )


def loop(camera):
    """A curve whose nodes 15 and 35 lie on one ray of the camera, 35 farther away."""
    t = np.linspace(-1.0, 1.0, N_NODES)
    flat = np.column_stack(
        [0.2 * t - 0.1361 * np.sin(2 * np.pi * t), 0.0 * t, 0.28 + 0.06 * np.cos(np.pi * t)]
    )
    away = 1.0 + 0.04 * np.sin(np.pi * t / 2)
    return camera.centre + (flat - camera.centre) * away[:, None]


def opened(config, positions=None):
    scene = SceneRenderer(config)
    hung, boundary = hanging()
    scene.update(hung if positions is None else positions, boundary)
    try:
        scene.rod_mask(config.cameras[0].name)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    return scene


@pytest.fixture(scope="module", params=["opengl", "raster"])
def plain(request):
    panel = (0.14, 0.012, 0.14)
    config = SceneConfig(
        cameras=default_cameras(0.5),
        n_occluders=1,
        occluder_size=panel,
        renderer=request.param,
    )
    with opened(config) as scene:
        yield scene


def offsets_across(mask, pixels, nodes):
    """Signed distance [pixels] of the mask's centroid from each node, across the curve."""
    offsets = []
    for i in nodes:
        u, v = pixels[i]
        along = pixels[i + 1] - pixels[i - 1]
        along /= np.linalg.norm(along)
        y, x = np.mgrid[round(v) - 9 : round(v) + 10, round(u) - 9 : round(u) + 10]
        away = np.stack([x - u, y - v], axis=-1)
        near = mask[y, x] & (np.abs(away @ along) < 4)
        offsets.append((away @ [-along[1], along[0]])[near].mean())
    return np.array(offsets)


@pytest.mark.parametrize(
    ("renderer", "quality"), [("opengl", "fast"), ("opengl", "high"), ("raster", "fast")]
)
@pytest.mark.parametrize("distortion", [None, [-0.25, 0.08, 0.002, -0.003, -0.01]])
@pytest.mark.parametrize("name", ["side", "top"])
def test_projected_nodes_lie_on_the_rendered_rod(name, distortion, renderer, quality):
    # Off-centre principal point and unequal focal lengths: each must have its own effect.
    K = np.array([[720.0, 0.0, 455.0], [0.0, 690.0, 290.0], [0.0, 0.0, 1.0]])
    camera = next(c for c in default_cameras(0.5) if c.name == name)
    camera = replace(camera, K=K, distortion=None if distortion is None else np.array(distortion))
    with opened(SceneConfig(cameras=(camera,), renderer=renderer, quality=quality)) as scene:
        mask = scene.rod_mask(name)
        offsets = offsets_across(mask, camera.project(hanging()[0]), range(2, N_NODES - 2))
        assert np.abs(offsets).max() < 0.5
        assert abs(offsets.mean()) < 0.1


def test_the_image_shows_the_rods_colour_where_the_mask_is_and_only_there(plain):
    plain.update(*hanging())
    view = plain.render("side", stamp=1.5)
    assert view.camera is plain.config.cameras[0]
    assert view.stamp == 1.5
    mask = plain.rod_mask("side")
    red = view.image[..., 0].astype(int) - view.image[..., 1:].max(axis=-1)
    assert np.median(red[mask]) > 80
    assert (red[~mask] > 60).sum() < 0.02 * mask.sum()


def test_the_masks_width_is_the_rods(plain):
    plain.update(*hanging())
    camera = plain.config.cameras[0]
    positions, _ = hanging()
    depth = (positions - camera.centre) @ camera.T_world_camera[:3, 2]
    pixels = camera.project(positions)
    length = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    width = 2 * plain.config.rod_radius * camera.K[0, 0] / depth[1:]
    assert plain.rod_mask("side").sum() == pytest.approx((length * width).sum(), rel=0.05)


def test_views_come_in_the_cameras_order_and_do_not_share_pixels(plain):
    plain.update(*hanging())
    first, second = plain.views(0.5), plain.views(0.6)
    assert [view.camera.name for view in first] == ["side", "top"]
    assert not np.shares_memory(first[0].image, second[0].image)
    np.testing.assert_array_equal(first[0].image, second[0].image)


def test_two_open_renderers_do_not_disturb_each_other(plain):
    plain.update(*hanging())
    before = plain.rod_mask("side")
    with opened(SceneConfig(cameras=default_cameras(0.25), rod_radius=0.006)) as other:
        small = other.rod_mask("side")
        np.testing.assert_array_equal(plain.rod_mask("side"), before)
        np.testing.assert_array_equal(other.rod_mask("side"), small)


def test_a_clear_rod_is_seen_but_for_an_end_under_its_gripper(plain):
    positions, boundary = hanging()
    plain.update(positions, boundary)
    assert plain.visibility("side")[1:-1].all()
    assert plain.visibility("top")[1:-1].all()
    pitched = pose(exp_so3([0.0, 0.8, 0.0]) @ CLAMP_ALONG_X, positions[0])
    plain.update(positions, BoundaryPoses(pitched, boundary.right))
    assert plain.visibility("top").tolist().index(True) > 0
    assert plain.visibility("side")[1:-1].all()


def test_a_hidden_occluder_is_not_drawn(plain):
    plain.update(*hanging(), [[0.0, -30.0, 0.3]])
    without = plain.render("side").image
    for hidden in (None, [[np.nan] * 3]):
        plain.update(*hanging(), hidden)
        np.testing.assert_array_equal(plain.render("side").image, without)


def test_a_panel_hides_the_nodes_that_project_onto_it(plain):
    positions, boundary = hanging()
    camera = plain.config.cameras[0]
    plain.update(positions, boundary, [[0.05, -0.3, 0.28]])
    half = np.asarray(plain.config.occluder_size) / 2
    rays = positions - camera.centre
    hit = camera.centre + rays * ((-0.3 - half[1] - camera.centre[1]) / rays[:, 1])[:, None]
    behind = (np.abs(hit - [0.05, 0, 0.28])[:, [0, 2]] < half[[0, 2]]).all(axis=1)
    assert 5 < behind.sum() < 40
    visible = plain.visibility("side")
    np.testing.assert_array_equal(visible[2:-2], ~behind[2:-2])
    assert plain.visibility("top")[2:-2].all()
    # The image agrees.
    mask = plain.rod_mask("side")
    pixels = np.round(camera.project(positions)).astype(int)
    shown = np.array([mask[v - 1 : v + 2, u - 1 : u + 2].any() for u, v in pixels])
    clear_of_the_edge = np.flatnonzero(np.convolve(~behind, np.ones(3), "same") % 3 == 0)
    np.testing.assert_array_equal(shown[clear_of_the_edge], visible[clear_of_the_edge])
    plain.update(positions, boundary)
    assert plain.visibility("side")[2:-2].all()
    plain.update(positions, boundary, [[np.nan, 0, 0]])
    assert plain.visibility("side")[2:-2].all()


def test_where_the_rod_crosses_itself_the_farther_strand_is_hidden(plain):
    camera = plain.config.cameras[0]
    positions = loop(camera)
    plain.update(positions, hanging()[1])
    pixels = camera.project(positions)
    depth = np.linalg.norm(positions - camera.centre, axis=1)
    radius = plain.config.rod_radius * camera.K[0, 0] / depth
    i, j = np.indices((N_NODES, N_NODES))
    gap = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
    crossing = (gap < radius[:, None]) & (np.abs(i - j) > 5) & (depth[:, None] > depth[None] + 0.02)
    hidden = ~plain.visibility("side")
    assert crossing[35, 15]
    assert hidden[crossing.any(axis=1)].all()
    far_from_any = np.where(np.abs(i - j) > 3, gap, np.inf).min(axis=1) > 15
    assert not hidden[far_from_any & (i[:, 0] > 1) & (i[:, 0] < N_NODES - 2)].any()


def test_a_rod_seen_at_a_grazing_angle_does_not_hide_itself(plain):
    camera = plain.config.cameras[0]
    direction = np.array([0.12, 0.98, -0.1])
    start = camera.centre + np.array([-0.02, 0.5, -0.1])
    positions = start + np.linspace(0.0, 0.5, N_NODES)[:, None] * direction
    plain.update(positions, hanging()[1])
    assert plain.visibility("side").all()


def test_without_a_rod_none_is_drawn_and_none_is_seen(plain):
    camera = plain.config.cameras[0].name
    with opened(replace(plain.config, n_nodes=0), np.zeros((0, 3))) as bare:
        assert not bare.rod_mask(camera).any()
        assert bare.visibility(camera).shape == (0,)
        plain.update(*hanging())
        with_rod, mask = plain.render(camera).image, plain.rod_mask(camera)
        changed = (bare.render(camera).image != with_rod).any(axis=-1)
        assert changed[mask].all()
        assert not changed[~mask].any()
        with pytest.raises(ValueError, match=r"\(0, 3\)"):
            bare.update(*hanging())


def test_nodes_outside_the_image_are_not_seen(plain):
    positions, boundary = hanging()
    plain.update(positions + np.array([0.0, 0.0, 5.0]), boundary)
    assert not plain.visibility("side").any()


def test_an_arm_between_camera_and_rod_hides_it(plain):
    positions, _ = hanging()
    swung = pose(exp_so3([0.0, 0.0, 0.9]) @ CLAMP_ALONG_X, [-0.02, -0.12, 0.3])
    plain.update(positions, BoundaryPoses(swung, hanging()[1].right))
    assert not plain.visibility("side")[8:16].all()


def test_visibility_and_collisions_need_no_opengl(monkeypatch):
    def refuse(*_):
        raise RenderingUnavailable("no OpenGL in this test")

    monkeypatch.setattr(opengl_canvas, "_open_context", refuse)
    with SceneRenderer(SceneConfig(cameras=default_cameras(0.25))) as scene:
        scene.update(*hanging())
        assert scene.visibility("side")[2:-2].all()
        assert not scene.arms_in_collision()
        with pytest.raises(RenderingUnavailable):
            scene.render("side")


def test_a_missing_egl_names_the_packages(monkeypatch):
    def fail(*_):
        raise AttributeError("'NoneType' object has no attribute 'eglQueryDevicesEXT'")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr("mujoco.egl.GLContext", fail, raising=False)
    with SceneRenderer(SceneConfig(cameras=default_cameras(0.25))) as scene:
        scene.update(*hanging())
        with pytest.raises(RenderingUnavailable, match="libegl1 libegl-mesa0 libgl1-mesa-dri"):
            scene.render("side")


@pytest.mark.skipif(find_spec("triton") is None, reason="comes with torch's CUDA build alone")
def test_triton_can_be_imported_after_rendering():
    script = (
        "import mujoco\n"
        "from dlo_gym.scene.opengl_canvas import OpenGlCanvas\n"
        "OpenGlCanvas(mujoco.MjModel.from_xml_string('<mujoco/>'), shadows=False)\n"
        "import triton\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_an_unreachable_clamp_moves_nothing(plain):
    positions, boundary = hanging()
    plain.update(positions, boundary)
    q, seen = plain.joint_angles.copy(), plain.data.geom_xpos.copy()
    far = BoundaryPoses(pose(CLAMP_ALONG_X, [0.9, 0, 0.3]), boundary.right)
    with pytest.raises(UnreachablePose, match="left arm"):
        plain.update(positions + 0.01, far)
    np.testing.assert_array_equal(plain.joint_angles, q)
    np.testing.assert_array_equal(plain.data.geom_xpos, seen)


def test_joint_angles_may_be_given(plain):
    positions, boundary = hanging()
    plain.update(positions, boundary, joint_angles=plain.arms.home + 0.05)
    np.testing.assert_array_equal(plain.joint_angles, plain.arms.home + 0.05)


def test_collision_of_the_grippers_is_seen(plain):
    positions, boundary = hanging()
    plain.update(positions, boundary)
    assert not plain.arms_in_collision()
    left, right = pose(CLAMP_ALONG_X, [0.08, 0, 0.34]), pose(CLAMP_ALONG_X, [-0.08, 0, 0.34])
    plain.update(positions, BoundaryPoses(left, right))
    assert plain.arms_in_collision()


def test_bad_arguments_are_named(plain):
    positions, boundary = hanging()
    with pytest.raises(ValueError, match=r"positions: expected finite values of shape \(51, 3\)"):
        plain.update(positions[:-1], boundary)
    with pytest.raises(ValueError, match=r"occluder_positions: expected shape \(1, 3\)"):
        plain.update(positions, boundary, np.zeros((2, 3)))
    with pytest.raises(ValueError, match="there is no 'front'; there are: side, top"):
        plain.visibility("front")
    with SceneRenderer() as fresh, pytest.raises(ValueError, match="call update first"):
        fresh.visibility("side")


def test_closing_twice_is_harmless_and_a_later_image_opens_again():
    scene = opened(SceneConfig(cameras=default_cameras(1 / 6)))
    before = scene.render("side").image
    scene.close()
    scene.close()
    np.testing.assert_array_equal(scene.render("side").image, before)
    scene.close()
