"""Every command of docs/real_cell.md, run on the emulated cell as a reader would."""

import pytest

from dlo_gym import cli
from sim2real.config import update_cell_file
from sim2real.emulator.emulated_cell import EmulatedCell
from tests.sim2real.emulated import PATIENCE, move_addresses, write_cell
from tests.sim2real.guide import commands

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_every_command_of_the_guide_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = write_cell(tmp_path / "own.toml")
    done = []
    with EmulatedCell.of(config, rate=10.0):
        for command in commands("real_cell.md"):
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
