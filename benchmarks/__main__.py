"""Runs the benchmarks of this folder, one after the other."""

from importlib import import_module
from pathlib import Path

from rich.console import Console

BY_THEMSELVES = ("bench_real_cables",)  # ten minutes

for path in sorted(Path(__file__).parent.glob("bench_*.py")):
    if path.stem in BY_THEMSELVES:
        continue
    Console().rule(path.stem)
    import_module(f"benchmarks.{path.stem}").main()
