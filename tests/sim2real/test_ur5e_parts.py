"""The pieces around the UR5e client: shared memory, clock, settings, what the child imports."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sim2real.ur5e import shared_state
from sim2real.ur5e.process import safety_name
from sim2real.ur5e.robot_clock import RobotClock
from sim2real.ur5e.settings import UR5eSettings
from sim2real.ur5e.shared_state import RING_SLOTS, RawReading, SharedState, Status

PROJECT = Path(__file__).parents[2]


def raw(number: float) -> RawReading:
    vector = (number,) * 6
    return RawReading(number, number, number, vector, vector, vector, vector, vector, 1, True)


@pytest.fixture
def memory_file():
    descriptor = SharedState.create()
    yield descriptor
    os.close(descriptor)


@pytest.fixture
def memory(memory_file) -> SharedState:
    return SharedState(memory_file)


def test_the_child_starts_without_numpy_or_anything_heavier():
    code = (
        "import sys, sim2real.ur5e.process, sim2real.ur5e.rtde_client;"
        "print(sorted({'numpy', 'mujoco', 'torch', 'casadi', 'numba', 'gymnasium', 'scipy'}"
        " & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=PROJECT
    )
    assert result.stdout.strip() == "[]", result.stderr


def test_readings_come_out_as_they_went_in_oldest_first(memory):
    assert memory.newest_readings(10) == []
    for number in range(1, RING_SLOTS + 500):
        memory.publish_reading(raw(float(number)))
    newest = memory.newest_readings(300)
    assert newest == [raw(float(n)) for n in range(RING_SLOTS + 200, RING_SLOTS + 500)]
    assert len(memory.newest_readings(10**6)) >= 4 * 500


def test_a_command_is_taken_once_and_knows_the_stops_before_it(memory):
    assert memory.command(0) is None
    first = memory.send((1.0,) * 7, 0.1)
    command = memory.command(0)
    assert command == (first, 0, 0.1, (1.0,) * 7)
    assert memory.command(first) is None
    memory.ask_stop()
    second = memory.send((2.0,) * 6, 0.2)
    command = memory.command(first)
    assert command == (second, 1, 0.2, (2.0,) * 6)


def test_status_keeps_text_and_setpoint(memory):
    status = Status(shared_state.HALTED, 4, True, tuple(map(float, range(7))), "why, für \u2192")
    memory.publish_status(status)
    assert memory.status() == status
    memory.publish_status(Status(shared_state.IDLE, 4, False, (), ""))
    assert memory.status().setpoint == ()
    memory.publish_status(Status(shared_state.HALTED, 4, False, (), "x" * 2000))
    assert memory.status().text == "x" * shared_state.TEXT_BYTES


WRITER = """
import sys
from sim2real.ur5e.shared_state import RawReading, SharedState, Status
memory = SharedState(int(sys.argv[1]))
number = 0
while not memory.stops_asked:
    number += 1
    value = float(number)
    vector = (value,) * 6
    memory.beat(value)
    memory.send((value,) * 7, value)
    memory.publish_reading(RawReading(*vector[:3], *[vector] * 5, number, True))
    memory.publish_status(Status(number, number, False, (value,) * 7, str(number)))
"""


def test_a_reader_never_sees_half_of_anything_from_another_process(memory_file):
    memory = SharedState(memory_file)
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(memory_file)], pass_fds=(memory_file,), cwd=PROJECT
    )
    try:
        began = time.monotonic()
        while not memory.heartbeat and time.monotonic() - began < 20.0:
            time.sleep(0.01)
        commands = 0
        for _ in range(10000):
            assert memory.heartbeat > 0
            command = memory.command(-2)
            if command is not None:
                commands += 1
                assert set(command.target) == {command.duration}
            status = memory.status()
            assert status.text in ("", str(status.state))
            assert set(status.setpoint) <= {float(status.state)}
            for reading in memory.newest_readings(2):
                assert set(reading.wrench) == {reading.stamp} == set(reading.joint_angles)
        assert commands > 1000
    finally:
        memory.ask_stop()
        writer.wait()


def test_stamps_are_even_although_arrivals_jitter_and_clocks_drift():
    rng = np.random.default_rng(1)
    clock = RobotClock()
    n = 15000
    robot_times = 5000.0 + 0.002 * np.arange(n)
    true_times = 300.0 + 0.002 * np.arange(n) * (1 + 50e-6)
    delays = 2e-4 + rng.exponential(1e-3, n)
    stamps = np.array(
        [clock.stamp(r, t + d) for r, t, d in zip(robot_times, true_times, delays, strict=True)]
    )
    settled = slice(1000, None)
    error = (stamps - true_times)[settled]
    assert error.min() > -6e-4  # ten seconds of drift
    assert error.max() < 3e-4  # the shortest delay
    assert (np.diff(stamps) > 0).all()
    assert np.diff(stamps[settled]).std() < 0.05 * delays.std()


def test_a_restarted_controller_restarts_the_clock():
    clock = RobotClock()
    clock.stamp(1000.0, 50.0)
    clock.stamp(1001.0, 51.0)
    assert clock.stamp(3.0, 60.0) == pytest.approx(60.0)


def test_safety_bits_have_names_and_the_gravest_wins():
    assert safety_name(1) == "normal"
    assert safety_name(3) == "reduced"
    assert safety_name(1 << 2 | 1 << 10) == "protective_stop"
    assert safety_name(1 << 4 | 1) == "safeguard_stop"
    assert safety_name(1 << 7 | 1 << 10 | 1 << 2) == "emergency_stop"
    assert safety_name(1 << 9 | 1 << 7) == "fault"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frequency_hz", 1000.0),
        ("lookahead_time", 0.3),
        ("gain", 50.0),
        ("servo", "servoc"),
        ("address", ""),
        ("T_flange_tcp", np.ones((4, 4))),
        ("payload_mass", 9.0),
        ("payload_centre_of_mass", (0.0, 0.0)),
        ("stale_after", float("nan")),
    ],
)
def test_settings_out_of_range_are_refused_by_name(field, value):
    with pytest.raises(ValueError, match=f"^{field}: expected"):
        UR5eSettings(**{"address": "127.0.0.2", field: value})
