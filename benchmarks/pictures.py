"""An animated picture of every task, for the docs: ``python -m benchmarks.pictures``."""

from argparse import ArgumentParser
from math import ceil, tau
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from control.evaluate import gate_for, make_controller, make_env, run_episode
from dlo_gym.atomic_file import written_aside
from dlo_gym.envs.shape_env import ShapeControlEnv
from dlo_gym.envs.wrap_bar_env import WrapBarEnv
from dlo_gym.envs.wrap_bar_script import WrapScript
from dlo_gym.exceptions import DloError
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array
from dlo_gym.overlay import GOAL, draw_centerline

FOLDER = Path(__file__).parents[1] / "docs" / "images" / "tasks"
HEIGHT, WIDTH, FOCAL_LENGTH = 225, 360, 333.0  # of a view [pixels]
OVERSAMPLED = 2  # rendered so many times larger, for smooth edges
COLORS, VIVID = 64, 60  # of the palette; a color is vivid if its channels differ by so much
GOAL_WIDTH = 30.0  # of its line, in a 1080-line image [pixels]
STEP_MS, LAST_MS = 100, 1500  # how long a step stays: real time, then the goal
MOST_FRAMES = 16  # of longer ways every second step is shown, or every third
ARRIVED = 2e-3  # mean node error that ends the picture [m]
LARGEST = 300_000  # of a file [bytes]

Point = tuple[float, float, float]


def camera(name: str, at: Point, target: Point, up: Point = (0.0, 0.0, 1.0)) -> CameraModel:
    return CameraModel.looking_at(
        name, at, target, width=WIDTH, height=HEIGHT, focal_length=FOCAL_LENGTH, up=up
    )


CAMERAS = (
    camera("side", (0.05, -0.85, 0.5), (0.0, 0.0, 0.3)),
    camera("top", (0.0, -0.05, 1.1), (0.0, 0.02, 0.3), up=(0.0, 1.0, 0.0)),
)
WIDE = (
    camera("side", (0.05, -1.1, 0.55), (-0.05, 0.0, 0.33)),
    camera("top", (-0.1, 0.0, 1.3), (-0.1, 0.07, 0.3), up=(0.0, 1.0, 0.0)),
)
HANGING = (
    camera("side", (0.1, -1.05, 0.6), (-0.1, 0.0, 0.42)),
    camera("top", (-0.1, -0.05, 1.4), (-0.1, 0.02, 0.5), up=(0.0, 1.0, 0.0)),
)
AROUND_THE_BAR = (
    camera("side", (0.1, -0.95, 0.6), (0.0, 0.1, 0.4)),
    camera("along the bar", (0.3, -0.75, 0.75), (0.0, 0.1, 0.38)),
)


class Episode(NamedTuple):
    """What is shown of a task: a controller's way from the start to the goal of a seed.

    The controller ``"script"`` is that of the wrap-bar task.
    """

    controller: str = "mpc"
    seed: int = 0
    max_steps: int = 60
    cameras: tuple[CameraModel, ...] = CAMERAS


# By environment: ``dlo_gym/NAME-v0``.
EPISODES = {
    "ShapeControlEasy": Episode(),
    "ShapeControl": Episode(),
    "ShapeControlMedium": Episode(),
    "ShapeControlHard": Episode(seed=0, cameras=WIDE),
    "ShapeControlPlanar": Episode(),
    "ShapeControlOneArm": Episode(cameras=HANGING),
    "ShapeControlObstacle": Episode(controller="over", max_steps=100, cameras=WIDE),
    "WrapBar": Episode(controller="script", max_steps=150, cameras=AROUND_THE_BAR),
}


def frames(name: str, episode: Episode) -> list[NDArray[np.uint8]]:
    """Both views, with the goal drawn in where it is a shape, step by step until it is reached.

    Raises:
        DloError: if it is not.
    """
    env = make_env(
        f"dlo_gym/{name}-v0",
        cameras=episode.cameras,
        image_scale=OVERSAMPLED,
        quality="high",
    )
    inner = env.unwrapped
    assert isinstance(inner, ShapeControlEnv)
    if isinstance(inner, WrapBarEnv):
        return wound_frames(inner, episode)
    gate = gate_for(inner.config)
    controller = make_controller(episode.controller, gate.limits, inner.config)
    made, error = [], np.inf
    for step in run_episode(env, controller, gate, seed=episode.seed, max_steps=episode.max_steps):
        error = step.shape_error
        image = np.hstack([drawn(view, step.goal) for view in inner.cell.views()])
        made.append(captioned(image, f"{step.stamp:.1f} s, {1e3 * error:.0f} mm to the"))
        if error <= ARRIVED:
            break
    env.close()
    if error > ARRIVED:
        raise DloError(f"{name}: {1e3 * error:.1f} mm from the goal at the end")
    return made


def wound_frames(env: WrapBarEnv, episode: Episode) -> list[NDArray[np.uint8]]:
    """Both views while the script winds the cable round the bar."""
    env.reset(seed=episode.seed)
    script, made = WrapScript(env), []
    for _ in range(episode.max_steps):
        *_, terminated, _, info = env.step(script.action())
        image = np.hstack([smooth(view) for view in env.cell.views()])
        text = f"{env.cell.stamp:.1f} s, {info['winding'] / tau:.2f} turns round the"
        made.append(captioned(image, text, "bar"))
        if terminated or info["success"]:
            break
    env.close()
    if not info["success"]:
        raise DloError(f"{env.config}: {info['winding'] / tau:.2f} turns at the end")
    return made


def smooth(view: View) -> NDArray[np.uint8]:
    """The oversampled view at its size."""
    return np.array(Image.fromarray(view.image).reduce(OVERSAMPLED))


def drawn(view: View, goal: Array) -> NDArray[np.uint8]:
    """The oversampled view at its size, with the goal (n, 3) [m] shining through it."""
    image = smooth(view)
    painted, seen_from = image.copy(), view.camera.scaled(1 / OVERSAMPLED)
    draw_centerline(painted, seen_from, goal, GOAL, thickness=GOAL_WIDTH)
    return np.asarray(Image.blend(Image.fromarray(image), Image.fromarray(painted), 0.6))


def captioned(image: NDArray[np.uint8], text: str, about: str = "goal") -> NDArray[np.uint8]:
    """With the text, and what it is ``about`` in the color of goals, in the upper left corner."""
    picture, font = Image.fromarray(image), ImageFont.load_default(13)
    draw = ImageDraw.Draw(picture)
    end = 8 + draw.textlength(f"{text} ", font=font)
    draw.rectangle((0, 0, end + draw.textlength(about, font=font) + 8, 22), fill=(30, 30, 30))
    draw.text((8, 3), text, font=font, fill=(240, 240, 240))
    draw.text((end, 3), about, font=font, fill=(225, 140, 245))
    return np.asarray(picture)


def write_gif(path: Path, images: list[NDArray[np.uint8]]) -> None:
    """Writes the images with one palette for all, whole or not at all."""
    pixels = np.concatenate([images[0], images[-1]]).reshape(-1, 3)
    vivid = pixels[np.ptp(pixels, axis=1) > VIVID]  # goal and cable: few, but looked at
    weighted = np.concatenate([pixels, np.tile(vivid, (1 + len(pixels) // (4 * len(vivid)), 1))])
    palette = Image.fromarray(weighted[None]).quantize(COLORS)
    stride = ceil(len(images) / MOST_FRAMES)
    indexed = [
        Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE)
        for image in images[::-stride][::-1]
    ]
    durations = [stride * STEP_MS] * (len(indexed) - 1) + [LAST_MS]
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path, DloError) as part:
        indexed[0].save(
            part,
            format="GIF",
            save_all=True,
            append_images=indexed[1:],
            duration=durations,
            loop=0,
            optimize=True,
        )


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(EPISODES), metavar="NAME")
    parser.add_argument("--out", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(EPISODES):
        parser.error(f"expected some of {', '.join(EPISODES)}, got {', '.join(sorted(unknown))}")
    for name in arguments.names:
        path = arguments.out / f"{name}.gif"
        images = frames(name, EPISODES[name])
        write_gif(path, images)
        size = path.stat().st_size
        if size > LARGEST:
            raise DloError(f"{path}: expected at most {LARGEST} bytes, got {size}")
        print(f"{path.name:22} {len(images):3} steps  {size / 1e3:4.0f} kB", flush=True)


if __name__ == "__main__":
    main()
