"""Milliseconds per view: OpenGL, the same with shadows and antialiasing, the rasteriser."""

import time

import numpy as np
from rich.console import Console
from rich.table import Table

from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.renderer import SceneRenderer

LEVEL = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
WAYS = {
    "fast": {},
    "high": {"quality": "high"},
    "raster": {"renderer": "raster"},
}
REPEATS = 20


def main() -> None:
    boundary = BoundaryPoses(pose(LEVEL, [-0.2, 0.0, 0.34]), pose(LEVEL, [0.2, 0.0, 0.34]))
    positions = CosseratRod(RodProperties(length=0.5)).settle(boundary).positions
    table = Table(
        "view", "fast ms", "high ms", "raster ms", "high / fast", "fast / raster", "in CPU time",
        title="medians per view of two, clutter, occluder",
    )  # fmt: skip
    for height in (360, 720, 1080):
        wall, cpu = {name: [] for name in WAYS}, {name: [] for name in WAYS}  # [ms per view]
        renderers = {
            name: SceneRenderer(
                SceneConfig(
                    cameras=default_cameras(height / 1080),
                    clutter="industrial",
                    n_distractor_cables=3,
                    n_occluders=1,
                    **options,
                )
            )
            for name, options in WAYS.items()
        }
        for i in range(REPEATS):  # in turns, so that all meet the same load
            for name, renderer in renderers.items():
                renderer.update(positions, boundary, [[0.002 * i, -0.2, 0.3]])
                began = time.perf_counter(), time.process_time()
                renderer.views()
                wall[name].append(500.0 * (time.perf_counter() - began[0]))
                cpu[name].append(500.0 * (time.process_time() - began[1]))
        for renderer in renderers.values():
            renderer.close()
        wall, cpu = ({k: np.median(v[4:]) for k, v in times.items()} for times in (wall, cpu))
        table.add_row(
            f"{height * 16 // 9}x{height}",
            *(f"{wall[name]:.1f}" for name in WAYS),
            f"{wall['high'] / wall['fast']:.1f}x",
            f"{wall['fast'] / wall['raster']:.1f}x",
            f"{cpu['fast'] / cpu['raster']:.1f}x",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
