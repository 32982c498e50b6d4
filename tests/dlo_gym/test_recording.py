import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import RecordingError
from dlo_gym.geometry import CameraModel, View
from dlo_gym.overlay import SEEN, TRUE, draw_overlay
from dlo_gym.recording import Recording, RecordingWriter

T, N = 4, 7
CAMERAS = (
    CameraModel.looking_at("side", (0, -1, 0.4), (0, 0, 0.3), width=64, height=36, focal_length=50),
    CameraModel.looking_at(
        "top", (0, 0, 1), (0, 0.01, 0), width=48, height=32, distortion=(0.1, 0, 0, 0, 0)
    ),
)


def write(path, *, samples=T, right=True, truth=True, image_format="png", cameras=CAMERAS):
    rng = np.random.default_rng(0)
    with RecordingWriter(
        path,
        cameras,
        rod_length=0.5,
        rod_radius=0.003,
        rate_hz=10.0,
        youngs_modulus=2e6,
        image_format=image_format,
    ) as writer:
        for i in range(samples):
            views = [
                View(rng.integers(0, 256, (c.height, c.width, 3), np.uint8), c, 0.1 * i + 0.01)
                for c in cameras
            ]
            shape = {"centerline": rng.random((N, 3)), "visible": rng.random((2, N)) > 0.5}
            pose = np.eye(4)
            pose[:3, 3] = i
            writer.append(views, pose, pose if right else None, 0.1 * i, **(shape if truth else {}))
    return path


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "rec")


def edit_json(folder, change):
    file = folder / "recording.json"
    description = json.loads(file.read_text())
    change(description)
    file.write_text(json.dumps(description))


def edit_npz(folder, name, **arrays):
    with np.load(folder / name) as archive:
        content = {**dict(archive), **arrays}
    np.savez(folder / name, **{k: v for k, v in content.items() if v is not None})


def test_what_was_written_is_read_back(tmp_path):
    recording = Recording.load(write(tmp_path / "rec"))
    rng = np.random.default_rng(0)
    assert (len(recording), recording.name, recording.rate_hz) == (T, "rec", 10.0)
    assert (recording.rod_length, recording.rod_radius) == (0.5, 0.003)
    assert (recording.youngs_modulus, recording.density) == (2e6, None)
    np.testing.assert_allclose(recording.stamps, 0.1 * np.arange(T))
    np.testing.assert_array_equal(recording.clamp_left[:, 0, 3], np.arange(T))
    for camera, read in zip(CAMERAS, recording.cameras, strict=True):
        assert camera.name == read.name
        for field in ("K", "distortion", "T_world_camera"):
            np.testing.assert_array_equal(getattr(camera, field), getattr(read, field))
    images = [rng.integers(0, 256, (c.height, c.width, 3), np.uint8) for c in CAMERAS]
    for view, image in zip(recording.views(0), images, strict=True):
        np.testing.assert_array_equal(view.image, image)
        assert view.stamp == pytest.approx(0.01)
    assert recording.centerline is not None
    np.testing.assert_array_equal(recording.centerline[0], rng.random((N, 3)))
    np.testing.assert_array_equal(recording.visible["side"][0], (rng.random((2, N)) > 0.5)[0])


def test_one_gripper_no_truth_and_jpeg(tmp_path):
    recording = Recording.load(write(tmp_path / "r", right=False, truth=False, image_format="jpg"))
    assert recording.clamp_right is None
    assert recording.centerline is None
    assert recording.views(T - 1)[1].image.shape == (32, 48, 3)


def remove(name):
    return lambda folder: (folder / name).unlink()


def set_camera(key, value):
    return lambda folder: edit_json(folder, lambda d: d["cameras"][0].update({key: value}))


def set_entry(key, value):
    return lambda folder: edit_json(folder, lambda d: d.update({key: value}))


def set_array(name, **arrays):
    return lambda folder: edit_npz(folder, name, **arrays)


SKEWED = np.tile(np.eye(4), (T, 1, 1))
SKEWED[2, 0, 1] = 0.1
HOLED = np.tile(np.eye(4), (T, 1, 1))
HOLED[1, 0, 3] = np.nan

DAMAGE = {
    "no json": (remove("recording.json"), r"recording\.json.*missing"),
    "bad json": (lambda f: (f / "recording.json").write_text("{"), r"recording\.json.*JSON"),
    "schema": (set_entry("schema", "dlo-recording/2"), r"recording\.json.*dlo-recording/1"),
    "no rate": (set_entry("rate_hz", None), r"recording\.json.*rate_hz"),
    "no rod": (set_entry("rod", {}), r"recording\.json.*length"),
    "negative radius": (set_entry("rod", {"length": 1, "radius": -1}), r"radius"),
    "no cameras": (set_entry("cameras", []), r"at least one camera"),
    "K": (set_camera("K", [[1, 2], [3, 4]]), r"recording\.json.*'side'.*3x3"),
    "ragged K": (set_camera("K", [[1, 2], [3]]), r"recording\.json.*'side'"),
    "distortion": (set_camera("distortion", [0, 0]), r"'side'.*distortion"),
    "camera name": (set_camera("name", "../x"), r"recording\.json.*folder"),
    "camera pose": (set_camera("T_world_camera", SKEWED[2].tolist()), r"'side'.*rigid"),
    "no signals": (remove("signals.npz"), r"signals\.npz.*missing"),
    "no npz": (lambda f: (f / "signals.npz").write_bytes(b"PK nonsense"), r"signals\.npz.*npz"),
    "no left clamp": (set_array("signals.npz", clamp_left=None), r"signals\.npz.*clamp_left"),
    "clamp shape": (set_array("signals.npz", clamp_right=np.eye(4)), r"clamp_right.*\(4, 4, 4\)"),
    "clamp count": (set_array("signals.npz", clamp_right=SKEWED[:2]), r"signals\.npz.*clamp_right"),
    "non-rigid": (set_array("signals.npz", clamp_left=SKEWED), r"signals\.npz.*clamp_left.*rigid"),
    "non-finite": (set_array("signals.npz", clamp_left=HOLED), r"signals\.npz.*clamp_left.*finite"),
    "camera stamps": (set_array("signals.npz", stamps_side=np.zeros(2)), r"stamps_side"),
    "objects": (set_array("signals.npz", stamps=np.array([None] * T)), r"signals\.npz"),
    "truth count": (set_array("truth.npz", centerline=np.zeros((T + 1, N, 3))), r"truth\.npz"),
    "visible type": (set_array("truth.npz", visible_top=np.zeros((T, N))), r"visible_top.*bool"),
    "no views": (lambda f: shutil.rmtree(f / "views" / "top"), r"views/top.*missing"),
    "hole": (remove("views/side/000001.png"), r"side/000001.*missing"),
    "short": (remove("views/side/000003.png"), r"side/000003.*missing"),
    "one more": (
        lambda f: shutil.copy(f / "views/side/000003.png", f / "views/side/000004.png"),
        r"000004\.png.*expected 4",
    ),
    "twice": (
        lambda f: shutil.copy(f / "views/side/000003.png", f / "views/side/000003.jpg"),
        r"one image per sample",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_reported_with_the_file_and_what_was_expected(folder, damage):
    break_it, message = DAMAGE[damage]
    break_it(folder)
    with pytest.raises(RecordingError, match=message):
        Recording.load(folder)


def test_a_damaged_image_is_reported_when_it_is_read(folder):
    (folder / "views/side/000002.png").write_bytes(b"not an image")
    shutil.copy(folder / "views/top/000000.png", folder / "views/side/000001.png")
    recording = Recording.load(folder)
    recording.views(0)
    with pytest.raises(RecordingError, match=r"side/000002\.png.*damaged"):
        recording.views(2)
    with pytest.raises(RecordingError, match=r"side/000001\.png.*64x36.*48x32"):
        recording.views(1)
    with pytest.raises(ValueError, match="'side', 'top'"):
        recording.view("front", 0)


def test_nothing_is_overwritten(folder):
    with pytest.raises(FileExistsError, match="exists"):
        write(folder)
    assert len(Recording.load(folder)) == T


def test_an_interrupted_recording_keeps_its_complete_samples(tmp_path):
    path = tmp_path / "rec"
    views = [View(np.zeros((c.height, c.width, 3), np.uint8), c) for c in CAMERAS]
    writer = RecordingWriter(path, CAMERAS, rod_length=0.5, rod_radius=0.003, rate_hz=10)

    def record():
        with writer:
            for i in range(2):
                writer.append(views, np.eye(4), None, 0.1 * i)
                assert not path.exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record()
    assert len(Recording.load(path)) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["rec"]


def test_an_empty_recording_leaves_nothing(tmp_path):
    write(tmp_path / "rec", samples=0)
    assert list(tmp_path.iterdir()) == []


def test_a_sample_that_does_not_fit_is_refused_and_not_added(tmp_path):
    views = [View(np.zeros((c.height, c.width, 3), np.uint8), c) for c in CAMERAS]
    with RecordingWriter(
        tmp_path / "rec", CAMERAS, rod_length=0.5, rod_radius=0.003, rate_hz=10
    ) as writer:
        writer.append(views, np.eye(4), np.eye(4), 0.0)
        for change, named in (
            ({"views": views[:1]}, "views"),
            ({"clamp_left": SKEWED[2]}, "clamp_left"),
            ({"clamp_right": None}, "sample"),
            ({"stamp": np.nan}, "stamp"),
            ({"centerline": np.zeros((4, 2))}, "centerline"),
            ({"visible": np.zeros((2, 4))}, "visible"),
        ):
            given = {
                "views": views,
                "clamp_left": np.eye(4),
                "clamp_right": np.eye(4),
                "stamp": 0.1,
                **change,
            }
            with pytest.raises(ValueError, match=named):
                writer.append(**given)
    assert len(Recording.load(tmp_path / "rec")) == 1


def test_a_sample_without_the_truth_of_the_first_is_refused(tmp_path):
    views = [View(np.zeros((c.height, c.width, 3), np.uint8), c) for c in CAMERAS]
    line, seen = np.zeros((5, 3)), np.ones((2, 5), dtype=bool)
    with RecordingWriter(
        tmp_path / "rec", CAMERAS, rod_length=0.5, rod_radius=0.003, rate_hz=10
    ) as writer:
        writer.append(views, np.eye(4), None, 0.0, centerline=line, visible=seen)
        for truth in ({}, {"centerline": line}, {"centerline": line[1:], "visible": seen[:, 1:]}):
            with pytest.raises(ValueError, match="data of the first"):
                writer.append(views, np.eye(4), None, 0.1, **truth)
    assert len(Recording.load(tmp_path / "rec")) == 1


def test_images_of_a_sample_that_was_not_completed_go(tmp_path, monkeypatch):
    views = [View(np.zeros((c.height, c.width, 3), np.uint8), c) for c in CAMERAS]
    writer = RecordingWriter(tmp_path / "rec", CAMERAS, rod_length=0.5, rod_radius=0.003, rate_hz=1)
    imwrite = cv2.imwrite
    monkeypatch.setattr(
        cv2, "imwrite", lambda f, *rest: "top/000001" not in f and imwrite(f, *rest)
    )
    with writer:
        writer.append(views, np.eye(4), None, 0.0)
        with pytest.raises(OSError, match=r"top/000001\.png.*disk full"):
            writer.append(views, np.eye(4), None, 1.0)
    assert len(Recording.load(tmp_path / "rec")) == 1


def test_what_cannot_be_completed_is_said_and_kept(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match=r"No space left.*images are in"):
        write(tmp_path / "rec")
    (kept,) = tmp_path.iterdir()
    assert len(list(kept.glob("views/side/*.png"))) == T


def test_the_shared_recording_loads():
    default = Path(__file__).parents[2].parent / "shared" / "data"
    path = Path(os.environ.get("DLO_DATA", default)) / "recordings" / "exp1"
    if not path.is_dir():
        pytest.skip(f"no recording at {path}; set DLO_DATA")
    recording = Recording.load(path)
    assert len(recording) == 40
    assert recording.centerline is not None
    assert recording.views(39)[0].image.shape == (1080, 1920, 3)


def test_the_overlay_draws_on_a_copy_and_survives_what_is_not_in_the_image():
    camera = CameraModel.looking_at("side", (0, -1, 0.4), (0, 0, 0.3))
    view = View(np.zeros((1080, 1920, 3), np.uint8), camera)
    line = np.column_stack([np.linspace(-0.1, 0.1, 11), np.zeros(11), np.full(11, 0.3)])
    line[0], line[-1] = (0.0, -5.0, 0.3), (1e6, 0.0, 0.3)  # behind the camera; far outside
    drawn = draw_overlay(view, line, visible=np.arange(11) < 6, truth=line, goal=line, caption="x")
    assert not view.image.any()
    x, y = np.round(camera.project(line[3])).astype(int)
    assert np.abs(drawn[y, x].astype(int) - TRUE).max() < 60
    assert np.abs(drawn[y + 2, x].astype(int) - SEEN).max() < 60


def test_writing_png_prints_nothing(tmp_path, capfd):
    camera = CameraModel.looking_at("side", (0, -1, 0.4), (0, 0, 0.3), width=32, height=18)
    view = View(np.zeros((18, 32, 3), np.uint8), camera)
    with RecordingWriter(
        tmp_path / "r", [camera], rod_length=0.5, rod_radius=0.003, rate_hz=10.0
    ) as writer:
        writer.append([view], np.eye(4), np.eye(4), 0.0)
    assert "WARN" not in "".join(capfd.readouterr())
