"""Milliseconds per rendered view, with and without shadows and antialiasing."""

import time

import numpy as np
from rich.console import Console
from rich.table import Table

from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryPoses, CosseratRod, RodProperties
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.renderer import SceneRenderer

LEVEL = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


def main() -> None:
    boundary = BoundaryPoses(pose(LEVEL, [-0.2, 0.0, 0.34]), pose(LEVEL, [0.2, 0.0, 0.34]))
    state = CosseratRod(RodProperties(length=0.5)).settle(boundary)
    table = Table("view", "fast ms", "high ms", "high / fast", title="one view, clutter, occluder")
    for height in (360, 720, 1080):
        medians = []
        for quality in ("fast", "high"):
            scene = SceneConfig(
                cameras=default_cameras(height / 1080),
                clutter="industrial",
                n_distractor_cables=3,
                n_occluders=1,
                quality=quality,
            )
            with SceneRenderer(scene) as renderer:
                times = []
                for i in range(24):
                    shift = np.array([[0.002 * i, -0.2, 0.3]])
                    renderer.update(state.positions, boundary, occluder_positions=shift)
                    began = time.perf_counter()
                    renderer.views()
                    times.append(1e3 * (time.perf_counter() - began) / len(scene.cameras))
            medians.append(np.median(times[4:]))
        fast, high = medians
        table.add_row(
            f"{height * 16 // 9}x{height}", f"{fast:.1f}", f"{high:.1f}", f"{high / fast:.1f}x"
        )
    Console().print(table)


if __name__ == "__main__":
    main()
