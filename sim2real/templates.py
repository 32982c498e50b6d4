"""Cell files to start from."""

import shutil
from pathlib import Path
from typing import Literal

from rich.console import Console

from sim2real.config import TEMPLATES


def init(
    file: Path = Path("cell.toml"),
    /,
    *,
    template: Literal["ur5e", "emulated", "uncalibrated"] = "ur5e",
) -> None:
    """Write a cell file to start from; every value that a lab must measure is marked EDIT.

    Args:
        file: to write; an existing one is never replaced.
        template: ur5e for two real arms, emulated for those of `dlo robot emulate --world`,
            uncalibrated for the same with larger images and roughly measured poses.
    """
    if file.exists():
        raise FileExistsError(f"{file} exists; name another file")
    shutil.copyfile(TEMPLATES / f"{template}.toml", file)
    Console().print(
        f"written: {file}; next: edit it, then  dlo robot check {file}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
