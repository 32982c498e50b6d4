"""Cell files of emulated cells, each test process on loopback addresses of its own."""

import os
from pathlib import Path

from sim2real.config import TEMPLATES, CellConfig, update_cell_file

NETWORK = f"127.{10 + os.getpid() % 200}.{os.getpid() // 200 % 250}"


def move_addresses(file: Path) -> None:
    """Puts this process's addresses in place of those in a cell file of the emulated cell."""
    file.write_text(file.read_text().replace("127.0.0.", f"{NETWORK}."))


# A machine that runs tests is busy, and emulates two controllers and a world besides.
PATIENCE = {"limits.max_image_age_s": 1.5, "limits.max_pose_age_s": 0.5}


def write_cell(file: Path) -> CellConfig:
    """Writes the emulated cell's file with addresses of this process."""
    file.write_text((TEMPLATES / "emulated.toml").read_text())
    move_addresses(file)
    return update_cell_file(file, PATIENCE)
