"""Real cables: identified from some motion-capture clips, predicted in the others.

``python -m benchmarks.bench_real_cables [cable ...]``. Mean distance of the inner markers over
whole clips of 5 s, predicted from the clamps' motion and how the clip began. Says so where the data
is absent (see ``deform_mocap``).
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks import deform_mocap
from dlo_gym.geometry.se3 import Array
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.estimate import Identified, fit
from sim2real.identification.parameters import grips_of, values_of
from sim2real.identification.prediction import predict
from sim2real.identify import summary

WINDOW = 1.0  # a clip to identify from starts anew from what was seen after so long [s]
PICTURES = Path("out/real_cables")  # the first unseen clip of every cable
METHODS = ("in motion", "at rest", "blend")


def blend(motion: CableMotion) -> Array:
    """The first sample carried along rigidly by both clamps, blended from one to the other."""
    share = (motion.places**2 * (3.0 - 2.0 * motion.places))[:, None]
    carried = []
    assert motion.right is not None
    for clamp in (motion.left, motion.right):
        change = clamp @ np.linalg.inv(clamp[0])
        turned = motion.points[0] @ np.swapaxes(change[:, :3, :3], 1, 2)
        carried.append(turned + change[:, None, :3, 3])
    return (1.0 - share) * carried[0] + share * carried[1]


def predictions(motion: CableMotion, found: Identified) -> list[Array]:
    """By ``METHODS`` the points (T, n_points, 3) [m]."""
    grips = grips_of(values_of(found.parameters, found.z), motion, "motion")
    held = motion.held([grip.rotation for grip in grips])
    return [
        predict(held, found.properties, "motion", derivatives=False).points,
        predict(held, found.properties, "rest").points,
        blend(motion),
    ]


def draw(motion: CableMotion, points: list[Array], cable: str) -> None:
    """Mean distance over time, and three samples of an unseen clip from the side."""
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    over_time, *shapes = figure.subplots(1, 4)
    for method, predicted in zip(METHODS, points, strict=True):
        apart = 1e3 * np.nanmean(np.linalg.norm(predicted - motion.points, axis=2), axis=1)
        over_time.plot(motion.stamps - motion.stamps[0], apart, label=method)
    over_time.set(xlabel="time [s]", ylabel="mean distance [mm]", title=f"{cable}, unseen")
    over_time.legend(fontsize="small")
    for axes, sample in zip(
        shapes, np.linspace(0, len(motion) - 1, 4).astype(int)[1:], strict=True
    ):
        axes.plot(*motion.points[sample][:, [0, 2]].T, "ko", markersize=3, label="markers")
        for method, predicted in zip(METHODS, points, strict=True):
            axes.plot(*predicted[sample][:, [0, 2]].T, label=method)
        time = motion.stamps[sample] - motion.stamps[0]
        axes.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", title=f"{time:.1f} s")
    PICTURES.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURES / f"{cable}.png", dpi=90)


def measure(cable: str, table: Table, console: Console) -> None:
    """Identify and predict one cable."""
    known, unseen = deform_mocap.load(cable)
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(cable, total=None)
        found = fit(
            [window for motion in known for window in motion.windows(WINDOW)],
            callback=lambda rms: progress.update(
                task, description=f"{cable}: {1e3 * rms:.1f} mm RMS"
            ),
        )
        console.print(summary(found, cable))
        for kind, motions in (("known", known), ("unseen", unseen)):
            errors = []
            for index, motion in enumerate(motions):
                progress.update(task, description=f"{cable}: {kind} clip {index}")
                points = predictions(motion, found)
                errors.append([1e3 * motion.mean_distance(p) for p in points])
                if kind == "unseen" and index == 0:
                    draw(motion, points, cable)
            console.print(f"{cable}, {kind}, mm per clip:\n{np.round(errors, 1)}")
            followed = np.array(errors)[np.isfinite(errors).all(axis=1)]
            lost = len(errors) - len(followed)
            means = [f"{mean:.1f}" for mean in followed.mean(axis=0)]
            medians = [f"{median:.1f}" for median in np.median(followed, axis=0)]
            both = [f"{a} ({b})" for a, b in zip(means, medians, strict=True)]
            table.add_row(f"{cable}, {len(motions)} {kind}", *both, f"{lost}")


def main(cables: tuple[str, ...] = deform_mocap.CABLES) -> None:
    console = Console()
    if not deform_mocap.FOLDER.is_dir():
        console.print(f"no clips at {deform_mocap.FOLDER}; set DLO_DATA to identify real cables")
        return
    table = Table("cable, clips", *(f"{method} mm" for method in METHODS), "lost",
                  title="mean distance over 5 s (median), of the clips not lost")  # fmt: skip
    for cable in cables:
        measure(cable, table, console)
    console.print(table)


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or deform_mocap.CABLES)
