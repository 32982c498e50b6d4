"""Reads a file of the rerun viewer."""

from collections import defaultdict
from pathlib import Path
from typing import Any


def read_rrd(path: Path) -> dict[str, dict[str, list[Any]]]:
    """By entity, by component (``"LineStrips3D:strips"``) all values, and ``"run"`` their times
    [s]."""
    from rerun.chunk import RrdReader

    entities: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name == "run":
                entities[chunk.entity_path][name] += [
                    1e-9 * stamp for stamp in column.cast("int64").to_pylist()
                ]
            elif ":" in name:
                entities[chunk.entity_path][name] += column.to_pylist()
    return entities
