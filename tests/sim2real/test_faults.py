"""Faults of a cell while both arms move: both halt, the message says why, nothing jumps after."""

import contextlib
import os
import signal
import time

import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError, SafetyStop
from dlo_gym.rod.boundary import BoundaryDisplacement
from sim2real.cell import RobotCell
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.steps import BLEND
from sim2real.ur5e.dashboard import unlock_protective_stop
from tests.sim2real.emulated import write_cell

pytestmark = pytest.mark.timeout(200)
PERIOD = 0.1
HALT_WITHIN = 3.0  # [s]

FAULTS = [
    # fault, seconds, which part, what the message must say
    ("drop_link", None, "left", "left arm"),
    pytest.param("freeze", 1.5, "right", "right arm", marks=pytest.mark.slow),
    ("protective_stop", None, "left", "protective stop"),
    pytest.param("freeze", 0.7, "left", "left arm", marks=pytest.mark.slow),
    pytest.param("freeze", 4.0, "left", "left arm", marks=pytest.mark.slow),
    pytest.param("emergency_stop", None, "right", "emergency stop", marks=pytest.mark.slow),
    pytest.param("crash", None, "right", "right arm", marks=pytest.mark.slow),
    pytest.param("freeze", 3.0, "side", "side", marks=pytest.mark.slow),
    pytest.param("kill client", None, "left", "SIGKILL", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_cell(tmp_path_factory.mktemp("cell") / "cell.toml")


@pytest.mark.parametrize(("fault", "seconds", "part", "said"), FAULTS)
def test_both_arms_halt_and_nothing_jumps(config, fault, seconds, part, said):
    with EmulatedCell.of(config, rate=8.0) as emulation, RobotCell(config) as cell:
        cell.open()
        cell.engage()
        cell.refresh()
        _move(cell, until=time.monotonic() + 0.6)
        assert _speed(emulation, "left", "right") > 0.005  # it really moves
        if fault == "kill client":
            os.kill(cell.arms[part].client_pid, signal.SIGKILL)  # type: ignore[attr-defined]
        else:
            with contextlib.suppress(DeviceError):  # a controller that crashes answers no more
                emulation.fault(part, fault, seconds)
        struck = time.monotonic()
        with pytest.raises((DeviceError, SafetyStop)) as stop:
            _move(cell, until=struck + HALT_WITHIN)
        cell.halt()
        alive = ["left"] if fault == "crash" else ["left", "right"]
        while _speed(emulation, *alive) > 1e-4:
            assert time.monotonic() < struck + HALT_WITHIN
        assert said in str(stop.value)
        if fault in ("crash", "emergency_stop"):
            return  # a person must see to it
        if fault == "protective_stop":
            with pytest.raises(SafetyStop, match="protective stop"):
                cell.recover()  # only a person may release it
            unlock_protective_stop(config.arms[part].address, 8.0)
        _check_restart(cell, emulation, part, seconds)


def _check_restart(cell, emulation, part, seconds):
    """After the fault is gone, the arms stay where they are until a new command comes."""
    time.sleep((seconds or 0.0) + 0.2)
    if part in ("left", "right"):
        emulation.fault(part, "clear")
    stood = {side: emulation.state(side)["joints"] for side in ("left", "right")}
    cell.recover()
    time.sleep(0.3)
    for side, joints in stood.items():
        assert emulation.state(side)["joints"] == pytest.approx(joints, abs=1e-3)
    cell.refresh()
    _move(cell, until=time.monotonic() + 0.5)  # and then it goes on


def _move(cell, until):
    """Both clamps to and fro, as a control loop would."""
    tick, step = time.monotonic(), 0
    while time.monotonic() < until:
        direction = 1.0 if step // 8 % 2 == 0 else -1.0
        twist = np.array([0.0, 0.0, 0.004 * direction, 0.0, 0.0, 0.0])
        cell.send(cell.commanded.displaced(BoundaryDisplacement(twist, twist)), BLEND * PERIOD)
        cell.sample()
        tick, step = max(tick + PERIOD, time.monotonic()), step + 1
        cell.wait_until(tick)


def _speed(emulation, *sides):
    """The largest joint speed [rad/s], by the controllers themselves."""
    before = np.array([emulation.state(side)["joints"] for side in sides])
    start = time.monotonic()
    time.sleep(0.1)
    after = np.array([emulation.state(side)["joints"] for side in sides])
    return float(np.abs(after - before).max() / (time.monotonic() - start))
