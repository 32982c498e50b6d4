"""Real cables: identified from some motion-capture clips, predicted in the others.

Mean distance of the inner markers over whole clips of 5 s, predicted from the clamps' motion and
how the clip began. Says so where the data is absent (see ``deform_mocap``).
"""

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks import deform_mocap
from sim2real.identify import (
    NAMES,
    STARTS,
    UNITS,
    CableMotion,
    CableParameters,
    Identified,
    identify,
    predict,
    predict_at_rest,
    predict_blend,
)

SECONDS = 2.0  # of each clip that is identified from: later, small errors have grown
ELEMENTS, ITERATIONS = 16, 6


def identify_cable(known: list[CableMotion], progress: Progress, name: str) -> Identified:
    """From the beginnings of the known clips."""
    total = len(known) * (len(STARTS) + ITERATIONS * (len(NAMES) + 2))
    task = progress.add_task(f"{name}: identifying", total=total)
    return identify(
        [motion.beginning(SECONDS) for motion in known], None, ELEMENTS, ITERATIONS,
        lambda count, rms: progress.update(
            task, completed=count, description=f"{name}: {1e3 * rms:.0f} mm RMS"
        ),
    )  # fmt: skip


def errors(motions: list[CableMotion], parameters: CableParameters) -> np.ndarray:
    """(n_motions, 3) mean errors [mm]: dynamic, at rest, blended; NaN where a clip was lost."""
    return 1e3 * np.array([
        [
            motion.error(points) if np.isfinite(points).all() else np.nan
            for points in (
                predict(motion, parameters, ELEMENTS),
                predict_at_rest(motion, parameters, ELEMENTS),
                predict_blend(motion),
            )
        ]
        for motion in motions
    ])  # fmt: skip


def main() -> None:
    console = Console()
    if not deform_mocap.FOLDER.is_dir():
        console.print(f"no clips at {deform_mocap.FOLDER}; set DLO_DATA to identify real cables")
        return
    table = Table("cable, clips", "dynamic mm", "at rest mm", "blend mm", "lost")
    for cable in deform_mocap.CABLES:
        known, unseen = deform_mocap.load(cable)
        with Progress(console=console) as progress:
            found = identify_cable(known, progress, cable)
        open_questions = found.undetermined()
        for index, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
            low, high = found.interval(index)
            told = "" if name not in open_questions else ", not told by the motion"
            value = found.parameters[index]
            console.print(f"{cable} {name}: {value:.3g} ({low:.3g} to {high:.3g}) {unit}{told}")
        for kind, motions in (("known", known), ("unseen", unseen)):
            figures = errors(motions, found.parameters)
            means = [f"{mean:.1f}" for mean in np.nanmean(figures, axis=0)]
            lost = int(np.isnan(figures[:, 0]).sum())
            table.add_row(f"{cable}, {len(motions)} {kind}", *means, f"{lost}")
    console.print(table)


if __name__ == "__main__":
    main()
