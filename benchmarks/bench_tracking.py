"""The tracker on the independent recording exp1: accuracy and time of every variant.

Looks for it in ``$DLO_DATA/recordings/exp1``, by default under ``../shared/data`` beside the
project, and says so if it is not there.
"""

import os
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from dlo_gym.recording import Recording
from tracking.evaluate import Track, evaluate, follow, make_tracker, occlude, rod_properties
from tracking.tracker import TrackerConfig

LAYOUTS = range(5)


def main() -> None:
    console = Console()
    data = Path(os.environ.get("DLO_DATA", Path(__file__).parents[2] / "shared" / "data"))
    folder = data / "recordings" / "exp1"
    if not folder.is_dir():
        console.print(f"no recording at {folder}; set DLO_DATA to measure tracking")
        return
    source = Recording.load(folder)
    properties = rod_properties(source)
    table = Table(
        "triangulation, predictor", "clear mm", "40 % hidden mm", "update ms", "p99 ms",
        title="PTP3D on exp1, two 1920x1080 views; hidden: mean over 5 layouts, whole recording",
    )  # fmt: skip
    for triangulation, predictor in (("curve", "rod"), ("curve", "network"), ("paper", "network")):
        metrics = []
        for seed in (None, *LAYOUTS):
            occlusion = None if seed is None else occlude(source, seed, span=(0.0, 1.0))
            config = TrackerConfig(triangulation=triangulation)
            tracker = make_tracker(source, properties, predictor, config)
            result = Track()
            for _ in follow(tracker, source, properties, result, occlusion):
                pass
            metrics.append(evaluate(source, result))
        clear, *hidden = metrics
        table.add_row(
            f"{triangulation}, {predictor}",
            f"{clear['ptp_3d_mm']:.2f}",
            f"{np.mean([layout['ptp_3d_mm'] for layout in hidden]):.2f}",
            f"{clear['update_ms']['median']:.1f}",
            f"{clear['update_ms']['p99']:.1f}",
        )
    console.print(table)


if __name__ == "__main__":
    main()
