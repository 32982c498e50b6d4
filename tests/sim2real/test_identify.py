"""``dlo identify`` on a drawn recording of a rod with known parameters."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.cli import main
from dlo_gym.exceptions import IdentificationFailed
from dlo_gym.geometry import CameraModel, View
from dlo_gym.recording import Recording, RecordingWriter
from dlo_gym.rod import RodProperties
from dlo_gym.rod.rod import CosseratRod
from sim2real import identify as command
from sim2real.identification.estimate import fit
from tests.tracking.drawing import LENGTH, RADIUS, clamps, draw_cable

SAMPLES = 12
PERIOD = 0.05  # [s]
TIMES = PERIOD * np.arange(20)
MODULUS, DENSITY = 1e6, 1e3
STIFFNESS = MODULUS * RADIUS**2 / (4.0 * DENSITY * 9.81)  # EI / weight of a solid round rod [m^3]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Recordings of a rod in equilibrium, with truth and without; its modulus is not told."""
    folder = tmp_path_factory.mktemp("recordings")
    cameras = [
        CameraModel.looking_at("side", (0.05, -1.05, 0.42), (0, 0, 0.27)).scaled(0.5),
        CameraModel.looking_at("top", (0.02, -0.1, 1.25), (0, 0, 0.25)).scaled(0.5),
    ]
    rod = CosseratRod(RodProperties(LENGTH, RADIUS, MODULUS, DENSITY))
    phase = np.sin(np.linspace(0.0, np.pi, SAMPLES))
    for name in ("with_truth", "without"):
        with RecordingWriter(
            folder / name, cameras, rod_length=LENGTH, rod_radius=RADIUS, rate_hz=10
        ) as writer:
            for i, s in enumerate(phase):
                pose = clamps(shift=(0.05 * s, 0.04 * s, 0.03 * s), turn=0.6 * s)
                shape = rod.settle(pose).positions
                views = [draw_cable(camera, shape, seed=i) for camera in cameras]
                truth = shape if name == "with_truth" else None
                writer.append(views, pose.left, pose.right, 0.1 * i, centerline=truth)
    return folder


@pytest.fixture(scope="module")
def swung(tmp_path_factory):
    """A recording of a rod whose clamps swing it; nobody looks."""
    path = tmp_path_factory.mktemp("recordings") / "swung"
    camera = CameraModel.looking_at("side", (0.05, -1.05, 0.42), (0, 0, 0.27)).scaled(0.02)
    view = View(np.zeros((camera.height, camera.width, 3), np.uint8), camera, 0.0)
    rod = CosseratRod(RodProperties(LENGTH, RADIUS, MODULUS, DENSITY), 20)
    poses = [clamps(shift=(0, 0.05 * np.sin(4 * t), 0.05 * np.sin(4 * t) ** 2)) for t in TIMES]
    state = rod.settle(poses[0])
    with RecordingWriter(
        path, [camera], rod_length=LENGTH, rod_radius=RADIUS, rate_hz=1.0 / PERIOD
    ) as writer:
        for i, pose in enumerate(poses):
            if i:
                step = poses[i - 1].displacement_to(pose)
                state = rod.advance(step, PERIOD)
            writer.append([view], pose.left, pose.right, TIMES[i], centerline=state.positions)
    return path


def run(*arguments) -> int:
    return main(["identify", *map(str, arguments)])


def parameters(folder) -> dict[str, float]:
    report = json.loads((folder / "identified.json").read_text())
    return {name: entry["value"] for name, entry in report["parameters"].items()}


def test_the_truth_gives_stiffness_and_length(drawn, tmp_path):
    out = tmp_path / "out"
    assert run(drawn / "with_truth", "--from", "truth", "--model", "rest", "--out", out) == 0
    found = parameters(out)
    assert found["EI / weight"] == pytest.approx(STIFFNESS, rel=0.01)
    assert found["length"] == pytest.approx(LENGTH, rel=0.001)
    report = json.loads((out / "identified.json").read_text())
    assert report["rms_mm"] < 0.05
    low, high = report["parameters"]["EI / weight"]["interval_95"]
    assert low < found["EI / weight"] < high
    properties = RodProperties(**report["rod_properties"])
    bending = np.pi * RADIUS**4 / 4 * MODULUS
    assert properties.bending_stiffness == pytest.approx(bending, rel=0.01)
    section = tomllib.loads((out / "rod.toml").read_text())["rod"]
    assert section["youngs_modulus_pa"] == pytest.approx(MODULUS, rel=0.01)
    assert (out / "fit.png").stat().st_size > 5000
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_tracker_gives_them_though_its_rod_is_too_soft(drawn, tmp_path):
    out = tmp_path / "out"
    options = ("--model", "rest", "--youngs-modulus", "4e5", "--out", out)
    assert run(drawn / "without", "--from", "estimate", *options) == 0
    found = parameters(out)
    assert found["EI / weight"] == pytest.approx(STIFFNESS, rel=0.1)
    assert found["length"] == pytest.approx(LENGTH, rel=0.03)


def test_the_model_that_fits_better_is_kept(drawn, swung, tmp_path):
    models = {}
    for recording in (drawn / "with_truth", swung):
        out = tmp_path / recording.name
        assert run(recording, "--from", "truth", "--out", out) == 0
        models[recording.name] = json.loads((out / "identified.json").read_text())["model"]
        assert parameters(out)["EI / weight"] == pytest.approx(STIFFNESS, rel=0.02)
    assert models == {"with_truth": "rest", "swung": "motion"}
    assert {"external damping", "internal damping"} <= set(parameters(out))


@pytest.fixture(scope="module")
def found(swung):
    return fit([command.motion_of_truth(Recording.load(swung))], model="rest")


@pytest.mark.parametrize(
    ("rest", "motion", "kept"),
    [
        (None, 1.0, "motion"),
        (1.0, None, "rest"),
        (np.nan, 1.0, "motion"),
        (np.nan, None, "rest"),
        (None, None, None),
    ],
)
def test_a_model_that_fails_leaves_the_other(
    swung, found, tmp_path, monkeypatch, capsys, rest, motion, kept
):
    def fit_with(motions, *, model, callback):
        rms = {"rest": rest, "motion": motion}[model]
        if rms is None:
            raise IdentificationFailed(f"{model} could not follow")
        return replace(found, rms=rms)

    monkeypatch.setattr(command, "fit", fit_with)
    status = run(swung, "--from", "truth", "--out", tmp_path / "out")
    if kept is None:
        assert status == 1
        assert "could not follow" in capsys.readouterr().err
        return
    report = json.loads((tmp_path / "out" / "identified.json").read_text())
    rms_mm = 1e3 if 1.0 in (rest, motion) else None
    assert (report["model"], report["rms_mm"]) == (kept, rms_mm)


def test_what_cannot_be_is_said(drawn, tmp_path, capsys):
    assert run(drawn / "without", "--from", "truth", "--out", tmp_path / "out") == 1
    assert "has no truth.npz" in capsys.readouterr().err
    with_truth = (drawn / "with_truth", "--from", "truth", "--out", tmp_path / "out")
    assert run(*with_truth, "--youngs-modulus", "4e5") == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "youngs_modulus: expected none with --from truth" in said
    assert run(drawn / "nothing", "--out", tmp_path / "out") == 1
    said = "".join(capsys.readouterr().err.split())
    assert f"{drawn / 'nothing' / 'recording.json'}:expectedthisfile" in said
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("")
    assert run(drawn / "with_truth", "--out", tmp_path / "mine", "--overwrite") == 1
    assert "precious.txt" in capsys.readouterr().err
