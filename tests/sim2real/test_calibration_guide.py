"""Every command of docs/calibration.md, run on the emulated cell as a reader would."""

import pytest

from dlo_gym import cli
from dlo_gym.scene.builder import default_cameras
from sim2real.config import CellConfig, update_cell_file
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.emulator.world_config import WorldConfig
from tests.sim2real.calibration_data import apart
from tests.sim2real.emulated import NETWORK, PATIENCE, move_addresses
from tests.sim2real.guide import commands

POSES = {"calibration": 10, "check": 6}  # by folder of samples; the guide takes more
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def option(command, name):
    return command[command.index(name) + 1]


def collect(command):
    """Fewer poses, faster; cut off by a busy machine's watchdog it goes on, as the guide says."""
    poses = str(POSES[option(command, "--samples")])
    command = [*command, "--poses", poses, "--joint-speed", "1.0"]
    assert any(cli.main(command) == 0 for _ in range(10)), command


def off_truth(cell, world):
    """By how much [mm], [deg] a cell file is wrong about each camera and the right base."""
    true = {camera.name: camera.T_world_camera for camera in world.cameras}
    config = CellConfig.load(cell)
    errors = {
        camera.name: apart(camera.T_world_camera, true[camera.name])
        for camera in config.camera_models
    }
    for arm, T_world_base in zip(("left", "right"), world.dual_arm.T_world_base, strict=True):
        errors[arm] = apart(config.arms[arm].T_world_base, T_world_base)
    return errors


def test_every_command_of_the_guide_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    emulation = next(c for c in commands("calibration.md") if c[1] == "emulate")
    world = WorldConfig(
        cameras=default_cameras(int(option(emulation, "--image-height")) / 1080),
        address=f"{NETWORK}.4",
        board=option(emulation, "--board"),
    ).behind(f"{NETWORK}.2", f"{NETWORK}.3")
    cell, done = tmp_path / "cell.toml", []
    with EmulatedCell(world) as emulated:
        for command in commands("calibration.md"):
            if command == emulation:
                continue  # it is what stands around this block
            if "--collect" in command:
                emulated.carry(option(command, "--collect"))
                collect(command)
            else:
                assert cli.main(command) == 0, command
            if command[1] == "init":
                move_addresses(cell)
                update_cell_file(cell, PATIENCE)
                errors = off_truth(cell, world)
                assert min(errors[name][0] for name in ("side", "top", "right")) > 10.0
            done.append(command[1])
    assert {"board", "init", "calibrate", "verify-calibration"} == set(done)
    errors = off_truth(cell, world)
    assert max(mm for mm, _ in errors.values()) <= 1.0, errors
    assert max(deg for _, deg in errors.values()) <= 0.1, errors
    assert errors["left"][0] < 1e-6
