import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.se3 import exp_so3, inverse, log_so3, pose, transform_points
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.scene.arms import SIDES, T_CLAMP_TCP, DualArm
from dlo_gym.scene.builder import default_cameras
from dlo_gym.scene.renderer import SceneRenderer
from dlo_gym.scene.ur5e import link_frames
from sim2real.calibration.board import BoardSpec
from sim2real.calibration.plan import nominal_mount
from sim2real.cameras.camera import CameraSettings
from sim2real.cameras.mjpeg_camera import MjpegCamera
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.drawing import encode
from sim2real.emulator.emulated_world import EmulatedWorld
from sim2real.emulator.held_rod import LOST_FORCE, HeldRod
from sim2real.emulator.world_config import WorldConfig
from tests.sim2real.fake_controller import FakeController, free_address

ARMS = DualArm()
ROD = RodProperties(length=0.5)
BOARD = BoardSpec()
BIG_SQUARES = BoardSpec(4, 3, 0.06, 0.045)  # that the small pictures of these tests resolve


def wait_until(condition, timeout=10.0):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.02)


def boundary(distance, *, shift=(0.0, 0.0, 0.0), turn=0.0):
    """Clamps along x, ``distance`` apart, as far from the base as at home."""
    R = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    middle = np.array([0.0, 0.0, 0.34]) + shift
    half = np.array([distance / 2, 0.0, 0.0])
    return BoundaryPoses(pose(R, middle - half), pose(exp_so3([turn, 0, 0]) @ R, middle + half))


def test_held_rod_hangs_in_equilibrium_and_follows():
    rod = HeldRod(ROD)
    weight = ROD.linear_density * ROD.length * 9.81
    for k in range(20):
        shape = rod.follow(boundary(0.4, shift=(0.002 * k, 0.0, 0.0)))
        assert shape.problem == ""
        # both clamps together carry the rod's weight, nothing else acts on it
        np.testing.assert_allclose(shape.wrenches[:, :3].sum(axis=0), [0.0, 0.0, weight], atol=1e-5)
        np.testing.assert_allclose(shape.positions[0], shape.boundary.left[:3, 3], atol=1e-12)


def test_held_rod_goes_anywhere_in_one_call_as_in_many():
    start, end = boundary(0.4), boundary(0.3, shift=(0.02, 0.03, 0.01), turn=0.4)
    jumping, walking = HeldRod(ROD), HeldRod(ROD)
    jumping.follow(start)
    walking.follow(start)
    move = start.displacement_to(end)
    for k in range(1, 51):
        walked = walking.follow(start.displaced(move.scaled(k / 50)))
    np.testing.assert_allclose(jumping.follow(end).positions, walked.positions, atol=1e-5)


def test_overstretch_pulls_the_clamps_apart_and_grows_strongly():
    rod = HeldRod(ROD, overstretch_stiffness=2000.0)
    rod.follow(boundary(0.49))
    forces = []
    for beyond in (0.001, 0.005, 0.01, 0.02):
        shape = rod.follow(boundary(0.5 + beyond))
        assert "overstretched" in shape.problem
        np.testing.assert_allclose(shape.positions[-1], shape.boundary.right[:3, 3], atol=1e-12)
        assert shape.wrenches[0, 0] < 0.0 < shape.wrenches[1, 0]
        forces.append(shape.wrenches[1, 0])
    np.testing.assert_allclose(np.diff(forces), [8.0, 10.0, 20.0], atol=1e-6)
    assert forces[-1] > 40.0
    # and all is well again when the arms give way
    back = rod.follow(boundary(0.45))
    assert back.problem == ""
    assert abs(back.wrenches[1, 0]) < 1.0
    np.testing.assert_allclose(
        back.positions, HeldRod(ROD).follow(boundary(0.45)).positions, atol=1e-5
    )


def test_rod_without_equilibrium_pulls_hard(monkeypatch):
    from dlo_gym.exceptions import RodDiverged

    rod = HeldRod(ROD)
    rod.follow(boundary(0.4))

    def fail(*_):
        raise RodDiverged("on purpose")

    with monkeypatch.context() as patch:
        patch.setattr(rod.rod, "move", fail)
        patch.setattr(rod.rod, "settle", fail)
        shape = rod.follow(boundary(0.41))
        assert "on purpose" in shape.problem
        assert shape.wrenches[1, 0] > LOST_FORCE
        np.testing.assert_allclose(shape.positions[0], shape.boundary.left[:3, 3])
    assert rod.follow(boundary(0.411)).problem == ""


def test_first_poses_may_be_out_of_reach():
    shape = HeldRod(ROD).follow(boundary(0.6))
    assert shape.problem
    np.testing.assert_allclose(np.diff(shape.positions, axis=0)[:, 0], 0.6 / 50)


def test_config_survives_its_json():
    config = WorldConfig(
        rod=RodProperties(0.4, np.full(20, 0.004), 2e6),
        n_elements=20,
        controllers=("127.0.1.2", "127.0.1.3"),
        latency={"top": 0.1},
        n_occluders=2,
        seed=3,
        board="right",
        board_spec=BoardSpec(5, 4, 0.05, 0.037),
        T_tcp_board=pose(exp_so3([0.1, 0.2, 0.3]), [0.01, 0.02, 0.03]),
    )
    again = WorldConfig.from_json(config.to_json())
    assert again.to_json() == config.to_json()
    np.testing.assert_array_equal(again.rod.radius, config.rod.radius)
    np.testing.assert_array_equal(again.dual_arm.T_world_base, config.dual_arm.T_world_base)
    np.testing.assert_array_equal(again.cameras[1].K, config.cameras[1].K)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"address": "0.0.0.0"}, "address: .*127.0.0.0/8"),
        ({"controllers": ["127.0.0.2", "192.168.0.3"]}, "controllers right"),
        ({"controllers": ["127.0.0.2", "127.0.0.2"]}, "controllers"),
        ({"port": 70000}, "port"),
        ({"rate": 0}, "rate"),
        ({"drawing_share": 1.5}, "drawing_share"),
        ({"latency": {"bottom": 0.1}}, "bottom"),
        ({"latency": {"side": -1}}, "latency side"),
        ({"rod": {"length": -1}}, "length"),
        ({"rod": {"size": 1}}, "size"),
        ({"colour": "red"}, "colour"),
        ({"board": "middle"}, "board: .*'middle'"),
        ({"T_tcp_board": np.ones((4, 4)).tolist()}, "T_tcp_board"),
        ({"board_spec": {"squares_x": 1}}, "squares_x"),
        ([], "object"),
    ],
)
def test_wrong_config_is_named(wrong, said):
    with pytest.raises(ValueError, match=said):
        WorldConfig.from_json(json.dumps(wrong))


def test_config_of_a_cell_file():
    cell = CellConfig.load(TEMPLATES / "emulated.toml")
    config = WorldConfig.of_cell(cell, rate=10.0)
    assert (config.url, config.rate) == ("http://127.0.0.4:8080", 10.0)
    assert config.controllers == ("127.0.0.2", "127.0.0.3")
    assert [camera.name for camera in config.cameras] == ["side", "top"]
    assert config.rod.length == cell.rod.length_m
    assert config.n_elements + 1 == cell.tracker.n_nodes


def test_a_board_is_gripped_a_little_off_and_in_each_gripper_differently():
    config = WorldConfig(board="left")
    left, right = (inverse(nominal_mount(BOARD)) @ config.board_mount(side) for side in SIDES)
    for off in (left, right):
        assert 1e-4 < np.linalg.norm(off[:3, 3]) < 0.01
        assert 1e-3 < np.linalg.norm(log_so3(off[:3, :3])) < 0.2
    assert np.abs(left - right).max() > 1e-4
    given = pose(np.eye(3), [0.0, 0.0, 0.05])
    np.testing.assert_array_equal(WorldConfig(T_tcp_board=given).board_mount("left"), given)
    plate = config.scene.boards[0]
    assert (plate.side, plate.size) == ("left", BOARD.size_m)
    assert config.scene.n_nodes == 0
    assert config.carrying(None).scene.n_nodes == 51
    assert config.carrying(None).scene.boards == ()


class Arms:
    """Two fake controllers."""

    def __init__(self, first):
        self.fakes = [
            FakeController(free_address(first + side), ARMS.home[side].tolist()) for side in (0, 1)
        ]

    @property
    def addresses(self):
        return tuple(fake.address for fake in self.fakes)

    def go(self, clamps):
        for fake, angles in zip(self.fakes, ARMS.inverse_kinematics(clamps), strict=True):
            fake.joint_angles = angles.tolist()

    def close(self):
        for fake in self.fakes:
            fake.close()


@pytest.fixture(scope="module")
def arms():
    arms = Arms(31)
    yield arms
    arms.close()


@pytest.fixture(scope="module")
def world(arms):
    config = WorldConfig(
        controllers=arms.addresses,
        address=free_address(33),
        port=0,
        drawing_share=1.0,
        board_spec=BIG_SQUARES,
    )
    with EmulatedWorld(config) as world:
        wait_until(lambda: all(c["connected"] for c in world.status()["controllers"].values()))
        yield world


def truth_when(world, condition):
    wait_until(lambda: _drawn(world) and condition(world.truth()))
    return world.truth()


def _drawn(world):
    return world.status()["sets_drawn"] > 0


def test_truth_and_pictures_show_the_arms_and_the_rod(world, arms):
    arms.go(boundary(0.42))
    angles = ARMS.inverse_kinematics(boundary(0.42))
    truth = truth_when(world, lambda truth: np.abs(truth.joint_angles - angles).max() < 1e-6)
    assert truth.boundary.distance == pytest.approx(0.42, abs=1e-6)
    expected = HeldRod(ROD).follow(ARMS.forward_kinematics(angles))
    np.testing.assert_allclose(truth.centerline, expected.positions, atol=2e-5)
    with SceneRenderer(world.config.scene) as renderer:
        renderer.update(truth.centerline, truth.boundary, joint_angles=angles)
        for camera in world.config.cameras:
            np.testing.assert_array_equal(
                truth.visible[camera.name], renderer.visibility(camera.name)
            )
            assert truth.visible[camera.name].mean() > 0.7
            image = renderer.render(camera.name).image
            mask = renderer.rod_mask(camera.name)
            shown = cv2.imdecode(np.frombuffer(world.picture(camera.name), np.uint8), 1)
            shown = cv2.cvtColor(shown, cv2.COLOR_BGR2RGB).astype(int)
            assert np.abs(shown - image).mean() < 2.0
            # the thin rod keeps its colour through the JPEG
            assert np.abs(shown[mask] - image[mask]).mean() < 8.0


def test_each_controller_is_told_the_force_on_its_gripper(world, arms):
    clamps = boundary(0.4, shift=(0.0, 0.02, 0.01), turn=0.3)
    arms.go(clamps)
    rod = HeldRod(ROD).follow(clamps)
    truth_when(world, lambda truth: np.abs(truth.boundary.right - clamps.right).max() < 1e-6)
    time.sleep(0.3)
    for side, fake in enumerate(arms.fakes):
        wrench = np.array(fake.wrench)
        R_world_base = ARMS.T_world_base[side, :3, :3]
        force, torque = R_world_base @ wrench[:3], R_world_base @ wrench[3:]
        # what the gripper feels is the opposite of what it does to the rod
        np.testing.assert_allclose(force, -rod.wrenches[side, :3], atol=1e-4)
        np.testing.assert_allclose(torque, -rod.wrenches[side, 3:], atol=1e-4)
        assert force[2] < 0.0  # the rod's weight hangs on it
    # the origin of the wrench: the TCP is where the clamp is
    frames = link_frames(ARMS.inverse_kinematics(clamps))[:, 6]
    tcp = ARMS.T_world_base @ frames @ ARMS.T_flange_tcp
    np.testing.assert_allclose(tcp[0], clamps.left @ T_CLAMP_TCP[0], atol=1e-9)


def test_overstretch_reaches_both_controllers(world, arms):
    arms.go(boundary(0.52))
    wait_until(lambda: arms.fakes[0].wrench and arms.fakes[0].wrench[0] > 35.0)
    left, right = (
        ARMS.T_world_base[side, :3, :3] @ np.array(fake.wrench[:3])
        for side, fake in enumerate(arms.fakes)
    )
    assert left[0] > 35.0  # the left gripper is pulled to the right
    assert right[0] < -35.0
    assert "overstretched" in world.status()["rod"]["problem"]
    assert "overstretched" in truth_when(world, lambda truth: truth.problem).problem
    arms.go(boundary(0.4))
    wait_until(lambda: abs(arms.fakes[0].wrench[0]) < 1.0)


def test_a_board_takes_the_rods_place_and_gives_it_back(world, arms):
    arms.go(boundary(0.4))
    for index, side in enumerate(SIDES):
        world.carry(side)
        truth = truth_when(world, lambda truth, side=side: truth.board == side)
        assert truth.centerline.shape == (0, 3)
        assert {seen.shape for seen in truth.visible.values()} == {(0,)}
        assert not truth.wrenches.any()
        assert world.status()["board"] == side
        wait_until(lambda: all(fake.wrench == [0.0] * 6 for fake in arms.fakes))
        # The corners are seen where the mount and the arm's kinematics say.
        clamp = (truth.boundary.left, truth.boundary.right)[index]
        T_world_board = clamp @ T_CLAMP_TCP[index] @ world.config.board_mount(side)
        camera = world.config.cameras[1]
        picture = cv2.imdecode(np.frombuffer(world.picture(camera.name), np.uint8), 1)
        found = BIG_SQUARES.detect(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
        assert len(found) == BIG_SQUARES.n_corners
        expected = camera.project(transform_points(T_world_board, BIG_SQUARES.corners))
        assert np.abs(found.corners - expected[found.ids]).max() < 0.5
    world.carry(None)
    truth = truth_when(world, lambda truth: truth.board is None)
    np.testing.assert_allclose(
        truth.centerline, HeldRod(ROD).follow(truth.boundary).positions, atol=2e-5
    )
    for wrong in ({}, {"side": "middle"}, {"side": []}, "left"):
        with pytest.raises(ValueError, match="left"):
            world._json("POST", "/board", wrong)


def test_pictures_and_truth_share_stamps_of_the_angles_drawn(world, arms):
    arms.go(boundary(0.4))
    home = [list(fake.joint_angles) for fake in arms.fakes]
    begin = time.monotonic()

    def swing(side):
        return lambda t: [
            home[side][0] + 0.02 * np.sin(3.0 * (t - arms.fakes[0].clock_ahead - begin)),
            *home[side][1:],
        ]

    for side, fake in enumerate(arms.fakes):
        fake.joint_angles = swing(side)
    time.sleep(1.5)
    for fake, angles in zip(arms.fakes, home, strict=True):
        fake.joint_angles = angles
    truths = [t for t in world.truths(begin + 0.3) if t.stamp < begin + 1.4]
    assert len(truths) > 5
    for truth in truths:
        expected = 0.02 * np.sin(3.0 * (truth.stamp - begin))
        for side in (0, 1):
            # 10 ms of error in the stamp would be 6e-4 rad
            off = truth.joint_angles[side, 0] - home[side][0] - expected
            assert abs(off) < 4e-4
    assert world.truth(truths[3].stamp).stamp == truths[3].stamp


def test_frozen_rtde_is_bridged_by_the_control_port(world, arms):
    arms.go(boundary(0.4))
    time.sleep(0.3)
    try:
        for fake in arms.fakes:
            fake.frozen = True
        time.sleep(0.2)
        arms.go(boundary(0.43))
        truth_when(world, lambda truth: abs(truth.boundary.distance - 0.43) < 1e-6)
    finally:
        for fake in arms.fakes:
            fake.frozen = False


def test_world_stands_still_while_a_controller_is_gone_and_cameras_go_on(world, arms):
    arms.go(boundary(0.4))
    truth_when(world, lambda truth: abs(truth.boundary.distance - 0.4) < 1e-6)
    right = arms.fakes[1]
    right.close()
    try:
        time.sleep(0.6)
        before = world.truth()
        time.sleep(0.4)
        after = world.truth()
        assert after.stamp > before.stamp + 0.2
        assert time.monotonic() - after.stamp < 0.5
        np.testing.assert_array_equal(after.centerline, before.centerline)
    finally:
        right.serve()
    arms.go(boundary(0.41))
    truth_when(world, lambda truth: abs(truth.boundary.distance - 0.41) < 1e-6)


def test_camera_faults_over_http(world):
    def fresh(camera):
        """Whether the camera's newest picture is newer than the world of just now."""
        stamp = world.status()["stamp"]
        time.sleep(0.4)
        return any(t.stamp > stamp for t in world.truths(stamp)) and bool(world.picture(camera))

    assert fresh("side")
    world.fault("side", drop=5.0)
    with pytest.raises(DeviceError, match="gone"):
        world.picture("side")
    assert world.picture("top")
    world.fault("side", clear=True)
    wait_until(lambda: world.status()["cameras"]["side"]["dropped_s"] == 0.0)
    assert world.fault("side", latency=0.25)["latency_s"] == 0.25
    world.fault("side", latency=0.0)
    for wrong in ({"camera": "bottom", "drop": 1}, {"camera": "side", "explode": 1}, [], 3):
        with pytest.raises(ValueError, match="expected|unknown"):
            world._json("POST", "/fault", wrong)
    with pytest.raises(ValueError, match="freeze"):
        world.fault("side", freeze=-1.0)


def test_cameras_of_the_cell_open_the_streams(world, arms):
    arms.go(boundary(0.4))
    models = world.config.cameras
    cameras = [
        MjpegCamera(
            CameraSettings(
                driver="mjpeg", device=f"{world.url}/{model.name}", stamps="header", timeout=2.0
            ),
            model,
        )
        for model in models
    ]
    with cameras[0] as side, cameras[1] as top:
        time.sleep(0.5)
        frame = side.latest()
        assert frame.image.shape == (360, 640, 3)
        assert 0.0 < frame.arrival - frame.stamp < 1.0
        # all cameras of a set share its stamp, and the truth is known there
        shared = {f.stamp for f in side.frames(0.0)} & {f.stamp for f in top.frames(0.0)}
        assert shared
        assert world.truth(max(shared)).stamp == max(shared)


def test_page_shows_all_cameras(world):
    page = world._request("GET", "/").decode()
    assert '<img src="/side"' in page
    assert '<img src="/top"' in page


def test_wrong_truth_queries_are_refused(world):
    for query in ("since=abc", "since=nan", "since=inf"):
        with pytest.raises(ValueError, match="since"):
            world._request("GET", f"/truth?{query}")
    assert world._json("GET", "/truth?since=1e300")["history"] == []


def test_jpeg_keeps_the_colour_of_a_thin_line():
    image = np.full((40, 40, 3), 90, np.uint8)
    image[20:22] = (204, 33, 18)
    again = cv2.cvtColor(
        cv2.imdecode(np.frombuffer(encode(image), np.uint8), 1), cv2.COLOR_BGR2RGB
    ).astype(int)
    assert np.abs(again - image)[20:22].mean() < 6.0


@pytest.mark.slow
def test_taken_address_is_reported(world, arms):
    config = world.config.moved_to(world.config.address, int(world.url.rsplit(":")[-1]))
    with pytest.raises(DeviceError, match="ended with status"), open(os.devnull, "w") as log:
        EmulatedWorld(config, log=log).start()


def started(arms, **popen):
    config = WorldConfig(
        controllers=arms.addresses,
        address=free_address(34),
        port=0,
        cameras=default_cameras(1 / 12),
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "sim2real.emulator.world", "--config", "-"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        **popen,
    )
    process.stdin.write(config.to_json().encode())
    process.stdin.close()
    assert json.loads(process.stdout.readline())["pid"] == process.pid
    return process


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_ends_on_signals(arms, number):
    process = started(arms)
    process.send_signal(number)
    assert process.wait(5.0) == 0
    process.stdout.close()


def test_ends_with_its_parent(arms, tmp_path):
    config = WorldConfig(
        controllers=arms.addresses,
        address=free_address(35),
        port=0,
        cameras=default_cameras(1 / 12),
    )
    (tmp_path / "config.json").write_text(config.to_json())
    script = (
        "import pathlib, sys, time\n"
        "from sim2real.emulator.emulated_world import EmulatedWorld\n"
        "from sim2real.emulator.world_config import WorldConfig\n"
        "config = WorldConfig.from_json(pathlib.Path(sys.argv[1]).read_text())\n"
        "world = EmulatedWorld(config); world.start(); print(world.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "config.json")], stdout=subprocess.PIPE
    )
    pid = int(parent.stdout.readline())
    assert _runs(pid)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_until(lambda: not _runs(pid))


def _runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
