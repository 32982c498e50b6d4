"""Every command of docs/real_cell.md, run on the emulated cell as a reader would."""

import re
import shlex
from pathlib import Path

import pytest

from dlo_gym import cli
from sim2real.config import update_cell_file
from sim2real.emulator.emulated_cell import EmulatedCell
from tests.sim2real.emulated import PATIENCE, move_addresses, write_cell

GUIDE = Path(__file__).parents[2] / "docs" / "real_cell.md"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def commands() -> list[list[str]]:
    """The guide's ``dlo`` commands, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", GUIDE.read_text(), re.S)
    lines = [line.partition("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("dlo ")]


def test_every_command_of_the_guide_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = write_cell(tmp_path / "own.toml")
    done = []
    with EmulatedCell.of(config, rate=10.0):
        for command in commands():
            if command[:2] == ["robot", "emulate"]:
                continue  # it is what stands around this block
            if command[:3] == ["robot", "init", "lab.toml"]:
                command = [*command, "--template", "emulated"]  # no laboratory is at hand
            assert cli.main(command) == 0, command
            if command[1] == "init":
                move_addresses(tmp_path / command[2])
                update_cell_file(tmp_path / command[2], PATIENCE)
            done.append(command[1])
    assert {"init", "check", "run", "replay"} <= set(done)
