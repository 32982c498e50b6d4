import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import DualArm
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator import emulate
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.emulator.rtde_reader import RtdeReader
from sim2real.emulator.world_config import WorldConfig
from sim2real.truth_source import TruthSource
from tests.sim2real.fake_controller import free_address

ARMS = DualArm()
ADDRESSES = (free_address(41), free_address(42))


def wait_until(condition, timeout=10.0):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.02)


def held_at(distance):
    home = ARMS.forward_kinematics(ARMS.home)
    left, right = home.left.copy(), home.right.copy()
    left[:3, 3], right[:3, 3] = (-distance / 2, 0.0, 0.35), (distance / 2, 0.0, 0.35)
    return BoundaryPoses(left, right)


@pytest.fixture(scope="module")
def cell():
    config = WorldConfig(controllers=ADDRESSES, address=free_address(43), port=0, drawing_share=1.0)
    with EmulatedCell(config, start=held_at(0.42)) as cell:
        yield cell


def test_rod_is_held_where_asked(cell):
    truth = cell.truth()
    np.testing.assert_allclose(truth.boundary.left, held_at(0.42).left, atol=1e-6)
    np.testing.assert_allclose(truth.boundary.right, held_at(0.42).right, atol=1e-6)
    assert truth.problem == ""
    assert set(cell.pids) == {"left", "right", "world"}
    assert len(set(cell.pids.values())) == 3


def test_place_hangs_the_rod_anew_whatever_its_past(cell):
    cell.place(held_at(0.35))
    first = cell.truth().centerline
    cell.place(held_at(0.49))
    cell.place(held_at(0.35))
    np.testing.assert_allclose(cell.truth().centerline, first, atol=1e-5)
    cell.place(held_at(0.42))


def test_both_controllers_feel_the_rods_weight(cell):
    time.sleep(0.3)
    for side in ("left", "right"):
        assert "joints" in cell.state(side)
    weight = 1e3 * np.pi * 0.003**2 * 0.5 * 9.81
    truth = cell.truth()
    assert truth.wrenches[:, 2].sum() == pytest.approx(weight, rel=1e-3)


def test_commands_reach_their_part(cell):
    assert emulate.run_command(cell, "camera side latency 0.2") == "side latency 0.2: done"
    assert cell.world.status()["cameras"]["side"]["latency_s"] == 0.2
    emulate.run_command(cell, "camera side latency 0")
    emulate.run_command(cell, " left   protective_stop ")
    try:
        wait_until(lambda: cell.state("left")["safety"] == "protective_stop")
        assert cell.state("right")["safety"] == "normal"
        assert "left: protective_stop" in emulate.run_command(cell, "status")
    finally:
        emulate.run_command(cell, "left clear")
    assert "protective_stop" in emulate.run_command(cell, "help")


def test_board_goes_from_gripper_to_gripper_with_both_arms_home(cell):
    assert cell.truth().board is None
    said = emulate.run_command(cell, "board right")
    assert said == "board right: done, both arms are home"
    truth = cell.truth()
    assert truth.board == "right"
    with pytest.raises(DeviceError, match="board none"):
        TruthSource(f"{cell.world.url}/truth").newest()
    np.testing.assert_allclose(truth.joint_angles, ARMS.home, atol=1e-4)
    assert "board in the right gripper" in emulate.run_command(cell, "status")
    emulate.run_command(cell, "board left")
    assert cell.truth().board == "left"
    emulate.run_command(cell, "board none")
    assert cell.truth().board is None
    assert len(cell.truth().centerline) == 51
    cell.place(held_at(0.42))


@pytest.mark.parametrize(
    "line",
    [
        "dance",
        "board",
        "board up",
        "board left 3",
        "left",
        "left freeze soon",
        "left freeze 1 2",
        "left no_such_fault",
        "camera",
        "camera left freeze 1",
        "camera bottom freeze 1",
        "camera side freeze",
        "camera side explode 1",
    ],
)
def test_wrong_commands_are_explained(cell, line):
    with pytest.raises(ValueError, match=r"\w"):
        emulate.run_command(cell, line)


def test_cell_refuses_taken_addresses_and_stops_all_it_started():
    config = WorldConfig(controllers=(free_address(44), free_address(45)), address=ADDRESSES[0])
    cell = EmulatedCell(config, world=False)
    cell.start()
    pids = cell.pids.values()
    try:
        with pytest.raises(DeviceError, match=free_address(44)):
            EmulatedCell(config, world=False).start()
        assert all(Path(f"/proc/{pid}").exists() for pid in pids)
    finally:
        cell.stop()
    assert not any(_runs(pid) for pid in pids)


def test_cell_file_gives_addresses_and_cameras():
    cell = EmulatedCell.of(CellConfig.load(TEMPLATES / "emulated.toml"), n_occluders=1)
    assert cell.config.controllers == ("127.0.0.2", "127.0.0.3")
    assert cell.config.url == "http://127.0.0.4:8080"
    assert cell.config.n_occluders == 1


def test_lines_are_read_whole_and_edited():
    read_end, write_end = os.pipe()
    with os.fdopen(read_end) as source:
        lines = emulate._Lines(source)
        with lines:
            os.write(write_end, b"left fre")
            assert lines.read(1.0) == []
            assert lines.typed == "left fre"
            os.write(write_end, b"w\x7feze 1\nquit\nhel")
            assert lines.read(1.0) == ["left freeze 1", "quit"]
            os.close(write_end)
            assert lines.read(1.0) == []
            began = time.monotonic()
            assert lines.read(0.2) == []  # the end of input is no busy loop
            assert time.monotonic() - began >= 0.2


def command(*options, **popen):
    code = "import tyro; from sim2real.emulator.emulate import emulate; tyro.cli(emulate)"
    addresses = ("--left", free_address(46), "--right", free_address(47))
    return subprocess.Popen(
        [sys.executable, "-c", code, *addresses, *options],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "120"},
        **popen,
    )


def read_until(process, text):
    seen = ""
    timer = threading.Timer(30.0, process.kill)
    timer.start()
    while text not in seen:
        line = process.stdout.readline()
        assert line, f"ended before {text!r}: {seen}"
        seen += line
    timer.cancel()
    return seen


def test_command_says_what_listens_takes_faults_and_quits():
    with command(stdin=subprocess.PIPE) as process:
        said = read_until(process, "Ctrl-C stops")
        for port in emulate.PORTS:
            assert f"{free_address(46)}:{port}" in said
            assert f"{free_address(47)}:{port}" in said
        reader = RtdeReader(free_address(46))
        try:
            wait_until(lambda: reader.connected)
            np.testing.assert_allclose(reader.history.newest.joint_angles, ARMS.home[0], atol=1e-4)
        finally:
            reader.close()
        process.stdin.write("right protective_stop\nnonsense\nquit\n")
        process.stdin.flush()
        rest = process.stdout.read()
        assert "right protective_stop: done" in rest
        assert "no command 'nonsense'" in rest
        assert process.wait(5.0) == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_command_with_a_world_stops_cleanly(number):
    options = ("--world", "--address", free_address(48), "--port", "0", "--clutter")
    options += ("--board", "left")
    with command(*options, stdin=subprocess.DEVNULL) as process:
        said = read_until(process, "Ctrl-C stops")
        assert f"http://{free_address(48)}" in said
        time.sleep(1.0)
        assert process.poll() is None  # the end of input stops nothing
        process.send_signal(number)
        assert process.wait(10.0) == 0
        rest = process.stdout.read()
        assert "stopped" in rest
        assert "retrying" not in said + rest  # nothing was wrong


def _runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
