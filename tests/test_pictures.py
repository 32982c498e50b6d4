"""The animated pictures of the tasks, as the docs show them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dlo_gym
from benchmarks.pictures import EPISODES, FOLDER, LARGEST, MOST_FRAMES, write_gif

PAGE = Path(__file__).parents[1] / "docs" / "environments.md"


def test_every_task_has_an_episode():
    assert {f"ShapeControl{task}" for task in dlo_gym.SHAPE_TASKS} | {"WrapBar"} == set(EPISODES)


@pytest.mark.parametrize("name", EPISODES)
def test_the_page_shows_a_moving_picture_of_the_task(name):
    assert f"(images/tasks/{name}.gif)" in PAGE.read_text()
    path = FOLDER / f"{name}.gif"
    assert path.stat().st_size <= LARGEST
    with Image.open(path) as picture:
        assert picture.n_frames >= 5
        first = np.asarray(picture.convert("RGB"))
        picture.seek(picture.n_frames - 1)
        assert (np.asarray(picture.convert("RGB")) != first).mean() > 0.05


def test_a_picture_plays_in_real_time_and_keeps_its_colors(tmp_path):
    images = [np.full((60, 80, 3), 90, np.uint8) for _ in range(2 * MOST_FRAMES)]
    for i, image in enumerate(images):
        image[20:30, i : i + 10] = 190, 60, 220
    write_gif(tmp_path / "a.gif", images)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == MOST_FRAMES
        assert picture.info["duration"] == 200
        picture.seek(picture.n_frames - 1)
        assert picture.info["duration"] == 1500
        last = np.asarray(picture.convert("RGB")).astype(int)
    assert np.abs(last - images[-1]).max() <= 4
