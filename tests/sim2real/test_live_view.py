"""What the live view writes of a step, read back from the file."""

import sys
from contextlib import suppress

import numpy as np
import pytest

from control.monitor import ArmReading
from control.safety import SafetyGate
from dlo_gym.exceptions import MissingExtra
from dlo_gym.geometry.camera import View
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.rod.state import ShapeEstimate
from sim2real.config import CellConfig
from sim2real.live_view import LiveView
from sim2real.loop import LoopInput, LoopOutput
from sim2real.steps import CellStep
from tests.sim2real.simulated_cell import write_cell

T = np.linspace(0.0, 1.0, 51)
CURVE = np.column_stack([-0.2 + 0.4 * T, 0 * T, 0.34 - 0.1 * np.sin(np.pi * T) ** 2])


@pytest.fixture
def config(tmp_path):
    return CellConfig.load(write_cell(tmp_path))


def make_step(config, sent=1.5, *, begins=False):
    """A step whose command the gate cuts."""
    boundary = config.dual_arm.forward_kinematics(config.dual_arm.home)
    views = tuple(
        View(np.full((model.height, model.width, 3), 90, np.uint8), model, 1.4)
        for model in config.camera_models
    )
    requested = BoundaryDisplacement([0.05, 0, 0, 0, 0, 0], np.zeros(6))
    decision = SafetyGate(config.safety_limits).check(requested, boundary)
    estimate = ShapeEstimate(CURVE, np.ones((len(views), 51), bool), np.zeros(51), 1.4)
    reading = ArmReading(
        0.0, 0.0, np.zeros(6), np.zeros(6), np.eye(4), np.zeros(6),
        np.array([3.0, 4.0, 0.0, 0.0, 0.0, 2.0]), "normal", True,
    )  # fmt: skip
    given = LoopInput(views, 1.4, boundary, boundary, config.dual_arm.home)
    output = LoopOutput(estimate, CURVE + 0.001, requested, decision, "ok", 12.0, 34.0)
    values = {
        "given": given, "output": output, "accepted": decision.target,
        "readings": {"left": reading, "right": reading}, "taken": 1000.0, "sent": sent,
        "late": 0.02, "begins": begins,
    }  # fmt: skip
    return CellStep(**{name: values[name] for name in CellStep.__dataclass_fields__})


def components(archetype):
    """What an archetype holds, as lists, by component."""
    return {batch.component_descriptor().component: batch.as_arrow_array().to_pylist()
            for batch in archetype.as_component_batches()}  # fmt: skip


def test_file_holds_what_the_step_had(config, tmp_path, monkeypatch):
    rerun = pytest.importorskip("rerun")
    logged = {}
    log = rerun.RecordingStream.log

    def noted(stream, entity, what, **options):
        logged.setdefault(entity, []).append(what)
        log(stream, entity, what, **options)

    monkeypatch.setattr(rerun.RecordingStream, "log", noted)
    path = tmp_path / "run.rrd"
    with suppress(ZeroDivisionError), LiveView(config, CURVE + 0.01, save=path) as view:
        view.show(make_step(config, 1.5))
        view.show(make_step(config, 1.6, begins=True))
        raise ZeroDivisionError("the link is gone")
    assert path.read_bytes()[:4] == b"RRF2"
    camera = config.camera_models[0]
    tracked = components(logged[f"world/cameras/{camera.name}/image/tracked"][0])
    drawn = np.array(tracked["LineStrips2D:strips"][0])
    assert drawn == pytest.approx(camera.project(CURVE), abs=1e-3)
    ahead = components(logged["world/cable/ahead"][0])["LineStrips3D:strips"][0]
    assert np.array(ahead) == pytest.approx(CURVE + 0.001, abs=1e-6)
    for entity, value in (
        ("wrench/left/force_n", 5.0),
        ("wrench/right/torque_nm", 2.0),
        ("timing/late_ms", 20.0),
        ("timing/image_age_ms", 100.0),
        ("error/goal_distance_mm", 10.0 * np.sqrt(3.0)),
    ):
        assert components(logged[entity][0])["Scalars:scalars"] == pytest.approx([value])
    assert len(logged["world/cameras/top/image"]) == 3  # the pinhole and two images
    notes = [components(one)["TextLog:text"][0] for one in logged["log"]]
    assert "cut by the safety gate: translation step" in notes[0]
    assert notes[-1] == "stopped: the link is gone"
    assert "takes over from where the arms are" in notes


def test_curve_behind_a_camera_is_left_out(config, tmp_path):
    pytest.importorskip("rerun")
    behind = CURVE + np.array([0.0, 0.0, 3.0])  # above the top camera, which looks down
    with LiveView(config, behind, save=tmp_path / "run.rrd") as view:
        view.show(make_step(config))


def test_neither_viewer_nor_file(config):
    pytest.importorskip("rerun")
    with pytest.raises(ValueError, match="spawn, save"):
        LiveView(config, CURVE, spawn=False)


def test_without_rerun(config, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match=r"rerun-sdk is not installed.*dlo-gym\[view\]"):
        LiveView(config, CURVE)
