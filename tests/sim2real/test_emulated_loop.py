"""The whole real stack against the emulated cell: ur_rtde, sockets, cameras, tracker, MPC."""

import json

import numpy as np
import pytest

from dlo_gym import cli
from dlo_gym.exceptions import RecordingError
from dlo_gym.recording import Recording
from sim2real.emulator.emulated_cell import EmulatedCell
from sim2real.replay import COMPARED, rerun
from tests.sim2real.emulated import NETWORK, write_cell

pytestmark = pytest.mark.timeout(280)


@pytest.fixture(scope="module")
def emulated(tmp_path_factory):
    """A running emulated cell and its cell file."""
    file = tmp_path_factory.mktemp("cell") / "cell.toml"
    config = write_cell(file)
    with EmulatedCell.of(config, rate=10.0) as cell:
        yield cell, file


@pytest.fixture(scope="module")
def finished(emulated, tmp_path_factory):
    """The folder of a run that was left to itself."""
    _, file = emulated
    out = tmp_path_factory.mktemp("run") / "run"
    # On a busy machine a stream may freeze for a moment.
    arguments = ["--steps", "60", "--recoveries", "5", "--out", str(out)]
    assert cli.main(["robot", "run", str(file), *arguments]) == 0
    return out


def test_the_true_cable_reaches_the_goal(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["initial_true_error_mm"] > 50.0
    assert metrics["final_true_error_mm"] < 6.0
    assert metrics["stopped"] == ""


def test_everything_is_recorded(finished):
    source = Recording.load(finished / "recording")
    assert len(source) == 61
    assert source.centerline is not None
    error = np.linalg.norm(source.extra["estimate"] - source.centerline, axis=2).mean()
    assert error < 1.5e-3
    # What was accepted is what the next step starts from.
    accepted, commanded = source.extra["accepted_left"], source.extra["commanded_left"]
    np.testing.assert_array_equal(accepted[1:-1], commanded[2:])
    assert (np.diff(source.stamps) > 0).all()


def test_a_replay_is_identical_to_the_last_bit(finished):
    result = rerun(Recording.load(finished / "recording"))
    assert {name: result.first_difference(name) for name in COMPARED} == dict.fromkeys(COMPARED)


def test_a_replay_with_another_goal_differs(finished):
    source = Recording.load(finished / "recording")
    source.run["goal"] = np.add(source.run["goal"], [0.0, 0.0, 0.01]).tolist()
    assert not rerun(source).identical


def test_check_finds_nothing_wrong(emulated, capsys):
    _, file = emulated
    status = cli.main(["robot", "check", str(file)])
    assert status == 0, capsys.readouterr().out


def test_a_dry_run_moves_nothing(emulated, tmp_path, capsys):
    cell, file = emulated
    before = cell.state("left")
    out = tmp_path / "dry"
    assert (
        cli.main(["robot", "run", str(file), "--dry-run", "--steps", "3", "--out", str(out)]) == 0
    )
    after = cell.state("left")
    assert after["joints"] == pytest.approx(before["joints"], abs=1e-6)
    assert not after["program"]
    assert "would send" in capsys.readouterr().out
    assert Recording.load(out / "recording").extra["dry_run"].all()


def test_a_recording_without_control_is_one_that_the_tracker_takes(emulated, tmp_path):
    _, file = emulated
    out = tmp_path / "looked"
    assert cli.main(["robot", "record", str(file), str(out), "--seconds", "0.5"]) == 0
    source = Recording.load(out)
    assert len(source) == 5
    assert source.centerline is not None
    with pytest.raises(RecordingError, match="dlo robot run"):
        rerun(source)


def test_addresses_are_this_process_own(emulated):
    cell, _ = emulated
    assert all(address.startswith(NETWORK) for address in cell.config.controllers)
