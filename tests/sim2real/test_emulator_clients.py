"""Unmodified ur_rtde clients drive the emulator, each in a process of its own.

A process of its own because ur_rtde can take its process down with it when a link breaks.
"""

import json
import socket
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, log_so3, pose
from dlo_gym.scene.arms import T_FLANGE_TCP
from dlo_gym.scene.ur5e import link_frames
from sim2real.emulator.process import EmulatedController
from tests.sim2real.raw_rtde import address_of

pytest.importorskip("rtde_control", reason="needs the extra 'robot'")

HOME = [2.21, -1.61, 2.30, -0.68, 0.64, 1.57]
PREAMBLE = """
import json, os, sys, time
import numpy as np
import dashboard_client, rtde_control, rtde_io, rtde_receive
address = sys.argv[1]
receive = rtde_receive.RTDEReceiveInterface(address)
home = {home}
def tell(**values):
    print(json.dumps(values), flush=True)
def wait(condition, seconds=3.0):
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.002)
    return True
def at(target):
    # Data may be a few packets old when a command returns.
    return wait(lambda: np.abs(np.subtract(receive.getActualQ(), target)).max() < 1e-6)
def stream(command, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        period = control.initPeriod()
        assert command()
        control.waitPeriod(period)
"""
CONTROL = "control = rtde_control.RTDEControlInterface(address)\n"
END = "\nsys.stdout.flush()\nos._exit(0)\n"


@pytest.fixture(scope="module")
def emulator():
    with EmulatedController(address_of(41), joint_angles=HOME, unlock_delay=0.3) as controller:
        yield controller


@pytest.fixture
def robot(emulator):
    """At home, standing, without a program."""
    emulator.fault("stop_program")
    emulator.command({"set": "wrench", "value": [0.0] * 6})
    until = time.monotonic() + 3.0
    while emulator.state()["motion"] != "hold":
        assert time.monotonic() < until
        time.sleep(0.01)
    emulator.command({"set": "joints", "value": HOME})
    return emulator


def run(robot, code, *, control=True, timeout=60.0):
    """What a client process tells, after ``code`` ran in it."""
    text = PREAMBLE.format(home=HOME) + (CONTROL if control else "") + textwrap.dedent(code) + END
    done = subprocess.run(
        [sys.executable, "-c", text, robot.address],
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stderr[-2000:] + done.stdout[-500:]
    told = {}
    for line in done.stdout.splitlines():
        if line.startswith("{"):
            told |= json.loads(line)
    return told


def tcp_of(joint_angles, T_flange_tcp=T_FLANGE_TCP):
    return link_frames(joint_angles)[6] @ T_flange_tcp


def matrix(vector):
    return pose(exp_so3(vector[3:]), vector[:3])


def away(T_a, T_b):
    """Distance [m] and angle [rad] between poses."""
    return (
        float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])),
        float(np.linalg.norm(log_so3(T_a[:3, :3].T @ T_b[:3, :3]))),
    )


def test_receiver_sees_the_robot_as_it_is(robot):
    robot.command({"set": "wrench", "value": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]})
    told = run(
        robot,
        """
        time.sleep(0.05)
        tell(q=receive.getActualQ(), pose=receive.getActualTCPPose(),
             force=receive.getActualTCPForce(), mode=receive.getRobotMode(),
             safety=receive.getSafetyMode(), bits=receive.getSafetyStatusBits(),
             runtime=receive.getRuntimeState(), connected=receive.isConnected(),
             stopped=[receive.isProtectiveStopped(), receive.isEmergencyStopped()])
        """,
        control=False,
    )
    assert told["q"] == HOME
    assert away(matrix(told["pose"]), tcp_of(HOME)) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert told["force"] == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    assert (told["mode"], told["safety"], told["bits"], told["runtime"]) == (7, 1, 1, 1)
    assert told["connected"]
    assert told["stopped"] == [False, False]


def test_move_j_reaches_its_joints_and_they_the_pose_that_is_reported(robot):
    target = np.add(HOME, [0.2, -0.1, 0.15, -0.2, 0.1, 0.3]).tolist()
    told = run(
        robot,
        f"""
        tell(moved=control.moveJ({target}, 1.0, 2.0))
        at({target})
        tell(q=receive.getActualQ(), pose=receive.getActualTCPPose(),
             waypoint=control.getTargetWaypoint(), steady=control.isSteady())
        """,
    )
    assert told["moved"]
    assert told["steady"]
    np.testing.assert_allclose(told["q"], target, atol=1e-9)
    assert away(matrix(told["pose"]), tcp_of(target)) == pytest.approx((0.0, 0.0), abs=1e-9)
    np.testing.assert_allclose(told["waypoint"], told["pose"], atol=1e-9)


@pytest.mark.slow
def test_move_l_and_move_j_ik_reach_the_pose_asked_for(robot):
    told = run(
        robot,
        """
        goal = receive.getActualTCPPose()
        goal[0] += 0.03; goal[2] += 0.05
        moved = control.moveL(goal, 0.2, 0.5)
        time.sleep(0.2)
        tell(goal=goal, moved=moved, line=receive.getActualTCPPose())
        goal[1] -= 0.04
        moved = control.moveJ_IK(goal, 0.5, 1.0)
        time.sleep(0.2)
        tell(second=goal, again=moved, arc=receive.getActualTCPPose(), q=receive.getActualQ())
        """,
    )
    assert told["moved"]
    assert told["again"]
    assert away(matrix(told["line"]), matrix(told["goal"])) == pytest.approx((0, 0), abs=1e-7)
    assert away(matrix(told["arc"]), matrix(told["second"])) == pytest.approx((0, 0), abs=1e-7)
    assert away(tcp_of(told["q"]), matrix(told["second"])) == pytest.approx((0, 0), abs=1e-7)


@pytest.mark.slow
def test_asynchronous_move_returns_at_once_reports_progress_and_can_be_stopped(robot):
    told = run(
        robot,
        """
        target = [home[0] + 1.0] + home[1:]
        start = time.monotonic()
        control.moveJ(target, 0.5, 1.0, True)
        took = time.monotonic() - start
        wait(lambda: control.getAsyncOperationProgress() >= 0)
        running = control.getAsyncOperationProgress()
        time.sleep(0.3)
        control.stopJ(2.0)
        wait(lambda: not any(receive.getActualQd()))
        tell(took=took, running=running, speed=receive.getActualQd(), q=receive.getActualQ(),
             finished=control.getAsyncOperationProgress())
        """,
    )
    assert told["took"] < 1.0
    assert told["running"] >= 0
    assert told["finished"] < 0
    assert max(map(abs, told["speed"])) < 0.05
    assert HOME[0] + 0.02 < told["q"][0] < HOME[0] + 0.6


def test_servo_j_and_servo_l_arrive_and_hold_the_last_target(robot):
    told = run(
        robot,
        """
        target = [home[0] + 0.1] + home[1:]
        stream(lambda: control.servoJ(target, 0, 0, 0.002, 0.1, 300), 0.6)
        tell(q=receive.getActualQ())
        goal = receive.getActualTCPPose()
        goal[2] += 0.03
        stream(lambda: control.servoL(goal, 0, 0, 0.002, 0.1, 300), 0.6)
        time.sleep(0.3)
        tell(goal=goal, pose=receive.getActualTCPPose(), running=control.isProgramRunning())
        tell(stopped=control.servoStop())
        """,
    )
    np.testing.assert_allclose(told["q"], [HOME[0] + 0.1, *HOME[1:]], atol=1e-5)
    assert away(matrix(told["pose"]), matrix(told["goal"])) == pytest.approx((0, 0), abs=1e-5)
    assert told["running"]
    assert told["stopped"]


def test_speed_l_integrates_to_way_and_speed_j_to_angle(robot):
    told = run(
        robot,
        """
        def sample():
            while True:
                stamp = receive.getTimestamp()
                values = stamp, receive.getActualQ(), receive.getActualTCPPose()
                if stamp == receive.getTimestamp():
                    return values
        def window(command):
            command()
            time.sleep(0.5)  # past the ramp
            t0, q0, p0 = sample()
            time.sleep(0.5)
            t1, q1, p1 = sample()
            speed = receive.getActualTCPSpeed()
            control.speedStop()
            return dict(t=t1 - t0, q=(np.array(q1) - q0).tolist(),
                        p=(np.array(p1) - p0).tolist(), speed=speed)
        tell(tool=window(lambda: control.speedL([0.0, 0.02, 0.04, 0, 0, 0], 0.5)))
        control.moveJ(home)
        tell(joints=window(lambda: control.speedJ([0.1, 0.0, 0.0, 0.0, -0.1, 0.2], 1.0)))
        """,
    )
    tool, joints = told["tool"], told["joints"]
    np.testing.assert_allclose(tool["speed"], [0, 0.02, 0.04, 0, 0, 0], atol=1e-4)
    np.testing.assert_allclose(
        np.array(tool["p"][:3]) / tool["t"], [0.0, 0.02, 0.04], rtol=0.01, atol=3e-4
    )
    np.testing.assert_allclose(
        np.array(joints["q"]) / joints["t"], [0.1, 0, 0, 0, -0.1, 0.2], rtol=0.01, atol=1e-9
    )


@pytest.mark.slow
def test_speed_stop_takes_the_distance_of_its_deceleration(robot):
    told = run(
        robot,
        """
        control.speedL([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], 1.0)
        time.sleep(0.4)
        import threading
        z = []
        done = threading.Event()
        def watch():
            while not done.is_set():
                z.append((receive.getActualTCPSpeed()[2], receive.getActualTCPPose()[2]))
                time.sleep(0.0005)
        threading.Thread(target=watch).start()
        time.sleep(0.05)
        control.speedStop(0.5)
        time.sleep(0.05); done.set()
        last_at_speed = max(i for i, (speed, _) in enumerate(z) if speed > 0.0999)
        tell(way=z[-1][1] - z[last_at_speed][1], end=z[-1][0])
        """,
    )
    assert told["end"] == 0.0
    assert told["way"] == pytest.approx(0.1**2 / (2 * 0.5), abs=1.5e-3)


@pytest.mark.slow
def test_path_of_two_moves_ends_at_its_last_pose(robot):
    told = run(
        robot,
        """
        first = receive.getActualTCPPose()
        first[2] += 0.03
        last = list(first)
        last[0] += 0.03
        path = rtde_control.Path()
        kind = rtde_control.PathEntry
        path.addEntry(kind(kind.MoveJ, kind.PositionTcpPose, first + [0.5, 1.0, 0.0]))
        path.addEntry(kind(kind.MoveL, kind.PositionTcpPose, last + [0.2, 0.5, 0.0]))
        tell(moved=control.movePath(path, False))
        time.sleep(0.2)
        tell(last=last, pose=receive.getActualTCPPose())
        """,
    )
    assert told["moved"]
    # The client writes the path's numbers into the program with six digits.
    assert away(matrix(told["pose"]), matrix(told["last"])) == pytest.approx((0, 0), abs=2e-5)


def test_kinematics_answer_as_the_arms_do(robot):
    offset = [0.01, 0.02, 0.1, 0.0, 0.3, 0.0]
    far = [1.5, 0.0, 0.3, 0.0, 3.0, 0.0]
    told = run(
        robot,
        f"""
        q = [home[0] + 0.1, *home[1:4], home[4] + 0.2, home[5]]
        forward = control.getForwardKinematics(q, {offset})
        tell(q=q, forward=forward, here=control.getForwardKinematics())
        tell(set=control.setTcp({offset}), tcp=control.getTCPOffset())
        tell(inverse=control.getInverseKinematics(forward),
             near=control.getInverseKinematics(forward, q),
             solution=[control.getInverseKinematicsHasSolution(forward),
                       control.getInverseKinematicsHasSolution({far})],
             safe_pose=[control.isPoseWithinSafetyLimits(forward),
                        control.isPoseWithinSafetyLimits({far})],
             safe_joints=[control.isJointsWithinSafetyLimits(home),
                          control.isJointsWithinSafetyLimits([6.4, 0, 0, 0, 0, 0])],
             product=control.poseTrans([1, 2, 3, 0, 0, np.pi / 2], [1, 0, 0, 0, 0, 0]))
        control.setTcp([0.0, 0.0, 0.163, 0.0, 0.0, 0.0])
        """,
    )
    assert away(matrix(told["forward"]), tcp_of(told["q"], matrix(offset))) == pytest.approx(
        (0.0, 0.0), abs=1e-9
    )
    assert away(matrix(told["here"]), tcp_of(HOME)) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert told["set"]
    assert told["tcp"] == offset
    np.testing.assert_allclose(told["inverse"], told["q"], atol=1e-6)
    np.testing.assert_allclose(told["near"], told["q"], atol=1e-9)
    assert told["solution"] == [True, False]
    assert told["safe_pose"] == [True, False]
    assert told["safe_joints"] == [True, False]
    np.testing.assert_allclose(told["product"], [1, 3, 3, 0, 0, np.pi / 2], atol=1e-12)


@pytest.mark.slow
def test_tool_centre_point_moves_what_is_reported_but_not_the_arm(robot):
    told = run(
        robot,
        """
        control.setTcp([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
        time.sleep(0.05)
        tell(pose=receive.getActualTCPPose(), q=receive.getActualQ())
        control.setTcp([0.0, 0.0, 0.163, 0.0, 0.0, 0.0])
        """,
    )
    assert told["q"] == HOME
    longer = pose(np.eye(3), [0.0, 0.0, 0.3])
    assert away(matrix(told["pose"]), tcp_of(HOME, longer)) == pytest.approx((0, 0), abs=1e-9)


@pytest.mark.slow
def test_payload_and_force_zero_are_taken(robot):
    robot.command({"set": "wrench", "value": [5.0, 0.0, -3.0, 0.0, 0.0, 0.0]})
    told = run(
        robot,
        """
        control.setPayload(1.5, [0.0, 0.01, 0.05])
        control.zeroFtSensor()
        time.sleep(0.05)
        tell(payload=receive.getPayload(), cog=receive.getPayloadCog(),
             zeroed=receive.getActualTCPForce())
        """,
    )
    assert told["payload"] == 1.5
    assert told["cog"] == [0.0, 0.01, 0.05]
    assert told["zeroed"] == [0.0] * 6
    robot.command({"set": "wrench", "value": [0.0] * 6})
    run(robot, "control.zeroFtSensor()")


@pytest.mark.slow
def test_digital_and_analog_outputs_by_the_io_client(robot):
    told = run(
        robot,
        """
        io = rtde_io.RTDEIOInterface(address)
        io.setStandardDigitalOut(2, True); io.setConfigurableDigitalOut(1, True)
        io.setToolDigitalOut(0, True); io.setAnalogOutputVoltage(1, 0.25)
        wait(lambda: receive.getDigitalOutState(16))
        wait(lambda: receive.getStandardAnalogOutput1() > 0)
        tell(bits=receive.getActualDigitalOutputBits(), volts=receive.getStandardAnalogOutput1())
        io.setStandardDigitalOut(2, False); io.setConfigurableDigitalOut(1, False)
        io.setToolDigitalOut(0, False)
        tell(off=wait(lambda: receive.getActualDigitalOutputBits() == 0))
        """,
        control=False,
    )
    assert told["bits"] == 1 << 2 | 1 << 9 | 1 << 16
    assert told["volts"] == 0.25
    assert told["off"]


def test_watchdog_stops_program_and_arm_when_the_client_falls_silent(robot):
    told = run(
        robot,
        """
        control.setWatchdog(10.0)
        control.speedJ([0.2, 0, 0, 0, 0, 0], 1.0)
        for _ in range(20):
            control.kickWatchdog(); control.speedJ([0.2, 0, 0, 0, 0, 0], 1.0)
            time.sleep(0.02)
        tell(alive=control.isProgramRunning(), speed=receive.getActualQd()[0])
        stopped = wait(lambda: receive.getRuntimeState() == 1)
        still = wait(lambda: not any(receive.getActualQd()))
        tell(stopped=stopped, still=still)
        """,
    )
    assert told["alive"]
    assert told["speed"] == pytest.approx(0.2)
    assert told["stopped"]
    assert told["still"]


def test_killed_client_without_watchdog_leaves_the_last_speed_running(robot):
    """As on the robot: its program runs on, with the registers as they were written last."""
    run(robot, "control.speedJ([0.02, 0, 0, 0, 0, 0], 1.0)\ntime.sleep(0.2)")  # ends by _exit
    time.sleep(0.2)
    state = robot.state()
    assert state["program"]
    assert state["joint_velocities"][0] == pytest.approx(0.02)


def test_protective_stop_pauses_unlocks_after_its_delay_and_resumes_the_old_motion(robot):
    told = run(
        robot,
        """
        dashboard = dashboard_client.DashboardClient(address); dashboard.connect()
        target = [home[0] + 0.5] + home[1:]
        control.moveJ(target, 0.5, 1.0, True)
        time.sleep(0.3)
        control.triggerProtectiveStop()
        tell(stopped=wait(receive.isProtectiveStopped), state=dashboard.programState(),
             status=dashboard.safetystatus(), mode=receive.getSafetyMode())
        tell(still=wait(lambda: not any(receive.getActualQd())), servo=control.moveJ(home))
        refused = ""
        try:
            dashboard.unlockProtectiveStop()
        except RuntimeError as error:
            refused = str(error)
        time.sleep(0.4)
        tell(refused=refused, before=receive.getActualQ())
        dashboard.unlockProtectiveStop()
        tell(unlocked=wait(lambda: not receive.isProtectiveStopped()))
        time.sleep(0.1)
        tell(paused=receive.getRuntimeState(), held=receive.getActualQ())
        dashboard.play()
        tell(resumed=wait(lambda: abs(receive.getActualQ()[0] - target[0]) < 1e-9, 5.0))
        """,
    )
    assert told["stopped"]
    assert told["still"]
    assert not told["servo"]
    assert "PAUSED" in told["state"]
    assert "PROTECTIVE_STOP" in told["status"]
    assert told["mode"] == 3
    assert "Cannot unlock" in told["refused"]
    assert told["unlocked"]
    assert told["paused"] == 4
    assert told["held"] == told["before"]
    assert told["before"][0] < HOME[0] + 0.4
    assert told["resumed"]


@pytest.mark.slow
def test_stopping_and_uploading_again_after_an_unlock_forgets_the_old_motion(robot):
    told = run(
        robot,
        """
        dashboard = dashboard_client.DashboardClient(address); dashboard.connect()
        control.moveJ([home[0] + 0.5] + home[1:], 0.5, 1.0, True)
        time.sleep(0.3)
        control.triggerProtectiveStop()
        wait(receive.isProtectiveStopped)
        time.sleep(0.5)
        dashboard.unlockProtectiveStop()
        dashboard.stop()
        time.sleep(0.1)
        before = receive.getActualQ()
        control.reuploadScript()
        tell(running=wait(control.isProgramRunning))
        time.sleep(0.3)
        tell(before=before, after=receive.getActualQ(), moved=control.moveJ(home, 1.0, 2.0))
        tell(home=at(home))
        """,
    )
    assert told["running"]
    assert told["after"] == told["before"]
    assert told["moved"]
    assert told["home"]


@pytest.mark.parametrize(
    "command",
    [
        "control.servoL([1.5, 0.0, 0.3, 0.0, 3.0, 0.0], 0, 0, 0.002, 0.1, 300)",
        pytest.param(
            "control.servoJ([home[0] + 1.5] + home[1:], 0, 0, 0.002, 0.1, 300)",
            marks=pytest.mark.slow,
        ),
        pytest.param("control.speedL([0.8, 0.0, 0.0, 0.0, 0.0, 0.0], 2.0)", marks=pytest.mark.slow),
    ],
)
def test_impossible_motion_is_a_protective_stop(robot, command):
    told = run(
        robot,
        f"""
        {command}
        tell(stopped=wait(receive.isProtectiveStopped), still=wait(
            lambda: not any(receive.getActualQd())), bits=receive.getSafetyStatusBits())
        """,
    )
    assert told["stopped"]
    assert told["still"]
    assert told["bits"] == 1 << 2 | 1 << 10
    assert robot.state()["stop_reason"]
    time.sleep(0.35)
    unlock(robot)


def test_force_above_its_limit_is_a_protective_stop(robot):
    robot.command({"set": "wrench", "value": [0.0, 0.0, 160.0, 0.0, 0.0, 0.0]})
    time.sleep(0.05)
    assert robot.state()["safety"] == "protective_stop"
    robot.command({"set": "wrench", "value": [0.0] * 6})
    time.sleep(0.35)
    unlock(robot)


@pytest.mark.slow
def test_emergency_stop_ends_the_program_and_takes_the_power_until_it_is_given_back(robot):
    run(robot, "control.speedJ([0.1, 0, 0, 0, 0, 0], 1.0)\ntime.sleep(0.1)")
    robot.fault("emergency_stop")
    told = run(
        robot,
        """
        time.sleep(0.5)
        tell(stopped=receive.isEmergencyStopped(), mode=receive.getRobotMode(),
             runtime=receive.getRuntimeState(), speed=receive.getActualQd(),
             bits=receive.getSafetyStatusBits(), status=receive.getRobotStatus())
        """,
        control=False,
    )
    assert told["stopped"]
    assert (told["mode"], told["runtime"], told["status"]) == (3, 1, 0)
    assert told["speed"] == [0.0] * 6
    assert told["bits"] == 1 << 6 | 1 << 7 | 1 << 10
    robot.fault("release_emergency_stop")
    told = run(
        robot,
        """
        dashboard = dashboard_client.DashboardClient(address); dashboard.connect()
        off = receive.getRobotMode()
        dashboard.powerOn()
        idle = wait(lambda: receive.getRobotMode() == 5)
        dashboard.brakeRelease()
        tell(off=off, idle=idle, running=wait(lambda: receive.getRobotMode() == 7),
             normal=receive.getSafetyMode())
        control = rtde_control.RTDEControlInterface(address)
        tell(moved=control.moveJ(home))
        """,
        control=False,
    )
    assert told["off"] == 3
    assert told["idle"]
    assert told["running"]
    assert told["normal"] == 1
    assert told["moved"]


@pytest.mark.slow
def test_stopped_script_is_seen_and_a_second_client_can_take_over(robot):
    told = run(
        robot,
        """
        tell(running=control.isProgramRunning(), connected=control.isConnected())
        control.stopScript()
        tell(stopped=wait(lambda: not control.isProgramRunning()))
        """,
    )
    assert told["running"]
    assert told["connected"]
    assert told["stopped"]
    assert run(robot, "tell(moved=control.moveJ(home, 1.0, 1.0))")["moved"]


@pytest.mark.slow
def test_upper_range_registers_work_too(robot):
    told = run(
        robot,
        """
        flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        upper = rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        control = rtde_control.RTDEControlInterface(address, 500.0, int(flags) | int(upper))
        target = [home[0] + 0.05] + home[1:]
        tell(moved=control.moveJ(target, 1.0, 1.0), there=at(target))
        """,
        control=False,
    )
    assert told["moved"]
    assert told["there"]


def unlock(robot):
    """Release a protective stop by the dashboard."""
    with socket.create_connection((robot.address, 29999), 5) as link:
        lines = link.makefile("rw")
        lines.readline()
        lines.write("unlock protective stop\nstop\n")
        lines.flush()
        assert "releasing" in lines.readline()
        lines.readline()
