"""``dlo robot replay``: the computations of a recorded run again, offline."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dlo_gym.exceptions import DloError, RecordingError
from dlo_gym.geometry.se3 import Array
from dlo_gym.metrics import ptp_3d
from dlo_gym.recording import Recording
from dlo_gym.rod.boundary import BoundaryPoses
from sim2real.config import CellConfig
from sim2real.loop import ClosedLoop, LoopInput

COMPARED = ("estimate", "ahead", "requested", "target_left", "target_right")


class Replay(NamedTuple):
    """The outputs of a run, computed again.

    Attributes:
        outputs: of each sample, by the names in ``COMPARED``.
        recorded: what the run itself had come to.
    """

    outputs: dict[str, NDArray[Any]]
    recorded: dict[str, NDArray[Any]]

    def first_difference(self, name: str) -> int | None:
        """The first sample whose bits differ; None if none does."""
        differs = self.outputs[name] != self.recorded[name]
        samples = np.flatnonzero(differs.reshape(len(differs), -1).any(axis=1))
        return int(samples[0]) if len(samples) else None

    @property
    def identical(self) -> bool:
        return all(self.first_difference(name) is None for name in COMPARED)


def replay(recording: Path, /) -> None:
    """Run tracker, controller and safety gate again on a recorded run and compare to the last bit.

    A difference means that the code, its settings or the machine's arithmetic have changed since:
    a run that went wrong on the robot can be looked at step by step without it.

    Args:
        recording: the folder that `dlo robot run` recorded, with png images.
    """
    source = Recording.load(recording)
    console = Console()
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("replaying", total=len(source))
        result = rerun(source, advance=lambda: progress.advance(task))
    console.print(_table(source, result))
    if not result.identical:
        raise DloError(f"{recording}: the replay differs from the run")


def rerun(source: Recording, *, advance: Any = lambda: None) -> Replay:
    """Computes a run again from what was recorded of its inputs.

    Args:
        source: a recording of ``dlo robot run``.
        advance: called after each sample.

    Raises:
        RecordingError: if the recording is not one of a controlled run.
    """
    if not {"cell", "goal", "speed"} <= set(source.run):
        raise RecordingError(
            f"{source.name}: expected a recording of `dlo robot run`, got one without a run;"
            " `dlo track` tracks any recording"
        )
    config = CellConfig.model_validate(source.run["cell"])
    goal = np.array(source.run["goal"], dtype=np.float64)
    loop = ClosedLoop(config, goal, source.run["speed"])
    dry_run = _signal(source, "dry_run")
    begins = _signal(source, "begins")
    outputs: dict[str, list[Array]] = {name: [] for name in COMPARED}
    for sample in range(len(source)):
        given = _given(source, sample)
        if begins[sample]:
            loop.resume(given.commanded)
        output = loop.step(given)
        if dry_run[sample]:
            loop.gate.reset()
        target = output.decision.target
        assert target.right is not None
        values = (
            output.estimate.centerline,
            output.ahead,
            output.requested.vector,
            target.left,
            target.right,
        )
        for name, value in zip(COMPARED, values, strict=True):
            outputs[name].append(value)
        advance()
    return Replay(
        {name: np.stack(values) for name, values in outputs.items()},
        {name: _signal(source, name) for name in COMPARED},
    )


def _given(source: Recording, sample: int) -> LoopInput:
    assert source.clamp_right is not None
    return LoopInput(
        views=source.views(sample),
        stamp=float(source.stamps[sample]),
        boundary=BoundaryPoses(source.clamp_left[sample], source.clamp_right[sample]),
        commanded=BoundaryPoses(
            _signal(source, "commanded_left")[sample], _signal(source, "commanded_right")[sample]
        ),
        joint_angles=_signal(source, "joint_angles")[sample],
    )


def _signal(source: Recording, name: str) -> NDArray[Any]:
    try:
        return source.extra[name]
    except KeyError:
        raise RecordingError(
            f"{source.name}: expected the signal {name!r}, it is missing"
        ) from None


def _table(source: Recording, result: Replay) -> Table:
    table = Table("computed again", "result", title=f"{source.name}: {len(source)} samples")
    for name in COMPARED:
        first = result.first_difference(name)
        largest = float(np.abs(result.outputs[name] - result.recorded[name]).max())
        table.add_row(
            name.replace("_", " "),
            "identical"
            if first is None
            else f"differs from sample {first}, by up to {largest:.2g}",
        )
    if source.centerline is not None:
        error = 1e3 * ptp_3d(result.outputs["estimate"], source.centerline).mean()
        table.add_row("tracking PTP3D against the truth", f"{error:.2f} mm")
    return table
