"""The demo end to end, short and small: real rendering, tracking, control, report."""

import json
import signal
from pathlib import Path

import pytest

import control.demo
from control.demo import demo
from control.mpc import ShapeMPC
from dlo_gym.recording import Recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    demo(out=out, seed=1, steps=8, image_height=270, clutter=False)
    return out


def test_the_cable_comes_closer_and_is_tracked(folder):
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["initial_shape_error_mm"] >= 60.0
    assert metrics["final_shape_error_mm"] < 0.5 * metrics["initial_shape_error_mm"]
    assert metrics["tracking_ptp3d_mm"] < 1.5
    assert isinstance(metrics["success"], bool)
    for name in ("control_ms", "tracking_ms"):
        assert 0.0 < metrics[name]["median"] <= metrics[name]["p99"]


def test_the_recording_is_whole_and_has_the_truth(folder):
    recording = Recording.load(folder / "recording")
    assert len(recording) == 9
    assert {view.camera.name for view in recording.views(3)} == {"side", "top"}
    assert recording.centerline.shape == (9, 51, 3)


def test_the_page_shows_what_lies_beside_it(folder):
    page = (folder / "report.html").read_text()
    for name in ("views.mp4", "views.png", "plots.png"):
        assert name in page
        assert (folder / name).stat().st_size > 1000
    assert not list(folder.parent.glob(".*part*"))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"steps": 0}, "steps"), ({"image_height": 20}, "image_height"), ({"seed": -1}, "seed")],
)
def test_bad_options_are_named_and_leave_nothing(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        demo(out=tmp_path / "out", **options)
    assert not list(tmp_path.iterdir())


def test_a_folder_of_other_things_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "thesis.tex").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for out in (Path("."), tmp_path):
        with pytest.raises(FileExistsError, match=r"thesis\.tex"):
            demo(out=out, steps=1, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("finished", [0, 2])
def test_ctrl_c_reports_the_steps_made(tmp_path, monkeypatch, finished):
    commands = []

    def interrupted(self, estimate, boundary, goal):
        if len(commands) == finished:
            signal.raise_signal(signal.SIGINT)
        commands.append(control(self, estimate, boundary, goal))
        return commands[-1]

    control = ShapeMPC.control
    monkeypatch.setattr(ShapeMPC, "control", interrupted)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt, match=f"{finished + 1} steps made"):
        demo(out=out, seed=1, steps=8, image_height=270, clutter=False)
    assert json.loads((out / "metrics.json").read_text())["steps"] == finished + 1
    assert len(Recording.load(out / "recording")) == finished + 2
    assert (out / "report.html").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_ctrl_c_while_the_report_is_written_does_not_lose_it(tmp_path, monkeypatch):
    def interrupted(path, **content):
        signal.raise_signal(signal.SIGINT)
        plot(path, **content)

    plot = control.demo.plot_episode
    monkeypatch.setattr("control.demo.plot_episode", interrupted)
    with pytest.raises(KeyboardInterrupt, match="2 steps made"):
        demo(out=tmp_path / "out", seed=1, steps=2, image_height=270, clutter=False)
    assert (tmp_path / "out" / "report.html").is_file()
