"""The gripper's driver against a small imitation of the URCap's socket, and the simulated one."""

import os
import socket
import socketserver
import threading
import time
from contextlib import suppress

import pytest

from dlo_gym.exceptions import DeviceError
from sim2real.gripper import RobotiqGripper, SimulatedGripper

ADDRESS = f"127.{10 + os.getpid() % 200}.{os.getpid() // 200 % 250}.5"


class FakeUrcap(socketserver.ThreadingTCPServer):
    """Registers of a gripper, moved at once; replies end without a newline as the URCap's do."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self):
        super().__init__((ADDRESS, 0), _FakeUrcapHandler)
        self.registers = dict.fromkeys(("ACT", "GTO", "STA", "OBJ", "FLT", "POS", "PRE"), 0)
        self.registers |= {"SPE": 0, "FOR": 0}
        self.stop_at = None
        self.fault_on_motion = 0
        self.moves_before_rest = 0
        self.silent = False
        self.log = []
        self.links = []
        self._thread = threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    @property
    def port(self):
        return self.server_address[1]

    def drop_links(self):
        for link in self.links:
            with suppress(OSError):  # closed by the client
                link.shutdown(socket.SHUT_RDWR)
        self.links.clear()

    def close(self):
        self.drop_links()
        self.shutdown()
        self.server_close()

    def answer(self, words):
        state = self.registers
        if words[0] == "GET":
            if words[1] == "OBJ" and self.moves_before_rest:
                self.moves_before_rest -= 1
                return "OBJ 0"
            return f"{words[1]} {state[words[1]]}"
        asked = dict(zip(words[1::2], map(int, words[2::2]), strict=True))
        self.log.append(asked)
        if "ACT" in asked:
            state["ACT"] = asked["ACT"]
            state["STA"] = 3 * asked["ACT"]
            state["FLT"] = state["OBJ"] = 0
        elif state["STA"] == 3 and asked.get("GTO"):
            state["FLT"] = self.fault_on_motion
            state["PRE"] = asked["POS"]
            stopped = self.stop_at is not None and asked["POS"] > self.stop_at
            state["POS"] = self.stop_at if stopped else asked["POS"]
            state["OBJ"] = 2 if stopped else 3
        return "ack"


class _FakeUrcapHandler(socketserver.StreamRequestHandler):
    def handle(self):
        self.server.links.append(self.connection)
        with suppress(OSError):  # the link is cut
            for line in self.rfile:
                if not self.server.silent:
                    self.wfile.write(self.server.answer(line.decode().split()).encode())


@pytest.fixture
def urcap():
    server = FakeUrcap()
    yield server
    server.close()


@pytest.fixture
def gripper(urcap):
    with RobotiqGripper(
        ADDRESS, urcap.port, name="left", timeout=0.3, motion_timeout=0.6
    ) as gripper:
        yield gripper


def test_refuses_to_move_before_activation(gripper, urcap):
    with pytest.raises(DeviceError, match="'left'.*activate"):
        gripper.close_fingers()
    assert urcap.log == []


def test_activates_moves_and_reads_back_what_was_sent(gripper, urcap):
    gripper.activate()
    sent = gripper.move(0.5)
    assert urcap.registers["POS"] in (127, 128)
    assert sent == pytest.approx(0.5, abs=0.5 / 255)
    assert gripper.position() == sent
    assert gripper.move(1.0) == 1.0
    assert urcap.registers["POS"] == 0
    gripper.close_fingers()
    assert urcap.registers["POS"] == 255
    assert gripper.position() == 0.0
    assert not gripper.holds_object()


def test_speed_and_force_reach_the_gripper(urcap):
    with RobotiqGripper(ADDRESS, urcap.port, speed=0.2, force=1.0) as gripper:
        gripper.activate()
        gripper.open()
    assert urcap.log[-1] == {"POS": 0, "SPE": 51, "FOR": 255, "GTO": 1}


def test_a_ready_gripper_is_not_activated_again(gripper, urcap):
    urcap.registers |= {"ACT": 1, "STA": 3}
    gripper.activate()
    assert urcap.log == []  # it would open and drop what it holds


def test_connecting_moves_nothing(gripper, urcap):
    assert urcap.log == []


def test_knows_what_it_holds(gripper, urcap):
    gripper.activate()
    urcap.stop_at = 230
    gripper.close_fingers()
    assert gripper.holds_object()
    assert gripper.position() == pytest.approx(25 / 255)
    gripper.open()
    assert not gripper.holds_object()


def test_waits_until_the_fingers_stand(gripper, urcap):
    gripper.activate()
    urcap.moves_before_rest = 4
    gripper.move(0.3)
    assert urcap.moves_before_rest == 0


def test_names_the_fault(gripper, urcap):
    gripper.activate()
    urcap.fault_on_motion = 14
    with pytest.raises(DeviceError, match="fault 14: overcurrent"):
        gripper.close_fingers()
    with pytest.raises(DeviceError, match="overcurrent"):
        gripper.holds_object()
    urcap.fault_on_motion = 0
    gripper.activate()  # clears it
    gripper.close_fingers()


def test_motion_that_never_ends_is_an_error(gripper, urcap):
    gripper.activate()
    urcap.moves_before_rest = 10**6
    with pytest.raises(DeviceError, match="not at rest within 0.6 s"):
        gripper.open()


def test_reconnects_after_a_dropped_link(gripper, urcap):
    gripper.activate()
    gripper.move(0.25)
    urcap.drop_links()
    assert gripper.position() == pytest.approx(0.25, abs=1 / 255)


def test_silence_is_an_error_within_its_time(gripper, urcap):
    urcap.silent = True
    start = time.monotonic()
    with pytest.raises(DeviceError, match="'left'.*did not answer"):
        gripper.position()
    assert time.monotonic() - start < 3.0
    urcap.silent = False
    assert gripper.position() == 1.0


def test_nobody_there(urcap):
    port = urcap.port
    urcap.close()
    with pytest.raises(DeviceError, match=f"{ADDRESS}:{port} cannot be reached.*refused"):
        RobotiqGripper(ADDRESS, port).connect()


def test_urcap_without_a_gripper(urcap):
    urcap.registers["STA"] = "?"
    gripper = RobotiqGripper(ADDRESS, urcap.port, timeout=0.3)
    with pytest.raises(DeviceError, match="no gripper connected"):
        gripper.connect()


def test_disconnects_twice(gripper):
    gripper.disconnect()
    gripper.disconnect()


def test_simulated_gripper_keeps_the_real_ones_rules(gripper, urcap):
    simulated = SimulatedGripper("left", object_opening=25 / 255)
    with pytest.raises(DeviceError, match="not connected"):
        simulated.position()
    urcap.stop_at = 230
    with simulated:
        for each in (simulated, gripper):
            with pytest.raises(DeviceError, match="activate"):
                each.open()
            each.activate()
        for opening in (0.7, 0.0, 0.0, 0.4, 1.0):
            assert simulated.move(opening) == pytest.approx(gripper.move(opening))
            assert simulated.position() == pytest.approx(gripper.position())
            assert simulated.holds_object() == gripper.holds_object()


@pytest.mark.parametrize("opening", [-0.01, 1.01, float("nan")])
def test_openings_outside_the_range_are_refused(gripper, opening):
    with pytest.raises(ValueError, match="opening"):
        gripper.move(opening)
    with pytest.raises(ValueError, match="opening"):
        SimulatedGripper().move(opening)


def test_speed_is_checked():
    with pytest.raises(ValueError, match="speed"):
        RobotiqGripper(ADDRESS, speed=2.0)
