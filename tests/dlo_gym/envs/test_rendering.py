"""Every render mode, and Gymnasium's wrappers around them."""

import math
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import HumanRendering, RecordVideo, RenderCollection

import dlo_gym
from dlo_gym.envs.shape_env import ShapeControlEnv
from dlo_gym.exceptions import MissingExtra
from tests.dlo_gym.rrd import read_rrd

STATE_ID = "dlo_gym/ShapeControl-v0"
RASTER = {"renderer": "raster", "image_scale": 0.1}  # needs no OpenGL


def make(task="", **options):
    return gym.make(f"dlo_gym/ShapeControl{task}-v0", **RASTER | options)


def test_what_is_declared_is_what_is_there():
    assert ShapeControlEnv.metadata["render_modes"] == ["human", "rgb_array"]
    for mode in ShapeControlEnv.metadata["render_modes"]:
        ShapeControlEnv(render_mode=mode).close()
    with pytest.raises(ValueError, match=r"render_mode: expected .*human.*rgb_array.*'ansi'"):
        ShapeControlEnv(render_mode="ansi")
    with pytest.raises(ValueError, match=r"render_mode: expected None or 'rgb_array' .* 'human'"):
        gym.make_vec(STATE_ID, 2, render_mode="human")


def test_a_list_holds_the_images_since_the_last_one():
    env = make(render_mode="rgb_array_list")
    assert isinstance(env, RenderCollection)
    assert env.render_mode == "rgb_array_list"
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.ones(10, np.float32))
    images = env.render()
    assert [image.shape for image in images] == 4 * [(108, 384, 3)]
    assert (images[0] != images[-1]).any()
    assert env.render() == []
    env.step(np.zeros(10, np.float32))
    env.reset(seed=1)  # forgets the images of the episode before
    assert len(env.render()) == 1
    env.close()


@pytest.mark.parametrize("task", dlo_gym.SHAPE_TASKS)
def test_human_mode_writes_the_scene_for_the_viewer(task, tmp_path):
    pytest.importorskip("rerun")
    env = make(task, render_mode="human", render_file=tmp_path / "episodes.rrd")
    inner, cables, goals, errors = env.unwrapped, [], [], []
    for seed in (0, 1):
        _, info = env.reset(seed=seed)
        goals.append(inner.goal)
        for _ in range(2):
            cables.append(inner.cell.rod_state.positions)
            errors.append(1e3 * info["shape_error"])
            *_, info = env.step(env.action_space.sample())
            assert env.render() is None
        cables.append(inner.cell.rod_state.positions)
        errors.append(1e3 * info["shape_error"])
    env.close()
    env.close()
    shown = read_rrd(tmp_path / "episodes.rrd")
    for entity, curves in (("/world/cable", cables), ("/world/goal", goals)):
        strips = np.array(shown[entity]["LineStrips3D:strips"])[:, 0]
        np.testing.assert_allclose(strips, curves, atol=1e-6)
    np.testing.assert_allclose(
        np.ravel(shown["/progress/goal_distance_mm"]["Scalars:scalars"]), errors
    )
    # Episodes follow each other in time.
    assert shown["/world/cable"]["run"] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    for name in ("side", "top"):
        assert len(shown[f"/world/cameras/{name}/image"]["EncodedImage:blob"]) == 6
        assert len(shown[f"/world/cameras/{name}/image/goal"]["LineStrips2D:strips"]) == 2
    for side in ("left", "right"):
        assert len(shown[f"/world/arms/{side}"]["Capsules3D:translations"]) == 6
    assert len(shown["/world/grippers/left"]["Transform3D:translation"]) == 6
    assert [*map(tuple, shown["/log"]["TextLog:text"])] == [("episode 1",), ("episode 2",)]
    assert "/world/estimate" not in shown  # the state is the estimate


def test_human_mode_shows_what_the_tracker_makes_of_it_and_why_an_episode_ended(tmp_path):
    pytest.importorskip("rerun")
    env = make("Tracked", image_scale=0.3, render_mode="human", render_file=tmp_path / "a.rrd")
    env.reset(seed=0)
    estimates = [env.unwrapped.estimate.centerline]
    apart = np.zeros(10, np.float32)
    apart[[0, 5]] = -1.0, 1.0
    terminated = False
    while not terminated:
        *_, terminated, _, info = env.step(apart)
        estimates.append(env.unwrapped.estimate.centerline)
    env.close()
    shown = read_rrd(tmp_path / "a.rrd")
    strips = np.array(shown["/world/estimate"]["LineStrips3D:strips"])[:, 0]
    np.testing.assert_allclose(strips, estimates, atol=1e-6)
    assert len(shown["/world/cameras/top/image/estimate"]["LineStrips2D:strips"]) == len(strips)
    assert shown["/log"]["TextLog:text"][-1] == [f"ended by {info['termination']}"]


def test_human_mode_shows_a_bar_and_how_far_the_cable_is_wound_round_it(tmp_path):
    pytest.importorskip("rerun")
    options = RASTER | {"render_mode": "human", "render_file": tmp_path / "a.rrd"}
    env = gym.make("dlo_gym/WrapBar-v0", **options)
    _, info = env.reset(seed=0)
    bar, stand = env.unwrapped.cell.obstacles
    env.close()
    shown = read_rrd(tmp_path / "a.rrd")
    assert shown["/progress/turns"]["Scalars:scalars"] == [[info["winding"] / math.tau]]
    bars, boxes = (shown[f"/world/obstacles/{kind}"] for kind in ("capsules", "boxes"))
    end = bar.pose[:3, 3] - bar.half_length * bar.pose[:3, 2]
    np.testing.assert_allclose(bars["Capsules3D:translations"][0], [end], atol=1e-6)
    np.testing.assert_allclose(boxes["Boxes3D:centers"][0], [stand.pose[:3, 3]], atol=1e-6)
    assert "/world/goal" not in shown


def test_a_file_of_before_is_kept(tmp_path):
    pytest.importorskip("rerun")
    (tmp_path / "a.rrd").write_bytes(b"mine")
    env = make(render_mode="human", render_file=str(tmp_path / "a.rrd"))
    with pytest.raises(FileExistsError, match=r"a\.rrd exists"):
        env.reset(seed=0)
    env.close()
    assert (tmp_path / "a.rrd").read_bytes() == b"mine"


def test_without_rerun_human_mode_tells_the_command_that_adds_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    env = make(render_mode="human")
    with pytest.raises(MissingExtra, match=r"rerun-sdk is not installed.*dlo-gym\[view\]"):
        env.reset(seed=0)
    env.close()


def test_other_modes_write_no_file(tmp_path):
    env = make(render_mode="rgb_array", render_file=tmp_path / "a.rrd")
    env.reset(seed=0)
    assert env.render().shape == (108, 384, 3)
    env.close()
    assert list(tmp_path.iterdir()) == []


def test_gymnasiums_video_recorder_takes_the_images(tmp_path):
    pytest.importorskip("moviepy")
    iio = pytest.importorskip("imageio.v2")
    env = RecordVideo(make(render_mode="rgb_array"), str(tmp_path / "v"), disable_logger=True)
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    env.close()
    (video,) = tmp_path.glob("v/*.mp4")
    with iio.get_reader(video) as reader:
        assert reader.get_meta_data()["fps"] == 10  # the control step
        frames = [frame.shape for frame in reader]
    assert frames == 5 * [(108, 384, 3)]


def test_gymnasiums_window_takes_the_images(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = HumanRendering(make(render_mode="rgb_array"))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    shown = pygame.surfarray.array3d(env.window).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, env.env.render())
    env.close()
