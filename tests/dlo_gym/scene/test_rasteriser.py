"""The rasteriser against OpenGL's images and MuJoCo's rays."""

import mujoco
import numpy as np
import pytest

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.board import BoardPlate
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.rasteriser import RasterCanvas
from dlo_gym.scene.renderer import SceneRenderer

CLAMP_ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
N_NODES = 51


def scene(renderer, **options):
    settings = {
        "cameras": default_cameras(1 / 3),
        "clutter": "industrial",
        "n_distractor_cables": 5,
        "n_occluders": 2,
    }
    return SceneRenderer(SceneConfig(renderer=renderer, **(settings | options)))


def random_pose(rng, arms):
    """Arguments of ``update``: a curve anywhere in the cell, arms near home, occluders."""
    t = np.linspace(0.0, 1.0, N_NODES)
    waves = rng.normal(0.0, 0.05, (3, 3)) @ np.sin(np.pi * np.outer([1, 2, 3], t))
    positions = np.column_stack([0.4 * (t - 0.5), 0.0 * t, 0.3 + 0.0 * t]) + waves.T
    turn = exp_so3([0.0, 0.0, rng.uniform(-1.0, 1.0)])
    positions = positions @ turn.T + rng.uniform(-0.05, 0.05, 3)
    clamps = BoundaryPoses(pose(CLAMP_ALONG_X, positions[0]), pose(CLAMP_ALONG_X, positions[-1]))
    occluders = rng.uniform([-0.3, -0.5, 0.1], [0.3, 0.0, 0.6], (2, 3))
    return positions, clamps, occluders, arms.home + rng.normal(0.0, 0.25, (2, 6))


@pytest.fixture(scope="module")
def raster():
    with scene("raster") as renderer:
        yield renderer


@pytest.fixture(scope="module")
def opengl():
    with scene("opengl") as renderer:
        renderer.update(*random_pose(np.random.default_rng(0), renderer.arms))
        try:
            renderer.rod_mask("side")
        except RenderingUnavailable as error:
            pytest.skip(str(error))
        yield renderer


@pytest.mark.parametrize("seed", range(6))
def test_masks_and_images_are_opengls(raster, opengl, seed):
    arguments = random_pose(np.random.default_rng(seed), raster.arms)
    raster.update(*arguments)
    opengl.update(*arguments)
    for camera in raster.config.cameras:
        ours, theirs = raster.rod_mask(camera.name), opengl.rod_mask(camera.name)
        assert theirs.sum() > 200
        assert (ours & theirs).sum() >= 0.9 * (ours | theirs).sum()
        np.testing.assert_array_equal(
            raster.visibility(camera.name), opengl.visibility(camera.name)
        )
        images = [r.render(camera.name).image.astype(int) for r in (raster, opengl)]
        away = np.abs(images[0] - images[1]).max(axis=-1)
        assert np.median(away) <= 3
        assert (away > 40).mean() < 0.04  # outlines, holes, highlights
        both = ours & theirs
        assert np.abs(np.median(images[0][both] - images[1][both], axis=0)).max() <= 12


def test_the_masks_show_the_same_nodes(raster, opengl):
    agree = []
    for seed in range(12):
        arguments = random_pose(np.random.default_rng(100 + seed), raster.arms)
        raster.update(*arguments)
        opengl.update(*arguments)
        for camera in raster.config.cameras:
            pixels = camera.project(arguments[0])
            u, v = np.round(pixels[camera.sees(pixels)]).astype(int).T
            agree.append(raster.rod_mask(camera.name)[v, u] == opengl.rod_mask(camera.name)[v, u])
    assert np.concatenate(agree).mean() >= 0.98


def mujoco_distances(renderer, origin, directions):
    geom = np.zeros(1, dtype=np.int32)
    distances = [
        mujoco.mj_ray(renderer.model, renderer.data, origin, ray, None, True, -1, geom)
        for ray in directions
    ]
    return np.where(np.array(distances) < 0, np.inf, distances)


def test_depth_is_that_of_mujocos_rays(raster):
    rng = np.random.default_rng(3)
    scenery = np.flatnonzero(raster.model.geom_group == 1)
    canvas = RasterCanvas(raster.model, scenery)
    for _ in range(4):
        raster.update(*random_pose(rng, raster.arms))
        for camera in raster.config.cameras:
            layer = canvas.layer(raster.data, camera.name, camera)
            u, v = rng.integers(0, [camera.width, camera.height], (400, 2)).T
            rays = camera.rays(np.column_stack([u, v]).astype(float))
            distances = mujoco_distances(raster, camera.centre, rays)
            depths = distances * (rays @ camera.T_world_camera[:3, 2])
            np.testing.assert_allclose(1.0 / layer.nearness[v, u], depths, rtol=1e-6)


def test_visibility_is_that_of_mujocos_rays(raster):
    rng = np.random.default_rng(4)
    for _ in range(6):
        positions, *others = random_pose(rng, raster.arms)
        raster.update(positions, *others)
        for camera in raster.config.cameras:
            tangents = np.gradient(positions, axis=0)
            tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
            towards = camera.centre - positions
            across = towards - (towards * tangents).sum(axis=1, keepdims=True) * tangents
            across *= 0.003 / np.linalg.norm(across, axis=1, keepdims=True)
            rays = positions + across - camera.centre
            lengths = np.linalg.norm(rays, axis=1)
            hits = mujoco_distances(raster, camera.centre, rays / lengths[:, None])
            seen = (hits >= lengths - 0.003) & camera.sees(camera.project(positions))
            np.testing.assert_array_equal(raster.visibility(camera.name), seen)


def test_a_body_that_comes_to_the_camera_fills_the_image(raster):
    positions, clamps, occluders, angles = random_pose(np.random.default_rng(5), raster.arms)
    camera = raster.config.cameras[0]
    # From 1 cm before the optical centre on: nearer than any outline.
    occluders[0] = camera.centre + 0.08 * camera.T_world_camera[:3, 2]
    raster.update(positions, clamps, occluders, angles)
    assert not raster.rod_mask("side").any()
    assert not raster.visibility("side").any()
    assert np.ptp(raster.render("side").image.reshape(-1, 3), axis=0).max() <= 90


def test_images_are_the_same_again_and_for_another_renderer(raster):
    arguments = random_pose(np.random.default_rng(6), raster.arms)
    raster.update(*arguments)
    first = raster.views()
    raster.update(*random_pose(np.random.default_rng(7), raster.arms))
    assert (raster.render("side").image != first[0].image).any()
    raster.update(*arguments)
    with scene("raster") as other:
        other.update(*arguments)
        for renderer in (raster, other):
            for one, again in zip(first, renderer.views(), strict=True):
                np.testing.assert_array_equal(one.image, again.image)
                assert not np.shares_memory(one.image, again.image)


def test_no_opengl_is_opened(raster, monkeypatch):
    def refuse(*_):
        raise RenderingUnavailable("no OpenGL in this test")

    monkeypatch.setattr("dlo_gym.scene.opengl_canvas._open_context", refuse)
    with scene("raster") as renderer:
        renderer.update(*random_pose(np.random.default_rng(0), renderer.arms))
        renderer.views()
        renderer.rod_mask("top")


def test_what_it_cannot_draw_is_refused():
    plate = BoardPlate("left", np.zeros((4, 4), np.uint8), (0.1, 0.1), np.eye(4))
    for options in ({"boards": (plate,)}, {"quality": "high"}):
        with pytest.raises(ValueError, match='renderer: expected "opengl" for boards or quality'):
            SceneConfig(renderer="raster", **options)
    with pytest.raises(ValueError, match="renderer: expected one of opengl, raster, got 'vulkan'"):
        SceneConfig(renderer="vulkan")
