"""Runs every benchmark of this folder, one after the other."""

from importlib import import_module
from pathlib import Path

from rich.console import Console

for path in sorted(Path(__file__).parent.glob("bench_*.py")):
    Console().rule(path.stem)
    import_module(f"benchmarks.{path.stem}").main()
