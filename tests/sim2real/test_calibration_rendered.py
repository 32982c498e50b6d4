"""The commands on boards that the scene renders in the grippers, truth known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dlo_gym import cli
from dlo_gym.geometry.se3 import exp_so3, pose
from sim2real.calibration.cell_file import changed_since_calibration
from sim2real.calibration.samples import SampleFolder, SamplesError
from sim2real.config import CellConfig, update_cell_file
from tests.sim2real.calibration_data import (
    BASES,
    apart,
    cell_cameras,
    cell_file,
    render_samples,
)


def tape_measured(cameras):
    """The cell as one knows it beforehand: cameras and the right base a little off."""
    off = pose(exp_so3([0.02, 0.01, -0.01]), [0.02, -0.01, 0.015])
    known = {
        name: replace(camera, T_world_camera=camera.T_world_camera @ off)
        for name, camera in cameras.items()
    }
    right = BASES["right"] @ pose(exp_so3([0.0, 0.0, 0.02]), [0.01, 0.005, 0.0])
    return known, BASES | {"right": right}


def check_against_truth(config, cameras):
    for model in config.camera_models:
        mm, deg = apart(model.T_world_camera, cameras[model.name].T_world_camera)
        assert mm <= 1.0, model.name
        assert deg <= 0.1, model.name
    mm, deg = apart(config.arms["right"].T_world_base, BASES["right"])
    assert mm <= 1.0
    assert deg <= 0.1
    assert apart(config.arms["left"].T_world_base, BASES["left"])[0] < 1e-6


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Cameras of known lenses; a folder of rendered samples."""
    path = tmp_path_factory.mktemp("bench")
    cameras = cell_cameras(0.6)
    render_samples(path / "samples", cameras, np.random.default_rng(2), 9)
    return path, cameras


@pytest.fixture
def cell(bench, tmp_path):
    known, bases = tape_measured(bench[1])
    return cell_file(tmp_path / "cell.toml", known, bases)


def calibrate(cell, bench, out, *more):
    samples = str(bench[0] / "samples")
    return cli.main(
        ["robot", "calibrate", str(cell), "--samples", samples, "--out", str(out), *more]
    )


def test_calibrate_puts_cameras_and_base_into_the_cell_file(bench, cell, tmp_path, capsys):
    assert calibrate(cell, bench, tmp_path / "out", "--intrinsics", "keep") == 0, (
        capsys.readouterr()
    )
    config = CellConfig.load(cell)
    check_against_truth(config, bench[1])
    assert config.calibration is not None
    assert config.calibration.verdict == "good"
    assert config.calibration.residual_px < 0.6
    assert config.calibration.residual_mm < 0.4
    assert not changed_since_calibration(config)
    # Comments of the file live on, and the report shows the same numbers.
    assert "# with a ruler" in cell.read_text()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["residuals"]["all"]["px"] == pytest.approx(
        config.calibration.residual_px, abs=1e-4
    )
    assert {m["method"] for m in metrics["methods"]} >= {"TSAI", "PARK", "SHAH", "LI"}
    page = (tmp_path / "out" / "report.html").read_text()
    for name in ("residuals.png", "coverage.png"):
        assert name in page
        assert (tmp_path / "out" / name).stat().st_size > 10_000

    # Any later change of a number is noticed; of another field it is not.
    update_cell_file(cell, {"name": "renamed"})
    assert not changed_since_calibration(CellConfig.load(cell))
    update_cell_file(cell, {"arms.left.tcp_position_m": [0.0, 0.0, 0.17]})
    assert changed_since_calibration(CellConfig.load(cell))

    # Its own samples cannot verify a calibration; a former report is not replaced unasked.
    samples = str(bench[0] / "samples")
    assert cli.main(["robot", "verify-calibration", str(cell), "--samples", samples]) == 1
    assert "collect fresh ones" in " ".join(capsys.readouterr().err.split())
    before = cell.read_text()
    assert calibrate(cell, bench, tmp_path / "out") == 1
    assert cell.read_text() == before


def test_no_write_leaves_the_file(bench, cell, tmp_path):
    before = cell.read_text()
    assert calibrate(cell, bench, tmp_path / "out", "--intrinsics", "keep", "--no-write") == 0
    assert cell.read_text() == before


def test_a_bad_calibration_is_not_saved(bench, cell, tmp_path, capsys):
    # A gripper in which the board slips.
    samples = SampleFolder.open(bench[0] / "samples")
    spoilt = SampleFolder(
        tmp_path / "spoilt", samples.board, samples.image_sizes, list(samples.entries)
    )
    spoilt.path.mkdir()
    (spoilt.path / "images").symlink_to(samples.path / "images")
    rng = np.random.default_rng(0)
    for entry in spoilt.entries:
        T = np.array(entry["T_base_tcp"]) @ pose(np.eye(3), rng.normal(0, 4e-3, 3))
        entry["T_base_tcp"] = T.tolist()
    spoilt._save()
    before = cell.read_text()
    arguments = [str(cell), "--samples", str(spoilt.path), "--out", str(tmp_path / "out")]
    assert cli.main(["robot", "calibrate", *arguments, "--intrinsics", "keep"]) == 1
    assert "was not saved" in " ".join(capsys.readouterr().err.split())
    assert cell.read_text() == before
    assert (tmp_path / "out" / "report.html").exists()


def test_a_folder_that_does_not_fit_is_explained(bench, cell, tmp_path, capsys):
    arguments = ["robot", "calibrate", str(cell), "--samples", str(tmp_path / "nothing")]
    assert cli.main(arguments) == 1
    assert "--collect" in capsys.readouterr().err
    update_cell_file(cell, {"cameras.side.width_px": 640})
    assert calibrate(cell, bench, tmp_path / "out") == 1
    message = " ".join(capsys.readouterr().err.split())
    assert "expected 640x648 images of camera 'side', got 1152x648" in message


def test_a_missing_image_is_named(bench, tmp_path):
    folder = SampleFolder.open(bench[0] / "samples")
    gone = SampleFolder(tmp_path, folder.board, folder.image_sizes, folder.entries[:1])
    with pytest.raises(SamplesError, match=r"images/.*0000.png: is missing"):
        gone.samples()


@pytest.mark.slow
def test_unknown_lenses_then_verify_then_a_camera_is_knocked(tmp_path, capsys):
    cameras = cell_cameras(2 / 3)
    rng = np.random.default_rng(0)
    render_samples(tmp_path / "samples", cameras, rng, 20)
    known, bases = tape_measured(
        {
            name: replace(camera, K=camera.K * [[0.97], [0.97], [1.0]], distortion=np.zeros(5))
            for name, camera in cameras.items()
        }
    )
    cell = cell_file(tmp_path / "cell.toml", known, bases)
    assert calibrate(cell, (tmp_path, cameras), tmp_path / "out") == 0
    config = CellConfig.load(cell)
    check_against_truth(config, cameras)
    for model in config.camera_models:
        assert np.abs(model.K - cameras[model.name].K).max() < 3.0

    def verified(samples):
        return cli.main(["robot", "verify-calibration", str(cell), "--samples", str(samples)])

    render_samples(tmp_path / "fresh", cameras, rng, 8)
    assert verified(tmp_path / "fresh") == 0
    shift = pose(np.eye(3), [3e-3, 0.0, 0.0])
    side = replace(cameras["side"], T_world_camera=shift @ cameras["side"].T_world_camera)
    knocked = cameras | {"side": side}
    render_samples(tmp_path / "knocked", cameras, rng, 8, seen_by=knocked)
    capsys.readouterr()
    assert verified(tmp_path / "knocked") == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "camera side seems to have moved by" in said
    assert "camera top seems to have moved by" not in said
