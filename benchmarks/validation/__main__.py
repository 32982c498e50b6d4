"""Measures every case, or those named, and writes them into docs/validation.md."""

import sys
from collections.abc import Callable

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.validation import buckling, contact, dynamics, engines, page, statics
from benchmarks.validation.case import Case

CASES: dict[str, Callable[[], Case]] = {
    "cantilever": statics.cantilever_case,
    "convergence": statics.convergence_case,
    "catenary": statics.catenary_case,
    "stretch-and-torsion": statics.stretch_and_torsion_case,
    "euler": buckling.euler_case,
    "ring": buckling.ring_case,
    "helix": buckling.helix_case,
    "incline": contact.incline_case,
    "capstan": contact.capstan_case,
    "engines": engines.engines_case,
    "waves": dynamics.waves_case,
    "time-steps": dynamics.time_steps_case,
    "moving-clamps": dynamics.moving_clamps_case,
}


def main() -> None:
    chosen = sys.argv[1:] or list(CASES)
    unknown = set(chosen) - set(CASES)
    if unknown:
        sys.exit(f"cases: expected some of {', '.join(CASES)}, got {', '.join(sorted(unknown))}")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeElapsedColumn()) as progress:
        task = progress.add_task("", total=len(chosen))
        for name in chosen:
            progress.update(task, description=name)
            page.write(name, CASES[name]())
            progress.advance(task)


if __name__ == "__main__":
    main()
