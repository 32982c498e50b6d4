"""The emulator's dashboard, script and gripper ports on raw sockets, and its control port."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time

import pytest

from dlo_gym.exceptions import DeviceError
from sim2real.emulator.gripper_server import ACTIVATION_TIME, Gripper
from sim2real.emulator.process import EmulatedController
from tests.sim2real.raw_rtde import RawRtde, address_of

UR_RTDE_MARKS = """def rtde_control():
    global reg_offset_float = # float register offset
0    global reg_offset_int = # int register offset
0    def signal_done_with_cmd():
    end
    def rtde_cmd():
    end
    def process_cmd(cmd):
    end
    signal_done_with_cmd()
end
"""


@pytest.fixture(scope="module")
def robot():
    with EmulatedController(address_of(42), unlock_delay=0.3) as controller:
        yield controller


class Lines:
    """A client of a line protocol."""

    def __init__(self, address, port, greeting=False):
        self.socket = socket.create_connection((address, port), 5.0)
        self.file = self.socket.makefile("rb")
        self.greeting = self.file.readline() if greeting else b""

    def ask(self, line):
        self.socket.sendall(line.encode() + b"\n")
        return self.file.readline().decode().rstrip("\n")


@pytest.fixture
def dashboard(robot):
    client = Lines(robot.address, 29999, greeting=True)
    yield client
    client.socket.close()


def wait_for(condition, seconds=3.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def upload(robot, text):
    with socket.create_connection((robot.address, 30003), 5.0) as link:
        link.sendall(text.encode())
        time.sleep(0.05)


def test_greeting_and_questions(dashboard):
    assert dashboard.greeting == b"Connected: Universal Robots Dashboard Server\n"
    assert dashboard.ask("PolyscopeVersion").startswith("URSoftware 5.")
    assert dashboard.ask("get serial number").isdigit()
    assert dashboard.ask("get robot model") == "UR5"
    assert dashboard.ask("is in remote control") == "true"
    assert dashboard.ask("robotmode") == "Robotmode: RUNNING"
    assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"
    assert dashboard.ask("running") == "Program running: false"
    assert dashboard.ask("get loaded program") == "No program loaded"
    assert dashboard.ask("warp 9") == 'could not understand: "warp 9"'


def test_quit_says_goodbye_and_closes(dashboard):
    assert dashboard.ask("quit") == "Disconnected"
    assert dashboard.file.readline() == b""


def test_power_goes_off_and_comes_back_step_by_step(dashboard):
    assert dashboard.ask("power off") == "Powering off"
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF"
    assert dashboard.ask("power on") == "Powering on"
    assert dashboard.ask("robotmode") == "Robotmode: POWER_ON"
    wait_for(lambda: dashboard.ask("robotmode") == "Robotmode: IDLE")
    assert dashboard.ask("brake release") == "Brake releasing"
    wait_for(lambda: dashboard.ask("robotmode") == "Robotmode: RUNNING")


def test_brake_release_alone_powers_on_too(dashboard):
    dashboard.ask("power off")
    dashboard.ask("brake release")
    wait_for(lambda: dashboard.ask("robotmode") == "Robotmode: RUNNING")


def test_no_program_starts_without_power(robot, dashboard):
    dashboard.ask("power off")
    upload(robot, UR_RTDE_MARKS)
    assert dashboard.ask("running") == "Program running: false"
    dashboard.ask("brake release")
    wait_for(lambda: dashboard.ask("robotmode") == "Robotmode: RUNNING")


def test_uploaded_program_plays_pauses_and_stops(robot, dashboard):
    upload(robot, UR_RTDE_MARKS)
    wait_for(lambda: dashboard.ask("running") == "Program running: true")
    assert dashboard.ask("programState") == "PLAYING rtde_control"
    assert dashboard.ask("pause") == "Pausing program"
    assert dashboard.ask("programState") == "PAUSED rtde_control"
    assert dashboard.ask("play") == "Starting program"
    assert dashboard.ask("programState") == "PLAYING rtde_control"
    assert dashboard.ask("stop") == "Stopped"
    assert dashboard.ask("running") == "Program running: false"
    assert dashboard.ask("pause") == "Failed to execute: pause"


def test_other_scripts_are_logged_and_ignored(robot, dashboard):
    upload(robot, "def somebody_elses():\n  movej([0,0,0,0,0,0])\nend\n")
    wait_for(lambda: any("somebody_elses" in line for line in robot.state()["log"]))
    assert dashboard.ask("running") == "Program running: false"
    upload(robot, "popup('hello')\n" + UR_RTDE_MARKS)
    wait_for(lambda: dashboard.ask("running") == "Program running: true")
    dashboard.ask("stop")


def test_script_may_come_in_pieces(robot, dashboard):
    with socket.create_connection((robot.address, 30003), 5.0) as link:
        for start in range(0, len(UR_RTDE_MARKS), 37):
            link.sendall(UR_RTDE_MARKS[start : start + 37].encode())
            time.sleep(0.005)
        wait_for(lambda: dashboard.ask("running") == "Program running: true")
    dashboard.ask("stop")


def test_loaded_program_plays(dashboard):
    assert dashboard.ask("load pick.txt") == "File not found: pick.txt"
    assert dashboard.ask("load pick.urp") == "Loading program: /programs/pick.urp"
    assert dashboard.ask("get loaded program") == "Loaded program: /programs/pick.urp"
    assert dashboard.ask("play") == "Starting program"
    assert dashboard.ask("programState") == "PLAYING pick.urp"
    dashboard.ask("stop")


def test_protective_stop_is_unlocked_no_sooner_than_its_delay(robot, dashboard):
    robot.fault("protective_stop")
    assert dashboard.ask("safetystatus") == "Safetystatus: PROTECTIVE_STOP"
    assert dashboard.ask("unlock protective stop").startswith("Cannot unlock protective stop")
    assert dashboard.ask("play") == "Failed to execute: play"
    time.sleep(0.35)
    assert dashboard.ask("unlock protective stop") == "Protective stop releasing"
    assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"


def test_emergency_stop_cannot_be_powered_away(robot, dashboard):
    robot.fault("emergency_stop")
    assert dashboard.ask("safetystatus") == "Safetystatus: ROBOT_EMERGENCY_STOP"
    assert dashboard.ask("power on").startswith("Power on failed")
    dashboard.ask("unlock protective stop")
    assert dashboard.ask("safetystatus") == "Safetystatus: ROBOT_EMERGENCY_STOP"
    robot.fault("release_emergency_stop")
    assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF"
    dashboard.ask("brake release")
    wait_for(lambda: dashboard.ask("robotmode") == "Robotmode: RUNNING")


def test_local_control_refuses_orders_but_answers_questions(robot, dashboard):
    robot.command({"set": "remote_control", "value": False})
    assert dashboard.ask("is in remote control") == "false"
    assert "Remote Control" in dashboard.ask("power off")
    assert dashboard.ask("robotmode") == "Robotmode: RUNNING"
    upload(robot, UR_RTDE_MARKS)
    assert dashboard.ask("running") == "Program running: false"
    robot.command({"set": "remote_control", "value": True})


def test_popups_are_shown_and_closed(robot, dashboard):
    assert dashboard.ask("popup mind the cable") == "showing popup"
    assert robot.state()["popups"][-1] == "mind the cable"
    assert dashboard.ask("close popup") == "closing popup"
    assert "mind the cable" not in robot.state()["popups"]


# Control port


def test_joints_are_set_while_standing_and_refused_while_moving(robot):
    target = [0.5, -1.0, 1.0, -1.0, 1.0, 0.5]
    robot.command({"set": "joints", "value": target})
    assert robot.state()["joints"] == target
    with RawRtde(robot.address) as link:
        link.version()
        recipe, _ = link.inputs(
            "input_int_register_0," + ",".join(f"input_double_register_{i}" for i in range(8))
        )
        upload(robot, UR_RTDE_MARKS)
        speed = struct.pack(">Bi8d", recipe, 9, 0.1, 0, 0, 0, 0, 0, 1.0, 0.0)
        link.send("U", speed)
        wait_for(lambda: robot.state()["joint_velocities"][0] == pytest.approx(0.1))
        with pytest.raises(ValueError, match="not standing"):
            robot.command({"set": "joints", "value": target})
        link.send("U", struct.pack(">Bi8d", recipe, 0, *[0.0] * 8))
        robot.fault("stop_program")
    wait_for(lambda: robot.state()["motion"] == "hold")


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"get": "everything"}, "expected one of state, timing"),
        ({"set": "wrench", "value": [1, 2, 3]}, "six numbers"),
        ({"set": "wrench", "value": ["1"] * 6}, "six numbers"),
        ({"set": "joints", "value": [9.0] * 6}, "within"),
        ({"set": "object_width", "value": 256}, "0 to 255"),
        ({"set": "remote_control", "value": 1}, "true or false"),
        ({"fault": "freeze"}, "expected a number"),
        ({"fault": "freeze", "seconds": -1}, "expected 0 to"),
        ({"fault": "explode"}, "expected one of"),
        ({}, "expected one of"),
    ],
)
def test_bad_requests_are_refused_with_what_was_expected(robot, request_, message):
    with pytest.raises(ValueError, match=message):
        robot.command(request_)


def test_lines_that_are_no_objects_get_an_error_and_the_next_line_works(robot):
    control = Lines(robot.address, 63999)
    for line in ("[1, 2]", "nonsense", '"text"', "[" * 5000):
        assert "error" in json.loads(control.ask(line))
    assert json.loads(control.ask('{"set": "wrench", "value": [0, 0, 0, 0, 0, 0]}')) == {"ok": True}
    control.socket.close()


# Process


def test_only_loopback_addresses_are_served():
    for address in ("0.0.0.0", "192.168.1.2", "::1", "localhost", "126.255.255.255"):
        with pytest.raises(ValueError, match=r"127\.0\.0\.0/8"):
            EmulatedController(address)


def test_settings_that_are_no_numbers_are_refused():
    with pytest.raises(ValueError, match="joint_angles"):
        EmulatedController("127.0.0.9", joint_angles=[0.0] * 5)
    with pytest.raises(ValueError, match="servo_lag"):
        EmulatedController("127.0.0.9", servo_lag=float("nan"))


def test_second_emulator_on_an_address_does_not_start_and_harms_nothing(robot):
    with pytest.raises(DeviceError, match="does not start"):
        EmulatedController(robot.address).start()
    assert robot.state()["mode"]


def test_crash_ends_the_process_and_it_starts_again():
    with EmulatedController(address_of(43)) as controller:
        pid = controller.pid
        controller.fault("crash")
        wait_for(lambda: not controller.alive)
        with pytest.raises(DeviceError):
            controller.state()
        controller.start()
        assert controller.pid != pid
        assert controller.state()["mode"] == "running"


def test_emulator_ends_when_its_parent_is_killed():
    code = (
        "import time\nfrom sim2real.emulator.process import EmulatedController\n"
        f"c = EmulatedController({address_of(44)!r}); c.start(); print(c.pid, flush=True)\n"
        "time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    try:
        wait_for(lambda: not _runs(child), 5.0)
    finally:
        if _runs(child):
            os.kill(child, signal.SIGKILL)


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


# Gripper


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def gripper():
    clock = Clock()
    hand = Gripper(clock)
    hand.reply("SET ACT 1")
    clock.now += ACTIVATION_TIME
    return hand, clock


def test_gripper_ignores_moves_until_activated():
    clock = Clock()
    hand = Gripper(clock)
    assert hand.reply("GET STA") == "STA 0"
    assert hand.reply("SET POS 255 SPE 255 FOR 10 GTO 1") == "ack"
    clock.now += 5.0
    assert hand.reply("GET POS") == "POS 0"
    assert hand.reply("SET ACT 1") == "ack"
    assert hand.reply("GET STA") == "STA 1"
    clock.now += ACTIVATION_TIME
    assert hand.reply("GET STA") == "STA 3"


def test_gripper_moves_at_the_speed_set(gripper):
    hand, clock = gripper
    durations = {}
    for speed in (0, 255):
        hand.reply(f"SET POS 200 SPE {speed} FOR 0 GTO 1")
        start = clock.now
        while hand.reply("GET OBJ") != "OBJ 3":
            assert hand.reply("GET OBJ") == "OBJ 0"
            clock.now += 0.01
        durations[speed] = clock.now - start
        assert hand.reply("GET POS") == "POS 200"
        hand.reply("SET POS 0 SPE 255 GTO 1")
        clock.now += 5.0
        assert hand.reply("GET POS") == "POS 0"
    # 20 and 150 mm/s of 85 mm in 255 steps.
    assert durations[0] == pytest.approx(200 / 255 * 85 / 20, abs=0.02)
    assert durations[255] == pytest.approx(200 / 255 * 85 / 150, abs=0.02)


def test_gripper_stops_at_an_object_only_while_closing_and_goes_on_without_it(gripper):
    hand, clock = gripper
    hand.set_object(120)
    hand.reply("SET POS 255 SPE 255 FOR 10 GTO 1")
    clock.now += 2.0
    assert hand.reply("GET OBJ") == "OBJ 2"
    assert hand.reply("GET POS") == "POS 120"
    assert hand.reply("GET PRE") == "PRE 255"
    hand.set_object(None)
    clock.now += 2.0
    assert hand.reply("GET OBJ") == "OBJ 3"
    assert hand.reply("GET POS") == "POS 255"
    hand.set_object(120)
    hand.reply("SET POS 0 GTO 1")
    clock.now += 2.0
    assert hand.reply("GET OBJ") == "OBJ 3"
    assert hand.reply("GET POS") == "POS 0"


@pytest.mark.parametrize(
    "line",
    ["", "GET", "GET XYZ", "SET POS", "SET POS 256", "SET POS -1", "SET POS 1e2", "SET STA 3"],
)
def test_gripper_does_not_understand_what_it_has_not(gripper, line):
    hand, _ = gripper
    before = hand.state()
    assert hand.reply(line) == "?"
    assert hand.state() == before


def test_gripper_answers_on_its_port_without_line_ends(robot):
    with socket.create_connection((robot.address, 63352), 5.0) as link:
        link.sendall(b"SET ACT 1\n")
        assert link.recv(100) == b"ack"
        link.sendall(b"GET ACT\n")
        assert link.recv(100) == b"ACT 1"
        robot.command({"set": "object_width", "value": 80})
        assert robot.state()["gripper"]["object_width"] == 80
        robot.command({"set": "object_width", "value": None})
