"""``dlo identify``: what a cable is made of, from a recording of how it moved."""

import json
import os
import shutil
from pathlib import Path
from typing import Annotated, Any, Literal

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dlo_gym.exceptions import IdentificationFailed
from dlo_gym.geometry.se3 import Array
from dlo_gym.output_folder import check_output_folder, replace_folder
from dlo_gym.recording import Recording
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.estimate import Identified, fit
from sim2real.identification.prediction import Model, predict
from tracking.evaluate import Track, follow, make_tracker, rod_properties

MADE = ("identified.json", "rod.toml", "fit.png")
N_SHAPES = 6  # drawn


def identify(
    recording: Annotated[Path, tyro.conf.Positional],
    *,
    source: Annotated[Literal["truth", "estimate"], tyro.conf.arg(name="from")] = "estimate",
    out: Path | None = None,
    model: Literal["auto", "rest", "motion"] = "auto",
    youngs_modulus: float | None = None,
    overwrite: bool = False,
) -> None:
    """Identify the cable in a recording: stiffness over weight, rest curvature, length, damping.

    Writes identified.json (values, 95 % intervals, what the motion does not tell, the rod's
    properties), rod.toml (the [rod] section of a cell file) and fit.png. No force is measured, so
    what is found is the ratio of stiffness to weight; for the weight the recording's density is
    taken, 1000 kg/m^3 if it does not say, and its radius.

    Args:
        recording: folder in the format dlo-recording/1.
        source: truth of the recording, or what the tracker makes of its images.
        out: folder to make; out/identify-<name of the recording> if omitted.
        model: "rest" takes the cable to be in equilibrium in every sample, "motion" gives it
            inertia and damping; "auto" tries both and keeps the one that fits better.
        youngs_modulus: that the tracker is to assume [Pa], if the recording does not say; 1e6
            otherwise. Only with --from estimate.
        overwrite: replace the folder if it exists.
    """
    console = Console()
    recorded = Recording.load(recording)
    folder = (out or Path("out") / f"identify-{recorded.name}").resolve()
    check_output_folder(folder, MADE, overwrite=overwrite)
    if source == "truth" and recorded.centerline is None:
        raise ValueError(f"from: {recorded.name} has no truth.npz; take --from estimate")
    if source == "truth" and youngs_modulus is not None:
        raise ValueError(
            f"youngs_modulus: expected none with --from truth, which tracks nothing,"
            f" got {youngs_modulus:g}"
        )
    with Progress(console=console, transient=True) as progress:
        motion = (
            motion_of_truth(recorded) if source == "truth"
            else motion_of_track(recorded, youngs_modulus, progress)
        )  # fmt: skip
        found, fitted = _fitted(motion, model, progress)
    partial = folder.with_name(f".{folder.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        report = {"recording": recorded.name, "from": source, "model": fitted, **as_json(found)}
        text = json.dumps(report, indent=1, allow_nan=False)
        (partial / "identified.json").write_text(text + "\n")
        (partial / "rod.toml").write_text(as_toml(found, recorded))
        draw(partial / "fit.png", motion, found, fitted)
        replace_folder(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    console.print(summary(found, f"{recorded.name}, {source}, {fitted}"))
    console.print(f"written to {folder}", highlight=False, markup=False, soft_wrap=True)


def motion_of_truth(recorded: Recording) -> CableMotion:
    assert recorded.centerline is not None
    return CableMotion.of_recording(recorded, recorded.centerline)


def motion_of_track(
    recorded: Recording, youngs_modulus: float | None, progress: Progress
) -> CableMotion:
    """What the tracker sees of the cable; nodes that no view saw do not count."""
    properties = rod_properties(recorded, youngs_modulus)
    tracker = make_tracker(recorded, properties)
    result = Track()
    task = progress.add_task("tracking", total=len(recorded))
    for _ in follow(tracker, recorded, properties, result):
        progress.advance(task)
    progress.remove_task(task)
    centerline = result.centerline
    centerline[~np.any(result.visible, axis=0)] = np.nan
    return CableMotion.of_recording(recorded, centerline, across=True)


def _fitted(
    motion: CableMotion, model: Literal["auto", "rest", "motion"], progress: Progress
) -> tuple[Identified, Model]:
    """The better of the models asked for; one that cannot follow the motion is left out."""
    models: tuple[Model, ...] = ("rest", "motion") if model == "auto" else (model,)
    fits: list[tuple[Identified, Model]] = []
    for kind in models:
        task = progress.add_task(f"fitting, {kind}", total=None)
        try:
            found = fit(
                [motion], model=kind,
                callback=lambda rms, task=task, kind=kind: progress.update(
                    task, description=f"fitting, {kind}: {1e3 * rms:.2f} mm"
                ),
            )  # fmt: skip
        except IdentificationFailed:
            if not fits and kind == models[-1]:
                raise
        else:
            fits.append((found, kind))
    return min(fits, key=lambda pair: np.nan_to_num(pair[0].rms, nan=np.inf))


def as_json(found: Identified) -> dict[str, Any]:
    """``found`` for identified.json; with what ``RodProperties`` takes."""
    p = found.properties
    return {
        "rms_mm": 1e3 * found.rms if np.isfinite(found.rms) else None,
        "parameters": {
            parameter.name: {
                "value": found.values[parameter.name],
                "unit": parameter.unit,
                "interval_95": found.intervals[parameter.name],
                "posterior_over_prior": found.told[parameter.name],
            }
            for parameter in found.parameters
        },
        "not_identified": found.unidentified,
        "rod_properties": {
            "length": p.length,
            "radius": p.radius,
            "EI": p.EI,
            "GJ": p.GJ,
            "EA": p.EA,
            "kGA": p.kGA,
            "mass_per_length": p.mass_per_length,
            "rest_curvature": list(p.rest_curvature),
            "external_damping": p.external_damping,
            "internal_damping": p.internal_damping,
        },
    }


def as_toml(found: Identified, recorded: Recording) -> str:
    """The ``[rod]`` section of a cell file, and ``youngs_modulus`` for ``dlo track``."""
    p = found.properties
    radius = recorded.rod_radius
    modulus = 4.0 * float(np.mean(p.bending_stiffness)) / (np.pi * radius**4)
    density = float(np.mean(p.linear_density)) / (np.pi * radius**2)
    return (
        "[rod]\n"
        f"length_m = {p.length:.6g}\n"
        f"radius_m = {radius:.6g}\n"
        f"youngs_modulus_pa = {modulus:.6g}  # at the density below\n"
        f"density_kg_m3 = {density:.6g}\n"
    )


def summary(found: Identified, title: str) -> Table:
    """Values and intervals as a table."""
    table = Table(
        "parameter", "value", "95 % interval", "told by the motion",
        title=f"{title}: {1e3 * found.rms:.2f} mm RMS",
    )  # fmt: skip
    for parameter in found.parameters:
        name = parameter.name
        low, high = found.intervals[name]
        table.add_row(
            name,
            f"{found.values[name]:.4g} {parameter.unit}",
            f"{low:.4g} to {high:.4g}",
            "no, the prior stands in" if name in found.unidentified else "yes",
        )
    return table


def draw(file: Path, motion: CableMotion, found: Identified, model: Model) -> None:
    """Shapes seen and fitted, from the side and from above, and the distance over time."""
    points = predict(motion, found.properties, model, derivatives=False).points
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    side, top, error = figure.subplots(1, 3)
    samples = np.unique(np.linspace(0, len(motion) - 1, N_SHAPES).round().astype(int))
    for index, sample in enumerate(samples):
        colour = matplotlib.colormaps["viridis"](0.9 * index / max(len(samples) - 1, 1))
        for axes, height in ((side, 2), (top, 1)):
            axes.plot(*motion.points[sample][:, [0, height]].T, ".", color=colour, markersize=3)
            axes.plot(*points[sample][:, [0, height]].T, "-", color=colour, linewidth=1)
    for axes, label in ((side, "z [m]"), (top, "y [m]")):
        axes.set(xlabel="x [m]", ylabel=label, aspect="equal")
    side.set_title("dots: seen, lines: fitted")
    error.plot(motion.stamps, 1e3 * _distances(motion, points))
    error.set(xlabel="time [s]", ylabel="mean distance [mm]", ylim=(0, None))
    figure.savefig(file, dpi=110)


def _distances(motion: CableMotion, points: Array) -> Array:
    """(T,) mean over the points seen [m]."""
    apart = np.linalg.norm(motion.difference(points), axis=2)
    return apart.sum(axis=1) / np.maximum(motion.seen.sum(axis=1), 1)
