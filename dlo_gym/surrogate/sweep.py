"""How well networks know rods of other stiffness: Fig. 6 of the paper (Section VI-A2).

The folder of a sweep:

    sweep.json        settings and the sha256 of the networks' files
    part_0000.npy     errors of one rod's 25 rollouts, as they are finished
    scores.json       mean, quartiles and 95th percentile per rod, number of steps and network
    scores.md         the means as a table
    scores.png        the distributions
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DatasetError
from dlo_gym.executor import run_tasks
from dlo_gym.metrics import ptp_3d
from dlo_gym.output_folder import check_output_folder, check_resume
from dlo_gym.surrogate.evaluation import recorded_moves
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.simulation import RolloutSettings, simulate_rollout
from dlo_gym.surrogate.weights_file import SHIPPED, SHIPPED_ONE_ROD, load_weights

MADE = ("sweep.json*", "part_*.npy*", "scores.json*", "scores.md*", "scores.png*")

Errors = NDArray[np.float32]


@dataclass(frozen=True)
class SweepSettings:
    """Which rods and moves.

    Attributes:
        youngs_moduli: [Pa].
        radii: [m].
        n_steps: of 5 mm and pi / 80 rad at most per component, as rollouts have them.
        n_rollouts: per rod; lengths and everything else as in the paper's training data.
        seed: of the rollouts.
        stride: moves start at every ``stride``-th state.
        chunk: rollouts per part.

    Raises:
        ValueError: naming the field.
    """

    youngs_moduli: tuple[float, ...] = (1e5, 5e5, 1e6, 5e6, 1e7)
    radii: tuple[float, ...] = (0.003, 0.004, 0.005, 0.006)
    n_steps: tuple[int, ...] = (1, 2, 3, 4)
    n_rollouts: int = 500
    seed: int = 3000
    stride: int = 10
    chunk: int = 25

    def __post_init__(self) -> None:
        for name in ("youngs_moduli", "radii", "n_steps"):
            if not getattr(self, name):
                raise ValueError(f"{name}: expected at least one value, got none")
        for name in ("n_rollouts", "stride", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not 0 <= min(self.n_steps) <= max(self.n_steps) < self.rollouts(1e6, 0.003).n_states:
            raise ValueError(f"n_steps: expected 0 to 50 each, got {self.n_steps}")
        for modulus, radius in self.rods:
            self.rollouts(modulus, radius)

    @property
    def rods(self) -> list[tuple[float, float]]:
        """Young's modulus [Pa] and radius [m] of each."""
        return list(product(self.youngs_moduli, self.radii))

    @property
    def parts(self) -> list["Part"]:
        """The first rollouts of every rod, then the next."""
        starts = range(0, self.n_rollouts, self.chunk)
        return [
            Part(*rod, first, min(first + self.chunk, self.n_rollouts))
            for first in starts
            for rod in self.rods
        ]

    def rollouts(self, youngs_modulus: float, radius: float) -> RolloutSettings:
        return replace(
            RolloutSettings(n_rollouts=self.n_rollouts, seed=self.seed),
            youngs_modulus_min=youngs_modulus, youngs_modulus_max=youngs_modulus,
            radius_min=radius, radius_max=radius,
        )  # fmt: skip


class Part(NamedTuple):
    """Rollouts ``first`` to ``last``, exclusive, of one rod."""

    youngs_modulus: float
    radius: float
    first: int
    last: int


def part_errors(settings: SweepSettings, part: Part, files: tuple[Path, ...]) -> Errors:
    """PTP3D of every move (n_networks, n_steps, n_rollouts, n_moves) [mm]; NaN fills up."""
    networks = [load_weights(file) for file in files]
    rollouts = settings.rollouts(part.youngs_modulus, part.radius)
    n_moves = -(-rollouts.n_states // settings.stride)
    shape = (len(networks), len(settings.n_steps), part.last - part.first, n_moves)
    errors = np.full(shape, np.nan, np.float32)
    for row, index in enumerate(range(part.first, part.last)):
        made = simulate_rollout(rollouts, index)
        predictors = [ShapePredictor(network, made.properties(0)) for network in networks]
        for j, steps in enumerate(settings.n_steps):
            for k, move in enumerate(recorded_moves(made, 0, steps, settings.stride)):
                for i, predictor in enumerate(predictors):
                    predicted = predictor.predict(move.before, move.displacement)
                    errors[i, j, row, k] = 1e3 * ptp_3d(predicted, move.after).mean()
    return errors


def evaluate_surrogate(
    out: tyro.conf.Positional[Path],
    /,
    settings: tyro.conf.OmitArgPrefixes[SweepSettings] = SweepSettings(),
    *,
    weights: tuple[Path, ...] = (SHIPPED_ONE_ROD, SHIPPED),
    workers: int = 0,
    ray_address: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Score shape predictors on rods of other stiffness: Fig. 6 of the paper.

    Args:
        out: folder to write: scores.json, scores.md, scores.png.
        settings: which rods and moves.
        weights: files to compare; those that ship by default, the one trained on the reference
            rod alone and the one that is told of the rod.
        workers: processes; 0 for one per core.
        ray_address: evaluate on the Ray cluster there, host:port, instead of on this machine's
            cores; "local" starts one here. Needs  pip install 'dlo-gym[scale]'.
        resume: finish a sweep that was interrupted.
        overwrite: throw away the sweep in OUT.

    Raises:
        FileExistsError: if OUT holds something and neither resume nor overwrite was given.
        DatasetError: if a file cannot be written; what was finished is kept for --resume.
        WeightsError: if a file of weights is missing, damaged or of another version.
        ValueError: if OUT holds a sweep of other settings or networks, or on conflicting options.
    """
    console = Console(stderr=True)
    names = [file.stem for file in weights]
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"weights: expected files of different names, got {names}")
    for file in weights:
        load_weights(file)
    description = {
        "settings": asdict(settings),
        "weights": {f.stem: hashlib.sha256(f.read_bytes()).hexdigest() for f in weights},
    }
    _open_sweep(out, description, resume=resume, overwrite=overwrite)
    parts = settings.parts
    left = [i for i in range(len(parts)) if not _part_file(out, i).exists()]
    columns = (TextColumn("rods"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=len(parts), completed=len(parts) - len(left))
        tasks = [(settings, parts[i], weights) for i in left]
        for i, errors in run_tasks(part_errors, tasks, workers=workers, ray_address=ray_address):
            with (
                written_aside(_part_file(out, left[i]), DatasetError) as part,
                part.open("wb") as file,
            ):
                np.save(file, errors)
            progress.advance(task)
    cells = list(_cells(out, settings, names))
    _write_text(out / "scores.json", json.dumps({**description, "scores": cells}, indent=1) + "\n")
    _write_text(out / "scores.md", score_markdown(cells, names))
    from dlo_gym.surrogate.sweep_plot import plot_scores

    with written_aside(out / "scores.png", DatasetError) as part:
        plot_scores(cells, names, part)
    console.print(f"scores in {out}", highlight=False, markup=False)


def score_markdown(cells: list[dict[str, Any]], names: list[str]) -> str:
    """Mean PTP3D [mm] as a table: a row per rod, per number of steps the networks side by side."""
    steps = sorted({cell["n_steps"] for cell in cells})
    rods = list(dict.fromkeys((cell["youngs_modulus"], cell["radius"]) for cell in cells))
    means = {
        (c["youngs_modulus"], c["radius"], c["n_steps"], c["network"]): c["mean_mm"] for c in cells
    }
    head = " | ".join(f"{n} step{'s' if n > 1 else ''}" for n in steps)
    lines = [f"Mean PTP3D in mm: {' / '.join(names)}", "", f"| E [Pa] | radius [mm] | {head} |"]
    lines.append("|---" * (2 + len(steps)) + "|")
    for modulus, radius in rods:
        values = [
            " / ".join(f"{means[modulus, radius, n, name]:.2f}" for name in names) for n in steps
        ]
        lines.append(f"| {modulus:.0e} | {1e3 * radius:g} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _open_sweep(out: Path, description: dict[str, Any], *, resume: bool, overwrite: bool) -> None:
    """Leaves a folder whose parts, if any, belong to ``description``."""
    check_resume(resume=resume, overwrite=overwrite)
    file = out / "sweep.json"
    if resume and file.exists():
        try:
            found = json.loads(file.read_text())
        except ValueError as error:
            raise DatasetError(f"{file}: damaged: {error}") from error
        if found != json.loads(json.dumps(description)):
            raise ValueError(
                f"{out} holds a sweep of other settings or weights: {found}; resume with the same"
            )
        return
    check_output_folder(out, MADE, overwrite=overwrite)
    out.mkdir(parents=True, exist_ok=True)
    for pattern in MADE:
        for former in out.glob(pattern):
            former.unlink()
    _write_text(file, json.dumps(description, indent=1) + "\n")


def _cells(out: Path, settings: SweepSettings, names: list[str]) -> Iterator[dict[str, Any]]:
    """Scores of every rod, network and number of steps."""
    n_parts, n_rods = len(settings.parts), len(settings.rods)
    for i, (modulus, radius) in enumerate(settings.rods):
        files = [_part_file(out, k) for k in range(i, n_parts, n_rods)]
        errors = np.concatenate([_read_part(file) for file in files], axis=2)
        for j, steps in enumerate(settings.n_steps):
            for name, values in zip(names, errors[:, j], strict=True):
                moves = values[np.isfinite(values)]
                yield {
                    "youngs_modulus": modulus,
                    "radius": radius,
                    "n_steps": steps,
                    "network": name,
                    "n_moves": len(moves),
                    "mean_mm": float(moves.mean(dtype=float)),
                    "percentiles_mm": [float(p) for p in np.percentile(moves, (5, 25, 50, 75, 95))],
                }


def _read_part(file: Path) -> Errors:
    try:
        return np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(
            f"{file}: damaged: {error}; remove it and go on with --resume"
        ) from error


def _part_file(out: Path, index: int) -> Path:
    return out / f"part_{index:04d}.npy"


def _write_text(file: Path, text: str) -> None:
    with written_aside(file, DatasetError) as part:
        part.write_text(text)
