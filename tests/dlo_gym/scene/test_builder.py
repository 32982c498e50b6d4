"""Settings that must reach the compiled MuJoCo model."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.scene.arms import DualArm
from dlo_gym.scene.builder import MULTISAMPLES, SceneConfig, build_spec, default_cameras
from dlo_gym.scene.clearance import CAPSULES
from dlo_gym.scene.ur5e import link_frames


def compiled(**settings):
    settings.setdefault("cameras", default_cameras(1 / 6))
    return build_spec(SceneConfig(**settings)).compile()


def test_default_cameras_are_named_and_see_the_rod():
    side, top = default_cameras(0.5)
    assert (side.name, top.name) == ("side", "top")
    assert (side.width, side.height) == (960, 540)
    for camera in (side, top):
        assert camera.K[0, 0] == pytest.approx(700.0)
        assert camera.sees(camera.project([[-0.3, 0, 0.3], [0.3, 0, 0.3], [0, 0, 0.1]])).all()


def test_rod_settings_reach_the_model():
    model = compiled(n_nodes=21, rod_radius=0.004, rod_color=(0.1, 0.2, 0.3))
    geoms = [model.geom(f"rod_{i}") for i in range(20)]
    for geom in geoms:
        assert geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE
        assert geom.size[0] == pytest.approx(0.004)
        np.testing.assert_allclose(model.mat_rgba[geom.matid[0]], [0.1, 0.2, 0.3, 1.0], atol=1e-6)
    with pytest.raises(KeyError):
        model.geom("rod_20")


def test_intrinsics_and_extrinsics_reach_the_model():
    camera = default_cameras(0.5)[0]
    K = np.array([[650.0, 0.0, 500.0], [0.0, 640.0, 250.0], [0.0, 0.0, 1.0]])
    model = compiled(cameras=(replace(camera, K=K),))
    pixels = model.cam_intrinsic[0] / model.cam_sensorsize[0][[0, 1, 0, 1]]
    pixels = pixels * np.tile(model.cam_resolution[0], 2)
    np.testing.assert_allclose(pixels, [650.0, 640.0, 479.5 - 500.0, 269.5 - 250.0], rtol=1e-5)
    np.testing.assert_allclose(model.cam_pos[0], camera.centre, atol=1e-6)


def test_the_framebuffer_holds_the_widest_pinhole_image():
    camera = replace(default_cameras(0.25)[0], distortion=np.array([-0.2, 0.05, 0, 0, 0]))
    model = compiled(cameras=(camera,))
    assert model.vis.global_.offwidth > camera.width
    assert model.vis.global_.offheight > camera.height


@pytest.mark.parametrize(("quality", "samples", "shadow"), [("fast", 0, 0), ("high", 4, 1)])
def test_quality_reaches_the_model(quality, samples, shadow):
    assert MULTISAMPLES == 4
    model = compiled(quality=quality)
    assert model.vis.quality.offsamples == samples
    assert model.light_castshadow.max() == shadow


def test_clutter_cables_and_occluders_reach_the_model():
    plain = compiled().ngeom
    assert compiled(clutter="industrial").ngeom > plain + 30
    assert compiled(n_distractor_cables=3).ngeom == plain + 3 * 40
    model = compiled(n_occluders=2, occluder_size=(0.2, 0.02, 0.1))
    np.testing.assert_allclose(model.geom("occluder_1").size, [0.1, 0.01, 0.05])


def test_the_seed_alone_decides_the_distractor_cables():
    one, same, other = (compiled(n_distractor_cables=2, seed=s) for s in (4, 4, 5))
    np.testing.assert_array_equal(one.geom_pos, same.geom_pos)
    assert np.abs(one.geom_pos - other.geom_pos).max() > 0.01


def test_the_models_joints_move_as_the_kinematics_say():
    base = pose(exp_so3([[0.0, 0.1, 0.4], [0.0, 0.0, 2.0]]), [[-0.7, 0.1, 0.1], [0.8, 0.2, 0.0]])
    arms = DualArm(T_world_base=base)
    model = compiled(arms=arms)
    data = mujoco.MjData(model)
    q = np.random.default_rng(1).uniform(-3, 3, (2, 6))
    data.qpos[:] = q.ravel()
    mujoco.mj_kinematics(model, data)
    held = arms.forward_kinematics(q)
    for side, clamp, along in (("left", held.left, 1.0), ("right", held.right, -1.0)):
        site = data.site(f"{side}_tcp")
        np.testing.assert_allclose(site.xpos, clamp[:3, 3], atol=1e-6)
        np.testing.assert_allclose(site.xmat.reshape(3, 3)[:, 2], along * clamp[:3, 2], atol=1e-6)
        np.testing.assert_allclose(site.xmat.reshape(3, 3)[:, 0], clamp[:3, 1], atol=1e-6)


def test_collision_capsules_cover_what_is_drawn():
    arms = DualArm()
    model = compiled(arms=arms)
    data = mujoco.MjData(model)
    data.qpos[:] = arms.home.ravel()
    mujoco.mj_kinematics(model, data)
    frames = arms.T_world_base[0] @ link_frames(arms.home[0])
    for frame in range(7):
        body = model.body(f"left_link_{frame}")
        capsules = [c for c in CAPSULES if c[0] == frame]
        for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            corners = _extreme_points(model, data, geom)
            local = (corners - frames[frame, :3, 3]) @ frames[frame, :3, :3]
            outside = np.min([_outside(local, *c[1:]) for c in capsules], axis=0)
            # Caps and rims stick out of the round ends a little.
            assert outside.max() < 0.03, (frame, model.geom(geom).name, outside.max())


def _extreme_points(model, data, geom):
    half = model.geom_size[geom].copy()
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        ring = np.column_stack([np.cos(angle), np.sin(angle)]) * half[0]
        points = np.vstack([np.column_stack([ring, np.full(16, s * half[1])]) for s in (-1, 1)])
    else:
        points = np.array(np.meshgrid(*np.outer(half, [-1, 1]))).reshape(3, -1).T
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T


def _outside(points, start, end, radius):
    start, axis = np.asarray(start), np.subtract(end, start)
    t = np.clip((points - start) @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
    return np.linalg.norm(points - start - t[:, None] * axis, axis=1) - radius


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"cameras": ()}, "cameras: expected at least one"),
        ({"cameras": (default_cameras()[0],) * 2}, "distinct names"),
        ({"rod_radius": -0.1}, "rod_radius"),
        ({"n_nodes": 1}, "n_nodes"),
        ({"rod_color": (255, 0, 0)}, "rod_color"),
        ({"clutter": "messy"}, "clutter: expected one of none, industrial, got 'messy'"),
        ({"quality": "best"}, "quality: expected one of fast, high"),
        ({"n_occluders": -1}, "n_occluders"),
        ({"occluder_size": (0.1, 0.0, 0.1)}, "occluder_size"),
    ],
)
def test_a_bad_setting_is_named(settings, said):
    with pytest.raises(ValueError, match=said):
        SceneConfig(**settings)
