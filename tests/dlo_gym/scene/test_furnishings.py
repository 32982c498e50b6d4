"""Obstacles and clutter in the images, and the arms' distance to obstacles."""

import numpy as np
import pytest

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod import Box, Capsule, Plane, Sphere
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import DualArm
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.clearance import CAPSULE_RADII, capsule_axes, obstacle_clearance
from dlo_gym.scene.furnishings import sample_clutter
from dlo_gym.scene.renderer import SceneRenderer

ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
POSITIONS = np.column_stack([np.linspace(-0.2, 0.2, 51), np.zeros(51), np.full(51, 0.3)])
CLAMPS = BoundaryPoses(pose(ALONG_X, POSITIONS[0]), pose(ALONG_X, POSITIONS[-1]))
ORANGE, GREY = (0.9, 0.6, 0.1), (0.5, 0.6, 0.7)
# On the side camera's ray to the rod's middle, 0.15 m before it, or beside that.
X, Z = 0.0071, 0.317
SHAPES = {
    "box": lambda x: Box(pose(np.eye(3), [x, -0.15, Z]), (0.03, 0.01, 0.03)),
    "post": lambda x: Capsule.between([x, -0.15, 0.0], [x, -0.15, 0.4], 0.03),
    "ball": lambda x: Sphere.at([x, -0.15, Z], 0.03),
}


@pytest.fixture(scope="module", params=["opengl", "raster"])
def scene(request):
    config = SceneConfig(
        cameras=default_cameras(0.25),
        renderer=request.param,
        obstacle_colors=(ORANGE, GREY),
        n_clutter=3,
    )
    with SceneRenderer(config) as scene:
        scene.update(POSITIONS, CLAMPS)
        try:
            scene.rod_mask("side")
        except RenderingUnavailable as error:
            pytest.skip(str(error))
        yield scene


def look(scene, *obstacles, clutter=None):
    scene.furnish(obstacles, clutter)
    scene.update(POSITIONS, CLAMPS)
    return scene.render("side").image.astype(int), scene.rod_mask("side"), scene.visibility("side")


@pytest.mark.parametrize("shape", SHAPES)
def test_an_obstacle_hides_the_rod_behind_it_in_image_mask_and_visibility(scene, shape):
    before, mask, visible = look(scene)
    image, mask_behind, visible_behind = look(scene, SHAPES[shape](X))
    hidden = visible & ~visible_behind
    # 6 cm at 0.9 m from the camera cover 7 cm at 1.05 m: 9 nodes.
    assert hidden[22:29].all()
    assert hidden.sum() <= 11
    gone = mask & ~mask_behind
    assert 0.1 < gone.sum() / mask.sum() < 0.35
    rgb = image[gone]
    assert (np.abs(rgb - before[gone]).sum(axis=1) > 60).all()
    assert (rgb[:, 0] > rgb[:, 2] + 60).mean() > 0.9  # orange
    assert (rgb[:, 1] > 0.4 * rgb[:, 0]).mean() > 0.9
    assert not (mask_behind & ~mask).any()


def test_obstacles_go_again_and_leave_no_trace(scene):
    before, mask, visible = look(scene)
    look(scene, SHAPES["box"](0.0), SHAPES["post"](0.1))
    after, mask_after, visible_after = look(scene)
    np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(mask, mask_after)
    np.testing.assert_array_equal(visible, visible_after)


def test_another_place_is_another_picture_though_scenery_is_kept(scene):
    first, *_ = look(scene, SHAPES["post"](-0.1))
    second, *_ = look(scene, SHAPES["post"](0.1))
    changed = np.flatnonzero((first != second).any(axis=(0, 2)))
    camera = scene.config.cameras[0]
    left, right = camera.project(np.array([[-0.1, -0.15, 0.3], [0.1, -0.15, 0.3]]))[:, 0]
    assert changed.min() < left < right < changed.max()
    assert changed.max() - changed.min() < 1.6 * (right - left)


def test_clutter_is_strewn_and_swept_away(scene):
    clutter = sample_clutter(np.random.default_rng(1), 2, 3, 3)
    before, *_ = look(scene)
    strewn, *_ = look(scene, clutter=clutter)
    assert (strewn != before).any(axis=2).mean() > 0.005
    model = scene.model
    block = model.geom("clutter_block_0_0").id
    np.testing.assert_allclose(model.geom_pos[block], clutter.blocks[0, :3])
    np.testing.assert_allclose(model.geom_size[block], clutter.blocks[0, 3:6])
    np.testing.assert_allclose(
        model.mat_rgba[model.geom_matid[block], :3], clutter.block_colors[0], rtol=1e-6
    )
    piece = model.geom("clutter_cable_1_7").id
    np.testing.assert_allclose(model.geom_pos[piece], clutter.cables[1, 7:9].mean(axis=0))
    assert model.geom_rgba[model.geom("clutter_cable_2_0").id, 3] == 0.0  # two cables, not three
    after, *_ = look(scene)
    np.testing.assert_array_equal(before, after)


def test_clutter_lies_on_the_table_beyond_the_cables_workspace():
    for seed in range(20):
        clutter = sample_clutter(np.random.default_rng(seed), 3, 5, 5)
        assert np.isnan(clutter.cable_radii[3:]).all()
        lowest = clutter.blocks[:, 2] - clutter.blocks[:, 5]
        np.testing.assert_allclose(lowest, 0.0, atol=1e-12)
        reach = np.abs(clutter.blocks[:, 1]) - np.hypot(*clutter.blocks[:, 3:5].T)
        assert (reach > 0.24).all()


def test_what_cannot_be_placed_is_refused(scene):
    with pytest.raises(ValueError, match="obstacles: expected at most 2, got 3"):
        scene.furnish([SHAPES["ball"](0.0)] * 3)
    with pytest.raises(ValueError, match=r"obstacles\[0\]: a Plane cannot be drawn"):
        scene.furnish([Plane()])
    with pytest.raises(ValueError, match="obstacle_colors: expected RGB"):
        SceneConfig(obstacle_colors=((0.1, 0.2, 1.2),))


def test_the_arms_distance_to_obstacles_is_that_of_dense_sampling():
    rng, arms = np.random.default_rng(0), DualArm()
    bodies = [
        Box(pose(exp_so3(rng.normal(size=3)), [0.1, 0.0, 0.3]), (0.05, 0.1, 0.02)),
        Sphere.at([-0.2, 0.1, 0.4], 0.05),
        Capsule.between([0.0, -0.3, 0.2], [0.1, 0.3, 0.6], 0.03),
        Sphere.at([-0.74, 0.15, 0.4], 0.1),
        Plane.through([0.0, 0.0, -0.1], [0.1, 0.0, 1.0]),
    ]
    joint_angles = arms.home + rng.normal(0.0, 0.4, (5, 2, 6))
    gaps = obstacle_clearance(arms.T_world_base, joint_angles, bodies)
    axes = capsule_axes(arms.T_world_base, joint_angles)
    shares = np.linspace(0.0, 1.0, 401)[:, None]
    points = axes[..., None, 0, :] * (1 - shares) + axes[..., None, 1, :] * shares
    for j, body in enumerate(bodies):
        distances = body.signed_distance(points) - CAPSULE_RADII[:, None]
        np.testing.assert_allclose(gaps[:, j], distances.min(axis=(1, 2, 3)), atol=2e-5)
    assert (gaps < 0).any()
    assert (gaps > 0).any()
