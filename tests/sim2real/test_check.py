"""The checks of a simulated cell: all pass as it is, and each fails for its own reason."""

import socket
import threading

import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError, DloError
from sim2real import check as check_module
from sim2real.cell_checks import (
    check_calibration,
    check_clamps,
    check_dashboard,
    check_frames,
    check_gripper,
)
from sim2real.check import as_table, check, check_cell
from sim2real.config import CellConfig
from tests.sim2real.fake_controller import free_address
from tests.sim2real.simulated_cell import make_cell, opengl_missing, write_cell

needs_opengl = pytest.mark.skipif(bool(opengl_missing()), reason="no OpenGL")


@pytest.fixture
def config(tmp_path):
    return CellConfig.load(write_cell(tmp_path))


def verdicts(rows):
    return {row.check: row.verdict for row in rows}


def failed(rows):
    return [row.check for row in rows if row.verdict == "failed"]


def asleep(cell, monkeypatch):
    """Makes motion impossible, and notes how the arms were connected."""
    asked = []

    def noted(connect):
        def connected(*, control):
            asked.append(control)
            connect(control=control)

        return connected

    for arm in cell.arms.values():
        monkeypatch.setattr(arm, "connect", noted(arm.connect))
        for name in ("servo_to", "move_to"):
            monkeypatch.setattr(arm, name, lambda *_: pytest.fail("the check moves an arm"))
    return asked


@needs_opengl
def test_a_good_cell_passes_and_nothing_moves(config, monkeypatch):
    cell = make_cell(config, moves=False)
    asked = asleep(cell, monkeypatch)
    rows = check_cell(config, 1.0, cell)
    assert failed(rows) == []
    assert asked == [False, False]
    found = verdicts(rows)
    for name in ("left arm: TCP", "right clamp: workspace", "gripper distance", "goal reach"):
        assert found[name] == "ok"
    for name in ("camera side: cable", "camera top: cable", "cable's shape", "synchronised images"):
        assert found[name] == "ok"
    assert found["calibration"] == "warning"
    with pytest.raises(DeviceError):  # everything was given back
        cell.readings()


@needs_opengl
def test_a_camera_that_stands_elsewhere_does_not_see_the_cable(tmp_path):
    seen = CellConfig.load(write_cell(tmp_path))
    cell = make_cell(seen, moves=False)
    told = CellConfig.load(write_cell(tmp_path, cameras__top__position_m=[0.02, -0.35, 1.25]))
    cell.config = told
    for name, camera in cell.cameras.items():
        camera.model = told.cameras[name].model(name)
    rows = check_cell(told, 1.0, cell)
    assert "camera top: cable" in failed(rows)


@needs_opengl
def test_missing_arm_and_camera_are_named_and_the_rest_is_checked(config, monkeypatch):
    cell = make_cell(config, moves=False)

    def refuse(**_):
        raise DeviceError("nothing there")

    monkeypatch.setattr(cell.arms["left"], "connect", refuse)
    monkeypatch.setattr(cell.cameras["top"], "open", refuse)
    rows = check_cell(config, 0.5, cell)
    assert failed(rows) == ["left arm: link", "camera top: opens"]
    found = verdicts(rows)
    assert found["right arm: joint angles"] == "ok"
    assert found["camera side: size"] == "ok"
    assert "goal reach" not in found
    assert all(row.advice for row in rows if row.verdict != "ok")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"limits__workspace_m": [[-0.1, -0.2, 0.2], [0.1, 0.2, 0.5]]}, "left clamp: workspace"),
        (
            {"limits__planes": [{"point_m": [0, 0, 0.5], "normal": [0, 0, 1.0]}]},
            "right clamp: workspace",
        ),
        ({"rod__length_m": 0.39}, "gripper distance"),
        ({"limits__min_arm_clearance_m": 0.4}, "arm clearance"),
    ],
)
def test_poses_outside_the_limits(tmp_path, changes, name):
    config = CellConfig.load(write_cell(tmp_path, **changes))
    assert name in failed(check_clamps(config, config.dual_arm.home))


def test_readings_of_an_arm(config):
    cell = make_cell(config)
    arm = cell.arms["left"]
    arm.connect(control=False)
    arm.set_wrench([0.0, 0.0, -60.0, 0.0, 0.0, 0.0])
    readings = [arm.reading()]
    while len(readings) < 3:
        readings = arm.readings(0.0)
    found = verdicts(check_module.check_readings(config, "left", readings, 0.1))
    assert found["left arm: wrench"] == "failed"
    assert found["left arm: TCP"] == "ok"
    # Another tool on the controller is no reason to stop: a run sets the file's.
    readings[-1].T_base_tcp[:3, 3] += [0.0, 0.0, 0.05]
    found = verdicts(check_module.check_readings(config, "left", readings, 0.1))
    assert found["left arm: TCP"] == "warning"
    readings[-1].joint_angles[3] = 6.2
    found = verdicts(check_module.check_readings(config, "left", readings, 0.1))
    assert found["left arm: joint angles"] == "failed"
    assert failed(check_module.check_readings(config, "left", [], 0.1)) == ["left arm: readings"]


@pytest.fixture
def dashboard():
    """Serves answers of a dashboard; yields its address and the answers, to be changed."""
    address = free_address(77)
    answers = {
        "get robot model": "UR5",
        "is in remote control": "true",
        "robotmode": "Robotmode: RUNNING",
        "safetystatus": "Safetystatus: NORMAL",
        "PolyscopeVersion": "URSoftware 5.12.4.1101661 (Apr 25 2022)",
    }
    listener = socket.create_server((address, 29999))

    def serve():
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            with client, client.makefile("rw", newline="\n") as stream:
                stream.write("Connected: Universal Robots Dashboard Server\n")
                stream.flush()
                for line in stream:
                    stream.write(answers.get(line.strip(), "could not understand") + "\n")
                    stream.flush()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield address, answers
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()


def test_dashboard(dashboard):
    address, answers = dashboard
    assert set(verdicts(check_dashboard("left", address)).values()) == {"ok"}
    answers.update(
        {
            "is in remote control": "false",
            "robotmode": "Robotmode: POWER_OFF",
            "safetystatus": "Safetystatus: PROTECTIVE_STOP",
            "get robot model": "UR10",
        }
    )
    assert failed(check_dashboard("left", address)) == [
        "left arm: model",
        "left arm: remote control",
        "left arm: power",
        "left arm: safety",
    ]
    rows = list(check_dashboard("left", free_address(78)))
    assert failed(rows) == ["left arm: dashboard"]
    assert "switch the controller on" in rows[0].advice


def test_gripper_that_does_not_answer(tmp_path):
    config = CellConfig.load(
        write_cell(tmp_path, arms__left__gripper="robotiq", arms__left__address=free_address(79))
    )
    assert failed(check_gripper(config, "left")) == ["left gripper"]
    assert list(check_gripper(config, "right")) == []


def test_images_of_the_wrong_size_slow_and_old(config):
    class Image:
        def __init__(self, stamp):
            self.image, self.stamp = np.zeros((90, 160, 3), np.uint8), stamp
            self.arrival = stamp + 100.0

    found = verdicts(check_frames(config, "side", [Image(0.0), Image(2.0)]))
    assert found == {
        "camera side: size": "failed",
        "camera side: rate": "warning",
        "camera side: delay": "failed",
    }
    assert failed(check_frames(config, "side", [])) == ["camera side: images"]


def test_calibration_that_no_longer_holds(config):
    from sim2real.calibration.cell_file import numbers_digest
    from sim2real.config import CalibrationSection

    def calibrated(digest):
        section = CalibrationSection(
            date="2026-01-01", hash=f"{digest}:0", residual_px=0.2, residual_mm=0.5,
            residual_deg=0.1, verdict="good",
        )  # fmt: skip
        return config.model_copy(update={"calibration": section})

    assert failed(check_calibration(calibrated(numbers_digest(config)))) == []
    assert failed(check_calibration(calibrated("0"))) == ["calibration"]


def test_command_on_a_wrong_file(tmp_path, capsys):
    path = write_cell(tmp_path, rod__length_m=-1.0)
    with pytest.raises(DloError, match="1 of 1 checks failed: cell file"):
        check(path)
    assert "rod.length_m" in capsys.readouterr().out


def test_command_fails_with_the_rows_that_failed(tmp_path, monkeypatch, capsys):
    row = check_module.Row("left arm: link", "failed", "[no] answer", "switch it on")
    monkeypatch.setattr(check_module, "check_cell", lambda *_: [row])
    with pytest.raises(DloError, match="1 of 2 checks failed: left arm: link"):
        check(write_cell(tmp_path))
    assert "[no] answer" in capsys.readouterr().out
    monkeypatch.setattr(check_module, "check_cell", lambda *_: [row._replace(verdict="warning")])
    check(write_cell(tmp_path))
    assert as_table([row]).row_count == 1


def test_wrong_seconds(tmp_path):
    with pytest.raises(ValueError, match="seconds"):
        check(write_cell(tmp_path), seconds=0.0)
