"""Planning and taking samples, with an arm and cameras that exist in this process only."""

import time
from dataclasses import replace

import numpy as np
import pytest

from control.monitor import ArmReading
from dlo_gym import cli
from dlo_gym.exceptions import DeviceError, DloError, UnreachablePose
from dlo_gym.geometry.se3 import inverse, log_so3, transform_points
from dlo_gym.scene.arms import SIDES
from dlo_gym.scene.ur5e import link_frames
from sim2real.calibration.collect import Stillness, collect, collect_by_hand
from sim2real.calibration.hand_eye import check_rotations
from sim2real.calibration.plan import (
    check_tour,
    load_plan,
    nominal_mount,
    plan_poses,
    save_plan,
)
from sim2real.calibration.samples import SampleFolder, SamplesError
from sim2real.cameras.camera import Frame
from tests.sim2real.calibration_data import ARMS, BOARD, cell_cameras, cell_file

CAMERAS = cell_cameras()
QUICK = Stillness(seconds=0.04, timeout=0.6)


@pytest.fixture(scope="module", params=SIDES)
def planned(request):
    rng = np.random.default_rng(1)
    return request.param, plan_poses(ARMS, list(CAMERAS.values()), request.param, BOARD, 16, rng)


def test_a_plan_is_reachable_as_it_says(planned):
    side, plan = planned
    assert len(plan) == 16
    index = SIDES.index(side)
    for stop in plan:
        T_base_tcp = link_frames(stop.joint_angles)[6] @ ARMS.T_flange_tcp[index]
        np.testing.assert_allclose(T_base_tcp, stop.T_base_tcp, atol=1e-9)


def test_every_planned_board_is_seen_from_in_front(planned):
    side, plan = planned
    counts = dict.fromkeys(CAMERAS, 0)
    for stop in plan:
        T_world_board = (
            ARMS.T_world_base[SIDES.index(side)] @ stop.T_base_tcp @ nominal_mount(BOARD)
        )
        assert stop.cameras
        for name in stop.cameras:
            counts[name] += 1
            camera = CAMERAS[name]
            corners = transform_points(T_world_board, BOARD.corners)
            assert camera.sees(camera.project(corners)).mean() > 0.7
            ray = corners.mean(axis=0) - camera.centre
            assert ray @ T_world_board[:3, 2] > 0.5 * np.linalg.norm(ray)
    assert min(counts.values()) >= 5


def test_planned_poses_turn_about_all_axes(planned):
    T = np.stack([stop.T_base_tcp for stop in planned[1]])
    check_rotations(T)
    i, j = np.triu_indices(len(T), 1)
    vectors = log_so3(T[j, :3, :3] @ np.swapaxes(T[i, :3, :3], 1, 2))
    assert np.sqrt(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))[0]) > np.radians(20)


def test_nothing_collides_on_the_way(planned):
    side, plan = planned
    index = SIDES.index(side)
    at, joints = ARMS.home[index], ARMS.home.copy()
    for stop in plan:
        for t in np.linspace(0.0, 1.0, 25):
            joints[index] = at + t * (stop.joint_angles - at)
            assert ARMS.clearance(joints).minimum > 0.0
            T_tcp = (
                ARMS.T_world_base[index] @ link_frames(joints[index])[6] @ ARMS.T_flange_tcp[index]
            )
            corners = transform_points(T_tcp @ nominal_mount(BOARD), BOARD.corners)
            assert corners[:, 2].min() > 0.05
        at = stop.joint_angles


def test_a_tour_that_starts_elsewhere_is_checked(planned):
    side, plan = planned
    index = SIDES.index(side)
    check_tour(ARMS, side, BOARD, plan, start=ARMS.home[index], parked=ARMS.home[1 - index])
    low = ARMS.home[index].copy()
    low[1] += 1.2 if side == "left" else -1.2  # the shoulder leans the board into the table
    bad = low if _below_table(side, low) else ARMS.home[index] + [0.0, -1.2, 0.0, 0.0, 0.0, 0.0]
    assert _below_table(side, bad)
    with pytest.raises(UnreachablePose, match="from where it is to stop 1"):
        check_tour(ARMS, side, BOARD, plan, start=bad, parked=ARMS.home[1 - index])


def _below_table(side, joint_angles):
    index = SIDES.index(side)
    T = ARMS.T_world_base[index] @ link_frames(joint_angles)[6] @ ARMS.T_flange_tcp[index]
    return transform_points(T @ nominal_mount(BOARD), BOARD.corners)[:, 2].min() < 0.0


def test_a_plan_survives_the_disk(planned, tmp_path):
    save_plan(tmp_path / "plan.json", planned[1])
    for stop, again in zip(planned[1], load_plan(tmp_path / "plan.json"), strict=True):
        np.testing.assert_array_equal(stop.joint_angles, again.joint_angles)
        assert stop.cameras == again.cameras
    (tmp_path / "plan.json").write_text("[{}]")
    with pytest.raises(DloError, match="plan.json: cannot be read"):
        load_plan(tmp_path / "plan.json")


def test_cameras_that_see_nothing_of_the_cell_are_refused():
    away = [
        replace(c, T_world_camera=c.T_world_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]))
        for c in CAMERAS.values()
    ]
    with pytest.raises(UnreachablePose, match="only 0 of 6 board poses"):
        plan_poses(ARMS, away, "left", BOARD, 6, np.random.default_rng(0))


class StandingArm:
    """Is at once where it is sent, but comes to rest only after ``settling`` seconds."""

    def __init__(self, name="left", settling=0.05):
        self.name, self.settling = name, settling
        self.joints, self.arrived = ARMS.home[SIDES.index(name)].copy(), time.monotonic()
        self.moves = []

    def move_to(self, target, speed):
        self.moves.append(np.array(target))
        self.joints, self.arrived = np.array(target), time.monotonic()

    def reading(self):
        now = time.monotonic()
        swing = 0.01 * max(0.0, self.arrived + self.settling - now)
        joints = self.joints + swing
        T = link_frames(joints)[6] @ ARMS.T_flange_tcp[SIDES.index(self.name)]
        speed = np.full(6, 0.01 if swing > 0 else 0.0)
        return ArmReading(now, now, joints, speed, T, np.zeros(6), np.zeros(6), "normal", True)


class SteadyCamera:
    """Gives a frame every 10 ms that says when it was taken."""

    def __init__(self, name, dead=False):
        self.model = replace(CAMERAS[name], width=64, height=48)
        self.latency, self.dead = 0.0, dead

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def latest(self):
        if self.dead:
            raise DeviceError(f"camera {self.model.name!r}: silent")
        return self.frames(time.monotonic() - 0.02)[-1]

    def frames(self, since):
        first = int(np.ceil((since + 1e-9) / 0.01))
        last = int(np.floor(time.monotonic() / 0.01))
        if self.dead:
            return []
        image = np.zeros((48, 64, 3), dtype=np.uint8)
        return [Frame(image, 0.01 * k, 0.01 * k, k) for k in range(first, last + 1)]


def new_folder(path):
    return SampleFolder.create(path / "samples", BOARD, dict.fromkeys(CAMERAS, (64, 48)))


def cameras(dead=None):
    return {name: SteadyCamera(name, dead=name == dead) for name in CAMERAS}


def test_samples_are_taken_at_rest_and_a_cut_off_collection_goes_on(planned, tmp_path):
    side, plan = planned
    plan = plan[:4]
    arm, folder = StandingArm(side), new_folder(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        collect(folder, arm, cameras(), plan, still=QUICK, on_sample=interrupt_after(2))
    assert len(arm.moves) == 2
    again = new_folder(tmp_path)
    progress = []
    added = collect(
        again, arm, cameras(), plan, still=QUICK, on_sample=lambda done, n: progress.append(done)
    )
    assert added == 2
    assert progress == [1, 2, 3, 4]
    np.testing.assert_array_equal(arm.moves, [stop.joint_angles for stop in plan])
    final = SampleFolder.open(tmp_path / "samples")
    assert [entry["planned"] for entry in final.entries] == [0, 1, 2, 3]
    for sample, stop in zip(final.samples(), plan, strict=True):
        assert sample.side == side
        np.testing.assert_allclose(sample.T_base_tcp, stop.T_base_tcp, atol=1e-6)
        assert set(sample.detections) == set(CAMERAS)


def interrupt_after(n):
    def on_sample(done, total):
        if done == n:
            raise KeyboardInterrupt

    return on_sample


def test_an_arm_that_never_rests_and_a_dead_camera_are_named(planned, tmp_path):
    side, plan = planned
    folder = new_folder(tmp_path)
    with pytest.raises(DeviceError, match=f"{side} arm: did not come to rest within 0.6 s"):
        collect(folder, StandingArm(side, settling=9.0), cameras(), plan[:1], still=QUICK)
    with pytest.raises(DeviceError, match="camera 'top': silent"):
        collect(folder, StandingArm(side), cameras(dead="top"), plan[:1], still=QUICK)
    assert folder.entries == []


class GuidedArm(StandingArm):
    """Somebody guides it to the next pose every 0.15 s, to the last one twice."""

    def __init__(self, poses):
        super().__init__("left", settling=0.03)
        self.poses, self.begin, self.at = poses, time.monotonic(), -1

    def reading(self):
        at = min(int((time.monotonic() - self.begin) / 0.15), len(self.poses) - 1)
        if at != self.at:
            self.at = at
            self.move_to(self.poses[at], 1.0)
        return super().reading()


def test_by_hand_every_new_pose_is_taken_once(tmp_path):
    plan = plan_poses(ARMS, list(CAMERAS.values()), "left", BOARD, 5, np.random.default_rng(3))
    poses = [stop.joint_angles for stop in plan[:3]]
    arm = GuidedArm([poses[0], poses[1], poses[1] + 1e-4, poses[2], poses[0]])
    folder = new_folder(tmp_path)
    added = collect_by_hand(folder, arm, cameras(), 5, still=QUICK, patience=1.0)
    assert added == 3
    found = [np.array(entry["T_base_tcp"]) for entry in folder.entries]
    for T, stop in zip(found, plan, strict=False):
        off = inverse(T) @ stop.T_base_tcp
        assert np.linalg.norm(off[:3, 3]) < 2e-3


def test_another_board_or_foreign_files_are_not_mixed_in(tmp_path):
    new_folder(tmp_path)
    sizes = dict.fromkeys(CAMERAS, (64, 48))
    with pytest.raises(SamplesError, match="another board"):
        SampleFolder.create(tmp_path / "samples", replace(BOARD, squares_x=7), sizes)
    with pytest.raises(SamplesError, match="holds no samples"):
        SampleFolder.create(tmp_path, BOARD, sizes)
    (tmp_path / "samples" / "samples.json").write_text('{"schema": "other/1"}')
    with pytest.raises(SamplesError, match="expected schema"):
        SampleFolder.open(tmp_path / "samples")


@pytest.mark.slow
def test_the_command_collects_plans_once_and_goes_on(tmp_path, monkeypatch, capsys):
    cell = cell_file(tmp_path / "cell.toml", CAMERAS)
    big = {name: SteadyCamera(name) for name in CAMERAS}
    monkeypatch.setattr("sim2real.cell.make_cameras", lambda config: big)
    monkeypatch.setattr("sim2real.calibration.samples.SampleFolder.append", recorded := Recorded())
    command = ["robot", "calibrate", str(cell), "--samples", str(tmp_path / "s"), "--poses", "5"]
    command += ["--collect", "right", "--joint-speed", "1.0"]
    assert cli.main(command) == 0, capsys.readouterr()
    assert "5 samples of the right arm" in capsys.readouterr().out
    assert recorded.sides == ["right"] * 5
    plan = load_plan(tmp_path / "s" / "plan_right.json")
    for T, stop in zip(recorded.poses, plan, strict=True):
        np.testing.assert_allclose(T, stop.T_base_tcp, atol=2e-4)
    # Asked again it finds everything done, and moves nothing.
    assert cli.main(command) == 0
    assert "0 samples of the right arm" in capsys.readouterr().out


class Recorded:
    """Stands for ``SampleFolder.append``: small test images do not have the cameras' size."""

    def __init__(self):
        self.sides, self.poses = [], []

    def __get__(self, folder, _):
        def append(side, T_base_tcp, images, name=None, **details):
            self.sides.append(side)
            self.poses.append(T_base_tcp)
            folder.entries.append(
                {
                    "side": side,
                    "name": "",
                    "images": {},
                    "T_base_tcp": T_base_tcp.tolist(),
                    **details,
                }
            )
            folder._save()

        return append
