import socket
import struct
import threading
import time

import numpy as np
import pytest

from sim2real.emulator.rtde_reader import ClockMap, JointHistory, RtdeReader, split_packages
from tests.sim2real.fake_controller import FakeController, free_address

HOME = [0.1, -1.2, 1.3, -0.4, 0.5, 0.6]


def wait_until(condition, timeout=5.0):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


@pytest.fixture
def address():
    return free_address(11)


@pytest.fixture
def reader(address):
    reader = RtdeReader(address)
    yield reader
    reader.close()


def test_reads_the_angles_at_125_hz_in_monotonic_time(address, reader):
    with FakeController(address, HOME) as controller:
        wait_until(lambda: reader.connected)
        assert controller.frequency == 125.0
        first = reader.history.newest
        wait_until(lambda: reader.history.newest.stamp > first.stamp + 0.2)
        newest = reader.history.newest
        np.testing.assert_array_equal(newest.joint_angles, HOME)
        assert -0.001 < time.monotonic() - newest.stamp < 0.1


def test_stamps_follow_the_controllers_clock_not_the_arrivals(address, reader):
    # The angle is the controller's time, so that a stamp's error shows as an angle's.
    with FakeController(address, lambda t: [t % 1000.0, 0, 0, 0, 0, 0]) as controller:
        wait_until(lambda: reader.connected)
        time.sleep(0.3)
        for _ in range(50):
            sample = reader.history.newest
            told = sample.joint_angles[0] - controller.clock_ahead
            assert sample.stamp % 1000.0 == pytest.approx(told % 1000.0, abs=0.005)
            time.sleep(0.004)


def test_comes_back_after_the_controller_was_away(address, reader):
    controller = FakeController(address, HOME)
    wait_until(lambda: reader.connected)
    controller.close()
    wait_until(lambda: not reader.connected)
    held = reader.history.newest
    time.sleep(0.3)
    assert reader.history.newest is held
    moved = [0.2, *HOME[1:]]
    with FakeController(address, moved):
        wait_until(lambda: reader.history.newest.joint_angles[0] == 0.2)
        assert reader.connections == 2


def test_only_an_absence_that_lasts_is_worth_a_warning(address, reader, caplog):
    time.sleep(0.5)  # the reader was there first
    for _ in range(2):
        with FakeController(address, HOME):
            wait_until(lambda: reader.connected)
        wait_until(lambda: not reader.connected)
    assert not caplog.records
    wait_until(lambda: caplog.records)
    time.sleep(0.5)
    assert [record.message for record in caplog.records] == [
        f"RTDE {address}:30004: [Errno 111] Connection refused; retrying"
    ]


def test_a_silent_stream_is_given_up_and_asked_for_anew(address, reader):
    with FakeController(address, HOME) as controller:
        wait_until(lambda: reader.connected)
        controller.frozen = True
        wait_until(lambda: reader.connections == 2)
        controller.frozen = False
        last = reader.history.newest.stamp
        wait_until(lambda: reader.history.newest.stamp > last)


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"\x00\x00\x00",
        b"\x00\x04V\x00",  # refuses the version
        b"\x00\x04V\x01\x00\x10O\x01DOUBLE,NOT_FOUND",
        b"\xff\xffV" + bytes(100),
        bytes(range(256)),
    ],
)
def test_survives_any_answer(address, answer):
    listener = socket.create_server((address, 30004))
    served = threading.Event()

    def answer_once():
        client, _ = listener.accept()
        client.sendall(answer)
        client.close()
        listener.close()
        served.set()

    threading.Thread(target=answer_once, daemon=True).start()
    reader = RtdeReader(address)
    try:
        assert served.wait(5.0)
        time.sleep(0.1)
        assert reader.history.newest is None
        with FakeController(address, HOME):
            wait_until(lambda: reader.connected)
    finally:
        reader.close()


def test_history_interpolates_and_holds_beyond_its_ends():
    history = JointHistory()
    with pytest.raises(ValueError, match="not told"):
        history.at(0.0)
    history.add(1.0, np.zeros(6))
    history.add(1.5, np.full(6, 2.0))
    history.add(1.2, np.full(6, 99.0))  # late: dropped
    np.testing.assert_allclose(history.at(1.25), 1.0)
    np.testing.assert_allclose(history.at(0.0), 0.0)
    np.testing.assert_allclose(history.at(9.0), 2.0)


def test_clock_map_ignores_late_arrivals_and_follows_a_restart():
    clock = ClockMap()
    rng = np.random.default_rng(0)
    robot = np.arange(0.0, 20.0, 0.008)
    arrival = 100.0 + robot + rng.exponential(0.01, len(robot))
    stamps = np.array([clock.stamp(*pair) for pair in zip(robot, arrival, strict=True)])
    assert np.abs(stamps - (100.0 + robot))[200:].max() < 0.001
    assert clock.stamp(0.0, 130.0) == 130.0


def test_clock_map_follows_a_clock_that_falls_behind():
    clock = ClockMap()
    robot = np.arange(0.0, 60.0, 0.008)
    arrival = 1.001 * robot  # the controller's clock loses 60 ms a minute
    stamps = np.array([clock.stamp(*pair) for pair in zip(robot, arrival, strict=True)])
    assert np.abs(stamps - arrival).max() < 0.0101


def test_packages_are_split_wherever_the_stream_is_cut():
    whole = b"".join(
        struct.pack(">HB", 3 + n, kind) + bytes(n) for n, kind in ((0, 83), (57, 85), (9, 77))
    )
    for cut in range(len(whole) + 1):
        first, rest = split_packages(whole[:cut])
        second, rest = split_packages(rest + whole[cut:])
        assert [kind for kind, _ in first + second] == [83, 85, 77]
        assert rest == b""
    with pytest.raises(ValueError, match="2 bytes"):
        split_packages(b"\x00\x02V")
