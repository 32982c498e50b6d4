"""The UR5e client against an emulated controller, in health and in every fault.

After each fault: the arm halts, nothing jumps on recovery, no call hangs, the message says what
happened.
"""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("rtde_control", reason="needs the extra 'robot'")

from dlo_gym.exceptions import DeviceError, SafetyStop, UnreachablePose
from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.scene.arms import T_FLANGE_TCP
from sim2real.arm import Arm
from sim2real.emulator.process import EmulatedController
from sim2real.ur5e.dashboard import ask
from sim2real.ur5e.handle import UR5eArm
from sim2real.ur5e.kinematics import tcp_poses
from sim2real.ur5e.settings import UR5eSettings

PID = os.getpid()
ADDRESS = f"127.{10 + PID % 200}.{PID // 200 % 250}.2"
OTHER_ADDRESS = f"127.{10 + PID % 200}.{PID // 200 % 250}.3"
HALT_LIMIT = 3.0  # [s]; the bound for every halt and every call
# A shared machine may leave a process without the processor for longer than the default allows.
PATIENT = {"stale_after": 0.8, "watchdog_hz": 2.0, "heartbeat_timeout": 1.0}


@pytest.fixture(scope="module")
def shared_emulator():
    with EmulatedController(ADDRESS, unlock_delay=0.3) as emulator:
        yield emulator


@pytest.fixture
def emulator(shared_emulator):
    yield shared_emulator
    shared_emulator.fault("clear")
    shared_emulator.fault("release_emergency_stop")
    wait_for(answers, "the dashboard")
    ask(ADDRESS, ["stop", "restart safety", "power on", "brake release"])
    wait_for(
        lambda: (
            "releasing" in ask(ADDRESS, ["unlock protective stop"])[0]
            and shared_emulator.state()["mode"] == "running"
            and shared_emulator.state()["safety"] == "normal"
        ),
        "the emulator to run again",
    )


def answers() -> bool:
    try:
        return bool(ask(ADDRESS, ["running"]))
    except OSError:
        return False


@pytest.fixture
def arm(emulator):
    with UR5eArm("left", settings()) as arm:
        arm.connect(control=True)
        yield arm


def settings(**changes) -> UR5eSettings:
    return UR5eSettings(**{"address": ADDRESS, **PATIENT, **changes})


def wait_for(condition, what: str, limit: float = HALT_LIMIT) -> float:
    """Until ``condition`` holds; returns how long it took [s]."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < limit, f"waited {limit} s in vain for {what}"
        time.sleep(0.01)
    return time.monotonic() - began


def stands(emulator) -> bool:
    return max(map(abs, emulator.state()["joint_velocities"])) < 1e-4


def joints(emulator) -> np.ndarray:
    return np.array(emulator.state()["joints"])


class Stream:
    """Steps an arm's target at 10 Hz in a thread until something raises."""

    def __init__(self, arm: UR5eArm, step=(0.0, 0.004, 0.004)) -> None:
        self.error: Exception | None = None
        self._arm, self._step = arm, np.array(step)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            target = self._arm.reading().T_base_tcp
            for k in range(200):
                sign = 1.0 if k % 40 < 20 else -1.0  # there and back
                target[:3, 3] += sign * self._step
                self._arm.servo_to(target, 0.1)
                time.sleep(0.1)
        except Exception as error:
            self.error = error

    def failure(self) -> Exception:
        wait_for(lambda: self.error is not None, "servo_to to raise")
        assert self.error is not None
        return self.error


def streaming(arm, emulator) -> Stream:
    stream = Stream(arm)
    wait_for(lambda: stream.error is not None or not stands(emulator), "motion")
    time.sleep(0.15)
    assert stream.error is None, stream.error
    return stream


def check_recovery(arm, emulator) -> None:
    """Nothing moves on recovery, and then the arm moves again as told."""
    before = joints(emulator)
    trace = []
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            trace.append(joints(emulator))
            time.sleep(0.005)

    watcher = threading.Thread(target=watch)
    watcher.start()
    began = time.monotonic()
    try:
        arm.recover()
        assert time.monotonic() - began < HALT_LIMIT
        time.sleep(0.3)
    finally:
        done.set()
        watcher.join()
    assert np.abs(np.array(trace) - before).max() < 2e-3
    target = arm.reading().T_base_tcp
    target[2, 3] += 0.01
    arm.servo_to(target, 0.1)
    wait_for(
        lambda: np.abs(arm.reading().T_base_tcp - target).max() < 1e-3, "the target after recovery"
    )


def test_it_is_an_arm_and_its_messages_need_no_robot():
    arm = UR5eArm("left", settings())
    assert isinstance(arm, Arm)
    arm.stop()
    arm.close()
    for call in (arm.reading, lambda: arm.readings(0.0), lambda: arm.servo_to(np.eye(4), 0.1)):
        with pytest.raises(DeviceError, match="left arm is not connected"):
            call()


def test_listening_reads_and_changes_nothing(emulator):
    with UR5eArm("left", settings()) as arm:
        arm.connect(control=False)
        reading = arm.reading()
        state = emulator.state()
        assert_allclose(reading.joint_angles, state["joints"])
        assert_allclose(reading.T_base_tcp, tcp_poses(state["joints"], T_FLANGE_TCP), atol=1e-9)
        assert reading.safety == "normal"
        assert not reading.running
        assert time.monotonic() - reading.stamp < 0.3
        assert not state["program"]
        with pytest.raises(DeviceError, match="only listens"):
            arm.servo_to(reading.T_base_tcp, 0.1)
        with pytest.raises(DeviceError, match="only listens"):
            arm.move_to(reading.joint_angles, 0.1)
        assert not emulator.state()["program"]


@pytest.mark.parametrize("servo", ["servol", pytest.param("servoj", marks=pytest.mark.slow)])
def test_targets_are_reached_smoothly(emulator, servo):
    with UR5eArm("left", settings(servo=servo)) as arm:
        arm.connect(control=True)
        assert arm.reading().running
        began = time.monotonic()
        target = arm.reading().T_base_tcp
        for _ in range(6):
            target[:3, 3] += [0.0, 0.006, -0.004]
            target[:3, :3] = exp_so3([0.0, 0.02, 0.0]) @ target[:3, :3]
            assert_allclose(arm.servo_to(target, 0.12), target)
            time.sleep(0.1)
        wait_for(lambda: np.abs(arm.reading().T_base_tcp - target).max() < 1e-4, "the target")
        history = arm.readings(began)
        stamps = np.array([reading.stamp for reading in history])
        assert (np.diff(stamps) > 0).all()
        speeds = np.array([np.linalg.norm(reading.tcp_speed[:3]) for reading in history])
        assert speeds.max() < 0.15  # 0.072 m/s asked for


def test_nothing_moves_by_connecting_and_the_first_setpoint_is_the_present_pose(arm, emulator):
    before = joints(emulator)
    time.sleep(0.3)
    arm.servo_to(arm.reading().T_base_tcp, 0.1)
    time.sleep(0.3)
    assert_allclose(joints(emulator), before, atol=1e-6)


def test_a_jump_and_an_unreachable_pose_are_refused(arm, emulator):
    before = joints(emulator)
    T = arm.reading().T_base_tcp
    far = T.copy()
    far[0, 3] += 0.07
    with pytest.raises(DeviceError, match=r"left arm: .*0\.07 m from .* at most 0\.05 m"):
        arm.servo_to(far, 0.1)
    with pytest.raises(UnreachablePose, match="left arm cannot reach"):
        arm.move_to(pose(T[:3, :3], [2.0, 0.0, 0.0]), 0.1)
    with pytest.raises(ValueError, match="^duration: expected"):
        arm.servo_to(T, 0.0)
    time.sleep(0.2)
    assert_allclose(joints(emulator), before, atol=1e-9)


def test_stop_halts_and_does_not_latch(arm, emulator):
    stream = streaming(arm, emulator)
    stream._arm = UR5eArm("left", settings())  # ends the stream
    stream.failure()
    arm.stop()
    arm.stop()
    assert wait_for(lambda: stands(emulator), "the halt") < 1.0
    assert arm.reading().running
    target = arm.reading().T_base_tcp
    target[2, 3] += 0.005
    arm.servo_to(target, 0.1)
    wait_for(lambda: np.abs(arm.reading().T_base_tcp - target).max() < 1e-3, "the next target")


@pytest.mark.slow
def test_move_to_arrives(arm, emulator):
    goal = arm.reading().joint_angles + np.array([0.15, 0.0, -0.05, 0.0, 0.0, 0.1])
    arm.move_to(goal, speed=0.5)
    assert_allclose(joints(emulator), goal, atol=3e-3)
    target = arm.reading().T_base_tcp
    target[1, 3] -= 0.05
    arm.move_to(target, speed=0.5)
    assert_allclose(arm.reading().T_base_tcp, target, atol=3e-3)


def test_stop_breaks_a_move_off(arm, emulator):
    goal = arm.reading().joint_angles + 0.8 * np.eye(6)[0]
    threading.Timer(0.6, arm.stop).start()
    with pytest.raises(DeviceError, match=r"broken off: stop\(\) was called"):
        arm.move_to(goal, speed=0.3)
    wait_for(lambda: stands(emulator), "the halt")
    assert goal[0] - joints(emulator)[0] > 0.3
    arm.move_to(goal - 0.8 * np.eye(6)[0], speed=0.5)


@pytest.mark.parametrize(
    "seconds", [0.5, *(pytest.param(seconds, marks=pytest.mark.slow) for seconds in (1.5, 4.0))]
)
def test_frozen_stream(emulator, seconds):
    with UR5eArm("left", settings(stale_after=0.25)) as arm:
        arm.connect(control=True)
        stream = streaming(arm, emulator)
        emulator.fault("freeze", seconds=seconds)
        frozen_at = time.monotonic()
        assert "sent no data for" in str(stream.failure())
        assert time.monotonic() - frozen_at < HALT_LIMIT
        wait_for(lambda: stands(emulator), "the halt")
        time.sleep(max(0.0, frozen_at + seconds + 0.2 - time.monotonic()))
        check_recovery(arm, emulator)


def test_dropped_link(arm, emulator):
    stream = streaming(arm, emulator)
    emulator.fault("drop_link")
    error = stream.failure()
    assert isinstance(error, DeviceError)
    assert "recover()" in str(error)
    wait_for(lambda: stands(emulator), "the halt")
    check_recovery(arm, emulator)


@pytest.mark.slow
def test_a_controller_that_accepts_but_never_streams(emulator):
    emulator.fault("mute")
    for control in (False, True):
        arm = UR5eArm("left", settings(connect_timeout=1.5))
        began = time.monotonic()
        with pytest.raises(DeviceError, match="accepts connections but sends no data"):
            arm.connect(control=control)
        assert time.monotonic() - began < HALT_LIMIT
    emulator.fault("clear")
    wait_for(answers, "the dashboard")
    with arm:
        arm.connect(control=True)
        arm.reading()


@pytest.mark.slow
def test_a_controller_that_refuses_or_is_absent(emulator):
    emulator.fault("refuse", seconds=1.0)
    began = time.monotonic()
    with pytest.raises(DeviceError, match="left arm at .*(does not answer|cannot connect)"):
        UR5eArm("left", settings()).connect(control=True)
    with pytest.raises(DeviceError, match="right arm at .*(does not answer|cannot connect|closed)"):
        UR5eArm("right", settings(address=OTHER_ADDRESS)).connect(control=False)
    assert time.monotonic() - began < 2 * HALT_LIMIT
    time.sleep(1.1)


def test_protective_stop_while_streaming(arm, emulator):
    stream = streaming(arm, emulator)
    emulator.fault("protective_stop")
    error = stream.failure()
    assert isinstance(error, SafetyStop)
    assert "protective stop" in str(error)
    wait_for(lambda: stands(emulator), "the halt")
    assert arm.reading().safety == "protective_stop"
    assert not arm.reading().running
    with pytest.raises(SafetyStop):
        arm.servo_to(arm.reading().T_base_tcp, 0.1)
    halted = joints(emulator)
    time.sleep(0.4)
    ask(ADDRESS, ["close safety popup", "unlock protective stop", "play"])  # the person resumes
    time.sleep(0.5)
    assert_allclose(joints(emulator), halted, atol=1e-9)  # the old motion does not go on
    emulator.fault("protective_stop")
    with pytest.raises(SafetyStop, match="protective stop.*pendant"):
        arm.recover()  # it is a person's to release
    time.sleep(0.4)
    ask(ADDRESS, ["unlock protective stop"])
    check_recovery(arm, emulator)


@pytest.mark.slow
def test_recover_unlocks_a_protective_stop_where_allowed(emulator):
    with UR5eArm("left", settings(unlock_protective_stop=True)) as arm:
        arm.connect(control=True)
        stream = streaming(arm, emulator)
        emulator.fault("protective_stop")
        stream.failure()
        wait_for(lambda: stands(emulator), "the halt")
        check_recovery(arm, emulator)
        assert arm.reading().safety == "normal"


@pytest.mark.slow
def test_protective_stop_within_a_move(arm, emulator):
    threading.Timer(0.5, lambda: emulator.fault("protective_stop")).start()
    with pytest.raises(SafetyStop, match="protective stop"):
        arm.move_to(arm.reading().joint_angles + 0.6 * np.eye(6)[0], speed=0.3)
    wait_for(lambda: stands(emulator), "the halt")


def test_emergency_stop(arm, emulator):
    stream = streaming(arm, emulator)
    emulator.fault("emergency_stop")
    error = stream.failure()
    assert isinstance(error, SafetyStop)
    assert "emergency stop" in str(error)
    wait_for(lambda: stands(emulator), "the halt")
    assert arm.reading().safety == "emergency_stop"
    with pytest.raises(SafetyStop, match="emergency stop"):
        arm.recover()


@pytest.mark.slow
def test_program_stopped_on_the_pendant(arm, emulator):
    stream = streaming(arm, emulator)
    ask(ADDRESS, ["stop"])
    assert "program ended" in str(stream.failure())
    wait_for(lambda: stands(emulator), "the halt")
    check_recovery(arm, emulator)


def test_client_process_killed(arm, emulator):
    stream = streaming(arm, emulator)
    assert arm.client_pid is not None
    os.kill(arm.client_pid, signal.SIGKILL)
    assert "ended by signal SIGKILL" in str(stream.failure())
    wait_for(lambda: stands(emulator), "the halt")
    arm.stop()
    time.sleep(PATIENT["stale_after"])
    with pytest.raises(DeviceError, match="SIGKILL"):
        arm.reading()
    check_recovery(arm, emulator)


@pytest.mark.slow
def test_client_process_hung(arm, emulator):
    stream = streaming(arm, emulator)
    assert arm.client_pid is not None
    os.kill(arm.client_pid, signal.SIGSTOP)
    assert isinstance(stream.failure(), DeviceError)
    wait_for(lambda: stands(emulator), "the halt")
    arm.stop()
    check_recovery(arm, emulator)


@pytest.mark.slow
def test_heartbeat_lost(arm, emulator):
    stream = streaming(arm, emulator)
    assert arm._child is not None
    arm._child._ending.set()
    assert "no sign of life" in str(stream.failure())
    wait_for(lambda: stands(emulator), "the halt")
    check_recovery(arm, emulator)


PARENT = """
    import sys, time
    from sim2real.ur5e.handle import UR5eArm
    from sim2real.ur5e.settings import UR5eSettings

    arm = UR5eArm("left", UR5eSettings(sys.argv[1]))
    arm.connect(control=True)
    target = arm.reading().T_base_tcp
    print(arm.client_pid, flush=True)
    while True:
        target[2, 3] += 0.003
        arm.servo_to(target, 0.1)
        time.sleep(0.1)
"""


@pytest.mark.slow
def test_parent_process_killed(emulator):
    command = [sys.executable, "-c", textwrap.dedent(PARENT), ADDRESS]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2])
    try:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        wait_for(lambda: not stands(emulator), "motion")
        time.sleep(0.3)
    finally:
        parent.kill()
        parent.wait()
    wait_for(lambda: stands(emulator), "the halt")
    wait_for(lambda: not Path(f"/proc/{child}").exists(), "the client's end")
    wait_for(lambda: not emulator.state()["program"], "the program's end")


@pytest.mark.slow
def test_one_controller_crashes_while_the_other_goes_on(arm, emulator):
    with (
        EmulatedController(OTHER_ADDRESS) as other,
        UR5eArm("right", settings(address=OTHER_ADDRESS)) as right,
    ):
        right.connect(control=True)
        stream = streaming(arm, emulator)
        right_stream = streaming(right, other)
        other.fault("crash")
        error = right_stream.failure()
        assert isinstance(error, DeviceError)
        assert "right arm" in str(error)
        assert stream.error is None
        began = time.monotonic()
        for each in (right, arm):
            each.stop()
        assert time.monotonic() - began < 0.05
        stream._arm = UR5eArm("left", settings())
        wait_for(lambda: stands(emulator), "the other arm's halt")
        began = time.monotonic()
        with pytest.raises(DeviceError, match="right arm"):
            right.recover()
        assert time.monotonic() - began < HALT_LIMIT
