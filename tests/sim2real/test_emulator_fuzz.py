"""Whatever bytes come to the emulator's ports: it lives, it keeps time, and serves the next."""

import contextlib
import json
import random
import resource
import socket
import struct
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim2real.emulator.process import EmulatedController
from tests.sim2real.raw_rtde import RawRtde, address_of

DASHBOARD, SCRIPT, RTDE, GRIPPER, CONTROL = 29999, 30003, 30004, 63352, 63999
PORTS = (DASHBOARD, SCRIPT, RTDE, GRIPPER, CONTROL)
HOME = [2.21, -1.61, 2.30, -0.68, 0.64, 1.57]
FUZZ = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

# A conversation that a client could have, to be damaged: setups, a start, data for every recipe.
NAMES = b"input_int_register_0," + b",".join(b"input_double_register_%d" % i for i in range(12))


def frame(kind, payload=b""):
    return struct.pack(">HB", len(payload) + 3, ord(kind)) + payload


def command(code, *values):
    floats = [*values, *[0.0] * (12 - len(values))]
    return frame("U", struct.pack(">Bi12d", 1, code, *floats))


SPEECH = (
    frame("V", b"\x00\x02")
    + frame("v")
    + frame("O", struct.pack(">d", 125.0) + b"timestamp,actual_q,actual_TCP_pose")
    + frame("I", NAMES)
    + frame("S")
    + command(24, 0.5, -0.1, 0.2, 0.0, 3.0, 0.0, 0.0, 0.0, 0.002, 0.1, 300.0)
    + command(9, 0.1, 0.1)
    + frame("M", b"\x05hello\x04test\x03")
    + frame("P")
)
SCRIPT_TEXT = (
    b"def rtde_control():\n    global reg_offset_float = 0\n    global reg_offset_int = 0\n"
    b"    def rtde_cmd():\n    end\n    def process_cmd(cmd):\n    end\n"
    b"    def signal_done_with_cmd():\n    end\nend\n"
)
LINES = [
    "power off\nbrake release\nload x.urp\nplay\nstop\npopup x\nunlock protective stop\n",
    "SET ACT 1 GTO 1 POS 255\nGET POS\nGET STA\nSET POS 0\n",
    '{"get": "state"}\n{"set": "wrench", "value": [0, 0, 1, 0, 0, 0]}\n{"fault": "clear"}\n',
]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    log = tmp_path_factory.mktemp("fuzz") / "emulator.log"
    with (
        log.open("wb") as file,
        EmulatedController(
            address_of(45), joint_angles=HOME, unlock_delay=0.0, log=file
        ) as controller,
    ):
        yield controller
        assert controller.alive
    assert "Traceback" not in log.read_text()


def throw(robot, port, data, *, patience=0.05):
    """Send bytes and read what comes for a moment."""
    with contextlib.suppress(OSError), socket.create_connection((robot.address, port), 2.0) as link:
        link.settimeout(patience)
        link.sendall(data)
        with contextlib.suppress(TimeoutError):
            while link.recv(65536):
                patience -= 0.01
                if patience < 0.0:
                    break


def assert_serves(robot):
    """A normal client is served on every port, at the robot's pace."""
    with RawRtde(robot.address) as link:
        assert link.version() == b"\x01"
        assert link.outputs("timestamp,actual_q")[0] == 1
        link.ask("S")
        values = [link.sample("7d")[1] for _ in range(20)]
        assert values[-1][0] - values[0][0] == pytest.approx(19 * 0.002, abs=1e-6)
        assert all(abs(angle) <= 6.3 for angle in values[-1][1:])  # NaN is not
    with socket.create_connection((robot.address, DASHBOARD), 2.0) as link:
        lines = link.makefile("rb")
        assert lines.readline().startswith(b"Connected")
        link.sendall(b"robotmode\n")
        assert lines.readline().startswith(b"Robotmode")
    with socket.create_connection((robot.address, GRIPPER), 2.0) as link:
        link.sendall(b"GET STA\n")
        assert link.recv(100).startswith(b"STA")
    assert robot.state()["pid"] == robot.pid


def mutate(data, seed):
    """``data`` with some bytes changed, cut out, doubled or cut off."""
    rng = random.Random(seed)
    mutated = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        if not mutated:
            break
        place, length = rng.randrange(len(mutated)), rng.randint(1, 12)
        kind = rng.randrange(4)
        if kind == 0:
            mutated[place] = rng.randrange(256)
        elif kind == 1:
            del mutated[place : place + length]
        elif kind == 2:
            mutated[place:place] = mutated[place : place + length]
        else:
            mutated[place : place + length] = rng.randbytes(length)
    return bytes(mutated)


@FUZZ
@given(port=st.sampled_from(PORTS), data=st.binary(min_size=1, max_size=2000))
def test_random_bytes_on_any_port(robot, port, data):
    throw(robot, port, data, patience=0.02)
    assert robot.alive


@FUZZ
@given(seed=st.integers(0, 2**32 - 1))
def test_damaged_rtde_conversations(robot, seed):
    throw(robot, SCRIPT, SCRIPT_TEXT, patience=0.005)
    throw(robot, RTDE, mutate(SPEECH, seed), patience=0.02)
    assert robot.alive


@FUZZ
@given(
    kind=st.sampled_from([*b"VvMUOISP", 0, 255]),
    payload=st.binary(max_size=300),
    before=st.sampled_from([b"", SPEECH]),
)
def test_well_framed_nonsense(robot, kind, payload, before):
    packet = struct.pack(">HB", len(payload) + 3, kind) + payload
    throw(robot, RTDE, before + packet, patience=0.02)
    assert robot.alive


@FUZZ
@given(
    code=st.one_of(
        st.sampled_from([1, 2, 3, 4, 9, 10, 11, 24, 29, 30, 46]),
        st.integers(0, 75),
        st.integers(-(2**31), 2**31 - 1),
    ),
    values=st.one_of(
        st.lists(st.floats(width=64), min_size=12, max_size=12),
        st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12),
    ),
)
def test_commands_with_any_numbers(robot, code, values):
    throw(robot, SCRIPT, SCRIPT_TEXT, patience=0.005)
    setup = frame("V", b"\x00\x02") + frame("I", NAMES)
    throw(robot, RTDE, setup + command(0) + command(code, *values), patience=0.02)
    state = robot.state()
    assert all(abs(angle) <= 6.3 for angle in state["joints"])
    recover(robot)


@FUZZ
@given(
    port=st.sampled_from([DASHBOARD, GRIPPER, CONTROL]),
    text=st.sampled_from(LINES),
    seed=st.integers(0, 2**32 - 1),
)
def test_damaged_lines(robot, port, text, seed):
    damaged = mutate(text.encode(), seed)
    if b"crash" not in damaged:
        throw(robot, port, damaged, patience=0.02)
    assert robot.alive


def test_after_all_of_that_the_robot_serves_and_moves(robot):
    recover(robot)
    assert_serves(robot)
    with RawRtde(robot.address) as link:
        link.version()
        assert link.inputs(NAMES.decode())[0] == 1
        link.socket.sendall(command(0))  # not what the last client left in the registers
        assert link.version() == b"\x01"
        throw(robot, SCRIPT, SCRIPT_TEXT, patience=0.01)
        link.socket.sendall(command(9, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        until = time.monotonic() + 3.0
        while robot.state()["joint_velocities"][0] != pytest.approx(0.1):
            assert time.monotonic() < until, robot.state()
            time.sleep(0.01)
    recover(robot)


@pytest.mark.parametrize("size", [0, 1, 2, 20000, 65535])
def test_impossible_packet_sizes_close_the_link(robot, size):
    with RawRtde(robot.address) as link:
        link.socket.sendall(struct.pack(">HB", size, ord("O")) + b"x" * min(size, 1000))
        with pytest.raises(ConnectionResetError):
            drain(link)
    assert_serves(robot)


def drain(link):
    while True:
        link.receive()


@pytest.mark.parametrize("port", [DASHBOARD, GRIPPER, CONTROL])
def test_endless_line_is_cut_off(robot, port):
    with (
        socket.create_connection((robot.address, port), 5.0) as link,
        pytest.raises(ConnectionError),
    ):
        pour(link, b"x" * 65536)
    assert_serves(robot)


def test_endless_script_is_cut_off(robot):
    with socket.create_connection((robot.address, SCRIPT), 5.0) as link:
        link.sendall(b"def endless():\n")
        with pytest.raises(ConnectionError):
            pour(link, b"  x = 1\n" * 8192)
    assert_serves(robot)


def pour(link, data):
    for _ in range(1000):
        link.sendall(data)


def test_flood_of_packets_is_cut_off_or_survived(robot):
    with contextlib.suppress(OSError), socket.create_connection((robot.address, RTDE), 5.0) as link:
        pour(link, frame("v") * 20000)
    assert_serves(robot)


def test_client_that_reads_nothing_costs_no_memory(robot):
    before = resident(robot.pid)
    with RawRtde(robot.address) as deaf:
        deaf.version()
        deaf.outputs(",".join(f"output_double_register_{i}" for i in range(48)))
        deaf.send("S")
        time.sleep(1.0)
        assert_serves(robot)
    assert resident(robot.pid) - before < 20e6


def resident(pid):
    """Memory of a process [bytes]."""
    with open(f"/proc/{pid}/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def test_slow_clients_do_not_hold_up_others(robot):
    with contextlib.ExitStack() as stack:
        slow = [
            stack.enter_context(socket.create_connection((robot.address, port), 2.0))
            for port in PORTS
            for _ in range(4)
        ]
        for _ in range(5):
            for link in slow:
                with contextlib.suppress(OSError):
                    link.sendall(b"\x00")
            assert_serves(robot)


def test_crowd_is_limited_and_room_is_made_when_it_leaves(robot):
    for port in PORTS:
        with contextlib.ExitStack() as stack:
            crowd = []
            for _ in range(60):
                with contextlib.suppress(OSError):
                    link = socket.create_connection((robot.address, port), 2.0)
                    crowd.append(stack.enter_context(link))
            time.sleep(0.1)
            closed = sum(is_closed(link) for link in crowd)
            assert len(crowd) - closed <= 32
    time.sleep(0.1)
    assert_serves(robot)


def is_closed(link):
    link.setblocking(False)
    try:
        while data := link.recv(4096):
            assert data
        return True
    except BlockingIOError:
        return False
    except OSError:
        return True


def recover(robot):
    """Back to power, no stop, no program, standing at home."""
    robot.fault("clear")
    robot.fault("release_emergency_stop")
    robot.fault("stop_program")
    robot.command({"set": "remote_control", "value": True})
    robot.command({"set": "wrench", "value": [0.0] * 6})
    with socket.create_connection((robot.address, DASHBOARD), 5.0) as link:
        lines = link.makefile("rb")
        lines.readline()
        for line in (b"unlock protective stop\n", b"brake release\n"):
            link.sendall(line)
            lines.readline()
    until = time.monotonic() + 5.0
    while (state := robot.state())["mode"] != "running" or state["motion"] != "hold":
        assert time.monotonic() < until, json.dumps(state)
        time.sleep(0.005)
    robot.command({"set": "joints", "value": HOME})
