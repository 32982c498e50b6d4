import json
import signal

import numpy as np
import pytest

from dlo_gym.cli import main
from dlo_gym.metrics import ptp_3d
from dlo_gym.recording import Recording, RecordingWriter
from dlo_gym.rod import RodProperties
from dlo_gym.rod.rod import CosseratRod
from tests.tracking.drawing import LENGTH, RADIUS, clamps, draw_cable
from tracking.evaluate import Track, evaluate, follow, make_tracker, occlude, rod_properties
from tracking.observer import TrackerObserver
from tracking.occlusion import hidden_by, paste, random_patches
from tracking.tracker import MultiViewTracker

SAMPLES = 6


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, cameras):
    """A recording of a drawn cable, with truth; and one without."""
    folder = tmp_path_factory.mktemp("recordings")
    rod = CosseratRod(RodProperties(length=LENGTH, radius=RADIUS))
    for name in ("with_truth", "without"):
        with RecordingWriter(
            folder / name, cameras[:2], rod_length=LENGTH, rod_radius=RADIUS, rate_hz=10
        ) as writer:
            for i in range(SAMPLES):
                pose = clamps(shift=(0.005 * i, 0.003 * i, 0.0), turn=0.03 * i)
                shape = rod.settle(pose).positions
                views = [draw_cable(camera, shape, seed=i) for camera in cameras[:2]]
                truth = shape if name == "with_truth" else None
                writer.append(views, pose.left, pose.right, 0.1 * i, centerline=truth)
    return folder


def run(*arguments):
    return main(["track", *map(str, arguments)])


def test_the_command_writes_estimate_metrics_and_pictures(drawn, tmp_path):
    out = tmp_path / "out"
    assert run(drawn / "with_truth", "--out", out) == 0
    with np.load(out / "estimate.npz") as estimate:
        assert estimate["centerline"].shape == (SAMPLES, 51, 3)
        assert estimate["visible"].shape == (2, SAMPLES, 51)
        assert estimate["visible"].dtype == bool
        truth = Recording.load(drawn / "with_truth").centerline
        error = 1e3 * ptp_3d(estimate["centerline"], truth).mean()
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["ptp_3d_mm"] == pytest.approx(error)
    assert metrics["ptp_3d_mm"] < 0.5
    assert len(metrics["ptp_3d_mm_per_sample"]) == SAMPLES
    assert set(metrics["ptp_2d_percent"]) == {"side", "top"}
    assert set(metrics["occlusion_percent"]) == {"side", "top"}
    assert metrics["lost"] is False
    assert metrics["complete"] is True
    assert set(metrics["update_ms"]) == {"median", "p99"}
    assert {"prediction", "graph", "association", "triangulation"} <= set(metrics["components_ms"])
    assert (out / "overlay.mp4").stat().st_size > 1000
    assert len(list(out.glob("overlay_*.png"))) == 5
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_without_truth_there_are_residuals(drawn, tmp_path):
    assert run(drawn / "without", "--out", tmp_path / "out", "--overlay", "none") == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "ptp_3d_mm" not in metrics
    assert all(0.0 < value < 1.5 for value in metrics["reprojection_residual_px"].values())


def test_an_existing_folder_is_kept_unless_told(drawn, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("precious")
    assert run(drawn / "without", "--out", out, "--overlay", "none") == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run(drawn / "without", "--out", out, "--overlay", "none", "--overwrite") == 1
    assert "mine.txt" in capsys.readouterr().err
    assert (out / "mine.txt").read_text() == "precious"
    (out / "mine.txt").rename(out / "metrics.json")  # now it could be a former result
    assert run(drawn / "without", "--out", out, "--overlay", "none", "--overwrite") == 0
    assert (out / "metrics.json").read_text() != "precious"


def test_a_damaged_image_is_reported_and_what_was_tracked_is_kept(tmp_path, cameras, capsys):
    folder = tmp_path / "rec"
    pose = clamps()
    shape = CosseratRod(RodProperties(length=LENGTH, radius=RADIUS)).settle(pose).positions
    with RecordingWriter(
        folder, cameras[:2], rod_length=LENGTH, rod_radius=RADIUS, rate_hz=10
    ) as writer:
        for i in range(4):
            views = [draw_cable(camera, shape, seed=i) for camera in cameras[:2]]
            writer.append(views, pose.left, pose.right, 0.1 * i)
    (folder / "views/top/000002.png").write_bytes(b"")
    assert run(folder, "--out", tmp_path / "out", "--overlay", "none") == 1
    assert "000002.png" in capsys.readouterr().err.replace("\n", "")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["samples"], metrics["complete"]) == (2, False)


def test_patches_hide_the_share_asked_for_and_repeat_with_the_seed():
    line = np.column_stack([np.linspace(100.0, 900.0, 51), np.full(51, 300.0)])
    pixels = np.stack([line, line + np.array([0.0, 10.0])])
    for share in (0.0, 0.2, 0.4):
        patches = random_patches(np.random.default_rng(3), pixels, share, 80.0)
        assert hidden_by(patches, pixels).mean() == pytest.approx(share, abs=0.035)
        assert patches == random_patches(np.random.default_rng(3), pixels, share, 80.0)
    with pytest.raises(ValueError, match="share"):
        random_patches(np.random.default_rng(0), pixels, 1.5, 80.0)


def test_patches_are_clipped_to_the_image(cameras, hanging):
    view = draw_cable(cameras[0], hanging)
    corner = np.zeros((1, 3, 2))
    patches = random_patches(np.random.default_rng(0), corner, 1.0, 50.0)
    covered = paste(view, patches)
    assert tuple(covered.image[0, 0]) == patches[-1].colour
    np.testing.assert_array_equal(covered.image[200:], view.image[200:])


class Cell:
    """As much of a simulated cell as the observer may look at."""

    n_nodes = 51
    obstacles = ()

    def __init__(self, recording):
        self.recording, self.sample = recording, 0
        self.properties = rod_properties(recording)

    @property
    def boundary(self):
        from tracking.evaluate import boundaries

        return boundaries(self.recording)[self.sample]

    @property
    def stamp(self):
        return float(self.recording.stamps[self.sample])

    def views(self):
        return self.recording.views(self.sample)


@pytest.mark.parametrize("predictor", ["rod", "network"])
def test_the_observer_tracks_a_cell(drawn, predictor):
    recording = Recording.load(drawn / "with_truth")
    cell, observer = Cell(recording), TrackerObserver(predictor)
    with pytest.raises(ValueError, match="reset"):
        observer.update(cell, cell.boundary.displacement_to(cell.boundary))
    estimate = observer.reset(cell)
    for cell.sample in range(1, SAMPLES):
        before = Cell(recording)
        before.sample = cell.sample - 1
        estimate = observer.update(cell, before.boundary.displacement_to(cell.boundary))
    error = ptp_3d(estimate.centerline, recording.centerline[-1]).mean()
    assert error < 1e-3
    assert estimate.stamp == cell.stamp
    observer.close()
    observer.close()


def test_a_rod_that_the_network_does_not_know_is_refused_with_the_way_out(drawn):
    cell = Cell(Recording.load(drawn / "with_truth"))
    cell.n_nodes = 31
    with pytest.raises(ValueError, match="51 nodes, got a rod of 31.*predictor='rod'"):
        TrackerObserver().reset(cell)
    assert TrackerObserver("rod").reset(cell).centerline.shape == (31, 3)


def tracked(source, occlusion=None):
    properties = rod_properties(source)
    result = Track()
    for _ in follow(make_tracker(source, properties), source, properties, result, occlusion):
        pass
    return result, evaluate(source, result)


def test_exp1_in_clear_views(exp1):
    _, metrics = tracked(Recording.load(exp1))
    assert metrics["ptp_3d_mm"] <= 0.3
    assert metrics["ptp_3d_mm_max"] <= 1.5
    assert not metrics["lost"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_exp1_under_patches_and_after_them(exp1, seed):
    source = Recording.load(exp1)
    occlusion = occlude(source, seed)
    result, metrics = tracked(source, occlusion)
    covered = np.array(metrics["ptp_3d_mm_per_sample"])[occlusion.first : occlusion.last]
    hidden = ~result.visible[:, occlusion.first : occlusion.last]
    assert 0.3 < hidden.mean() < 0.55
    assert covered.mean() <= 1.0
    assert max(metrics["ptp_3d_mm_per_sample"][occlusion.last + 5 :]) <= 0.5
    assert not metrics["lost"]


def test_ctrl_c_keeps_the_samples_tracked_so_far(drawn, tmp_path, monkeypatch, capsys):
    def interrupted(self, views, displacement, stamp=None):
        estimate = update(self, views, displacement, stamp)
        if stamp is not None and stamp > 0.1:
            signal.raise_signal(signal.SIGINT)
        return estimate

    update = MultiViewTracker.update
    monkeypatch.setattr(MultiViewTracker, "update", interrupted)
    out = tmp_path / "out"
    assert run(drawn / "with_truth", "--out", out) == 130
    assert "samples were tracked" in capsys.readouterr().err
    metrics = json.loads((out / "metrics.json").read_text())
    assert not metrics["complete"]
    assert len(np.load(out / "estimate.npz")["centerline"]) == metrics["samples"] < SAMPLES
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
