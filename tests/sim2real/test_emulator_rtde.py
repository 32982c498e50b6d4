"""The emulator's RTDE against the published guide: bytes on raw sockets, no code shared with it."""

import itertools
import socket
import struct
import time

import pytest

from sim2real.emulator.process import EmulatedController
from tests.sim2real.raw_rtde import RawRtde, address_of

JOINTS = [0.1, -1.2, 1.3, -1.4, 1.5, 0.6]

# Names and types as the guide's tables have them.
OUTPUTS = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "actual_digital_input_bits": "UINT64",
    "joint_temperatures": "VECTOR6D",
    "robot_mode": "INT32",
    "joint_mode": "VECTOR6INT32",
    "safety_mode": "INT32",
    "actual_tool_accelerometer": "VECTOR3D",
    "speed_scaling": "DOUBLE",
    "actual_digital_output_bits": "UINT64",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "payload_cog": "VECTOR3D",
    "payload_inertia": "VECTOR6D",
    "output_int_register_47": "INT32",
    "output_double_register_0": "DOUBLE",
    "ft_raw_wrench": "VECTOR6D",
}
INPUTS = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_register_64": "BOOL",
    "input_int_register_20": "INT32",
    "input_double_register_47": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}


@pytest.fixture(scope="module")
def robot():
    with EmulatedController(address_of(40), joint_angles=JOINTS) as controller:
        yield controller


@pytest.fixture
def link(robot):
    with RawRtde(robot.address) as client:
        yield client


def drain(link):
    """Read until the link ends."""
    while True:
        link.receive()


def test_protocol_versions_one_and_two_are_accepted_and_others_refused(link):
    assert link.version(2) == b"\x01"
    assert link.version(1) == b"\x01"
    assert link.version(3) == b"\x00"
    assert link.version(0) == b"\x00"


def test_controller_version_has_four_numbers(link):
    link.version()
    major, _minor, _bugfix, build = struct.unpack(">4I", link.ask("v"))
    assert major == 5
    assert build > 0


def test_reply_bytes_are_framed_as_the_guide_says(robot):
    with socket.create_connection((robot.address, 30004), 5) as raw:
        raw.sendall(b"\x00\x05V\x00\x02")
        assert raw.recv(100) == b"\x00\x04V\x01"


def test_packet_may_come_in_pieces_and_several_at_once(robot):
    with RawRtde(robot.address) as link:
        for byte in b"\x00\x05V\x00\x02":
            link.socket.sendall(bytes([byte]))
            time.sleep(0.002)
        assert link.receive() == ("V", b"\x01")
        link.socket.sendall(b"\x00\x05V\x00\x02\x00\x03v\x00\x05V\x00\x02")
        assert [link.receive()[0] for _ in range(3)] == ["V", "v", "V"]


def test_output_types_are_those_of_the_guide(link):
    link.version()
    recipe, types = link.outputs(",".join(OUTPUTS))
    assert recipe > 0
    assert dict(zip(OUTPUTS, types, strict=True)) == OUTPUTS


def test_trailing_comma_is_no_field(link):
    link.version()
    assert link.outputs("timestamp,actual_q,") == (1, ["DOUBLE", "VECTOR6D"])


def test_unknown_output_is_not_found_and_makes_the_recipe_invalid(link):
    link.version()
    recipe, types = link.outputs("timestamp,no_such_field")
    assert recipe == 0
    assert types == ["DOUBLE", "NOT_FOUND"]
    assert link.ask("S") == b"\x00"


def test_input_types_are_those_of_the_guide(link):
    link.version()
    recipe, types = link.inputs(",".join(INPUTS))
    assert recipe > 0
    assert dict(zip(INPUTS, types, strict=True)) == INPUTS


def test_unknown_input_is_not_found(link):
    link.version()
    assert link.inputs("input_int_register_48") == (0, ["NOT_FOUND"])
    assert link.inputs("actual_q") == (0, ["NOT_FOUND"])


def test_input_of_another_client_is_in_use_until_that_leaves(robot, link):
    link.version()
    with RawRtde(robot.address) as other:
        other.version()
        assert other.inputs("input_int_register_30")[0] > 0
        assert link.inputs("input_int_register_30") == (0, ["IN_USE"])
    until = time.monotonic() + 2.0
    while link.inputs("input_int_register_30")[0] == 0:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_nothing_is_streamed_before_start_and_the_start_reply_comes_first(link):
    link.version()
    link.outputs("timestamp")
    link.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        link.receive()
    link.socket.settimeout(5.0)
    link.send("S")
    assert link.receive() == ("S", b"\x01")
    assert link.receive()[0] == "U"


def test_values_are_big_endian_and_in_the_recipes_order(link):
    link.version()
    link.outputs("robot_mode,actual_q,timestamp,safety_status_bits,actual_main_voltage")
    link.ask("S")
    recipe, values = link.sample("i6ddId")
    assert recipe == 1
    assert values[0] == 7
    assert values[1:7] == pytest.approx(JOINTS)
    assert 0.0 < values[7] < 1e5
    assert values[8] == 1
    assert values[9] == 48.0


def test_clock_advances_by_two_milliseconds_per_packet(link):
    link.version()
    link.outputs("timestamp")
    link.ask("S")
    stamps = [link.sample("d")[1][0] for _ in range(200)]
    gaps = [b - a for a, b in itertools.pairwise(stamps)]
    assert gaps == pytest.approx([0.002] * 199, abs=1e-9)


@pytest.mark.parametrize(("frequency", "gap"), [(125.0, 0.008), (10.0, 0.1), (1e6, 0.002)])
def test_output_frequency_is_kept(link, frequency, gap):
    link.version()
    link.outputs("timestamp", frequency)
    link.ask("S")
    stamps = [link.sample("d")[1][0] for _ in range(6)]
    assert [b - a for a, b in itertools.pairwise(stamps)] == pytest.approx([gap] * 5)


def test_a_frequency_that_divides_no_tick_is_kept_on_average(link):
    link.version()
    link.outputs("timestamp", 300.0)
    link.ask("S")
    stamps = [link.sample("d")[1][0] for _ in range(151)]
    assert stamps[-1] - stamps[0] == pytest.approx(0.5, abs=0.003)


@pytest.mark.parametrize("frequency", [0.0, -5.0, float("nan")])
def test_impossible_frequency_gives_no_recipe(link, frequency):
    link.version()
    assert link.outputs("timestamp", frequency)[0] == 0


def test_pause_ends_the_stream_and_start_goes_on(link):
    link.version()
    link.outputs("timestamp")
    link.ask("S")
    before = link.sample("d")[1][0]
    assert link.ask("P") == b"\x01"
    link.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        link.receive()
    link.socket.settimeout(5.0)
    link.ask("S")
    assert link.sample("d")[1][0] > before + 0.09


def test_inputs_of_several_recipes_come_back_where_they_were_written(robot, link):
    link.version()
    link.outputs("actual_digital_output_bits,target_speed_fraction,standard_analog_output1")
    digital, _ = link.inputs("standard_digital_output_mask,standard_digital_output")
    slider, _ = link.inputs("speed_slider_mask,speed_slider_fraction")
    analog, _ = link.inputs(
        "standard_analog_output_mask,standard_analog_output_0,standard_analog_output_1"
    )
    assert len({digital, slider, analog}) == 3
    link.send("U", struct.pack(">BBB", digital, 0b110, 0b011))
    link.send("U", struct.pack(">BId", slider, 1, 0.25))
    link.send("U", struct.pack(">BBdd", analog, 0b10, 0.3, 0.7))
    link.ask("S")
    link.sample("Qdd")
    time.sleep(0.02)
    for _ in range(20):
        values = link.sample("Qdd")[1]
    assert values == (0b010, 0.25, 0.7)
    link.send("U", struct.pack(">BBB", digital, 0b110, 0))
    link.send("U", struct.pack(">BId", slider, 1, 1.0))
    link.send("U", struct.pack(">BBdd", analog, 0b10, 0.0, 0.0))
    link.ask("P")


def test_data_for_no_recipe_is_answered_by_a_text_message(link):
    link.version()
    link.send("U", b"\x09\x00\x00")
    kind, payload = link.receive()
    assert kind == "M"
    length = payload[0]
    source_length = payload[1 + length]
    assert b"recipe" in payload[1 : 1 + length]
    assert len(payload) == length + source_length + 3  # two lengths and the level
    assert link.version() == b"\x01"


def test_text_message_of_a_client_reaches_the_log(robot, link):
    link.version()
    link.send("M", b"\x05hello\x04test\x03")
    assert link.version() == b"\x01"
    assert any("hello" in line for line in robot.state()["log"])


def test_first_protocol_version_has_neither_frequency_nor_recipe_numbers(link):
    link.version(1)
    assert link.ask("O", b"timestamp,robot_mode") == b"DOUBLE,INT32"
    link.ask("S")
    while True:
        kind, payload = link.receive()
        if kind == "U":
            break
    _, mode = struct.unpack(">di", payload)
    assert mode == 7


def test_size_below_the_header_closes_the_link(link):
    link.socket.sendall(b"\x00\x02V")
    with pytest.raises(ConnectionResetError):
        drain(link)


def test_wrench_of_the_control_port_is_the_force_reported(robot, link):
    wrench = [1.0, -2.0, 3.0, 0.1, 0.2, -0.3]
    robot.command({"set": "wrench", "value": wrench})
    link.version()
    link.outputs("actual_TCP_force")
    link.ask("S")
    time.sleep(0.02)
    for _ in range(20):
        _, values = link.sample("6d")
    assert list(values) == wrench
    robot.command({"set": "wrench", "value": [0.0] * 6})


def test_frozen_stream_pauses_without_closing(robot, link):
    link.version()
    link.outputs("timestamp")
    link.ask("S")
    stamps = [link.sample("d")[1][0]]
    robot.fault("freeze", seconds=0.5)
    for _ in range(1000):
        stamps.append(link.sample("d")[1][0])
        if stamps[-1] - stamps[-2] > 0.1:
            break
    assert stamps[-1] - stamps[-2] == pytest.approx(0.5, abs=0.1)  # the robot went on


def test_mute_controller_sets_up_but_never_streams_until_cleared(robot, link):
    robot.fault("mute")
    assert link.version() == b"\x01"
    assert link.outputs("timestamp")[0] == 1
    assert link.ask("S") == b"\x01"
    link.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        link.receive()
    link.socket.settimeout(5.0)
    robot.fault("clear")
    assert link.receive()[0] == "U"


def test_dropped_link_closes_and_the_next_connection_works(robot, link):
    link.version()
    robot.fault("drop_link")
    with pytest.raises(ConnectionResetError):
        drain(link)
    with RawRtde(robot.address) as again:
        assert again.version() == b"\x01"


def test_refusing_controller_takes_no_new_connection_but_keeps_the_old(robot, link):
    link.version()
    robot.fault("refuse", seconds=0.5)
    with pytest.raises(ConnectionRefusedError):
        RawRtde(robot.address)
    assert link.version() == b"\x01"
    until = time.monotonic() + 5.0
    while True:
        try:
            RawRtde(robot.address).socket.close()
            break
        except ConnectionRefusedError:
            assert time.monotonic() < until
            time.sleep(0.05)


def test_refusal_is_ended_by_clear(robot):
    robot.fault("refuse", seconds=3000.0)
    robot.fault("clear")
    until = time.monotonic() + 5.0
    while True:
        try:
            RawRtde(robot.address).socket.close()
            break
        except ConnectionRefusedError:
            assert time.monotonic() < until
            time.sleep(0.02)
