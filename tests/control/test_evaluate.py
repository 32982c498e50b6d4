"""The closed loop on the environment, and what is reported of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from control.controller import ControlDiagnostics
from control.evaluate import (
    control,
    episode_metrics,
    gate_for,
    make_controller,
    make_env,
    overall_metrics,
    run_episode,
    write_metrics,
)
from control.models import RodModel
from control.mpc import ShapeMPC
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.exceptions import SolverFailed
from dlo_gym.rod.boundary import BoundaryDisplacement


class Scripted:
    """Gives the same command every time, or raises an error; a controller for tests only."""

    diagnostics = ControlDiagnostics()

    def __init__(self, command: BoundaryDisplacement | None) -> None:
        self.command = command

    def reset(self, goal, boundary, properties) -> None:
        pass

    def control(self, estimate, boundary, goal) -> BoundaryDisplacement:
        if self.command is None:
            raise SolverFailed("nothing works")
        return self.command


@pytest.fixture(scope="module")
def env():
    made = make_env("dlo_gym/ShapeControl-v0", observer="state")
    yield made
    made.close()


@pytest.fixture(scope="module")
def steps(env):
    gate = gate_for(env.unwrapped.config)
    return list(run_episode(env, ShapeMPC(RodModel(), gate.limits), gate, seed=3, max_steps=25))


def test_the_mpc_reaches_the_goal_on_the_environment(steps):
    assert steps[0].shape_error >= 0.06
    assert steps[-1].shape_error < 2e-3
    assert steps[-1].success


def test_steps_tell_what_was_really_done(steps):
    assert steps[0].control_ms is None
    assert not steps[0].displacement.any()
    for step in steps:
        error = np.linalg.norm(step.truth - step.goal, axis=1).mean()
        assert step.shape_error == pytest.approx(error, abs=1e-12)
    moved = steps[-1].truth[0] - steps[0].truth[0]
    np.testing.assert_allclose(sum(step.displacement[:3] for step in steps), moved, atol=1e-9)


def test_metrics_of_an_episode(steps):
    metrics = overall_metrics([steps, steps[:3]])
    first = metrics["episodes"][0]
    assert first["initial_shape_error_mm"] == pytest.approx(1e3 * steps[0].shape_error)
    assert first["final_shape_error_mm"] == pytest.approx(1e3 * steps[-1].shape_error)
    assert first["steps"] == 25
    assert steps[first["steps_to_success"]].success
    assert not steps[first["steps_to_success"] - 1].success
    assert metrics["success_rate"] == 0.5
    assert metrics["success"] is False
    assert metrics["control_ms"]["p99"] >= metrics["control_ms"]["median"] > 0.0
    assert metrics["tracking_ms"] is None
    assert metrics["tracking_ptp3d_mm"] == 0.0


def test_an_episode_that_ended_early_at_the_goal_is_no_success(steps):
    ended = [*steps[:-1], replace(steps[-1], termination="collision")]
    assert steps[-1].success
    assert not episode_metrics(ended)["success"]


def test_metrics_are_plain_json(steps, tmp_path):
    unknown = [replace(step, tracking_ptp3d=float("nan")) for step in steps]
    write_metrics(tmp_path / "metrics.json", overall_metrics([unknown]))
    text = (tmp_path / "metrics.json").read_text()
    assert "NaN" not in text
    assert json.loads(text)["tracking_ptp3d_mm"] is None
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_wild_commands_pass_the_gate_cut_and_the_episode_goes_on(env):
    wild = Scripted(BoundaryDisplacement.from_vector(np.tile([-1.0, 0.3, 0.0, 5.0, 0.0, 1.0], 2)))
    gate = gate_for(env.unwrapped.config)
    made = list(run_episode(env, wild, gate, seed=0, max_steps=5))
    config = env.unwrapped.config
    for step in made[1:]:
        assert {"translation step", "rotation step"} <= set(step.reasons)
        sizes = np.abs(step.displacement.reshape(2, 2, 3))
        assert sizes[:, 0].max() <= config.max_translation_step * (1 + 1e-6)
    assert episode_metrics(made)["safety_cuts"]["translation step"] == len(made) - 1


def test_pulling_apart_stops_before_the_environment_calls_it_overstretched(env):
    apart = BoundaryDisplacement.from_vector([-0.01, *[0.0] * 5, 0.01, *[0.0] * 5])
    gate = gate_for(env.unwrapped.config)
    made = list(run_episode(env, Scripted(apart), gate, seed=0, max_steps=15))
    assert made[-1].termination == ""
    assert "overstretch" in made[-1].reasons


def test_a_controller_that_gives_up_ends_the_episode(env):
    gate = gate_for(env.unwrapped.config)
    made = list(run_episode(env, Scripted(None), gate, seed=0))
    assert [step.termination for step in made] == ["", "solver_failed"]
    assert made[-1].status == "nothing works"
    assert not episode_metrics(made)["success"]


def test_a_refused_command_ends_the_episode(env):
    broken = BoundaryDisplacement.zero()
    broken.left[0] = np.nan
    gate = gate_for(env.unwrapped.config)
    made = list(run_episode(env, Scripted(broken), gate, seed=0))
    assert made[-1].termination == "safety_stop"


def test_the_gate_holds_every_action_of_the_environment(env):
    config = env.unwrapped.config
    gate = gate_for(config)
    env.reset(seed=0)
    for corner in np.random.default_rng(0).choice([-1.0, 1.0], (20, 10)):
        command = env.unwrapped.action_to_displacement(corner)
        gate.reset()
        reasons = gate.check(command, env.unwrapped.cell.boundary).reasons
        assert not {"translation step", "rotation step"} & set(reasons)


@pytest.mark.slow
def test_workers_do_not_change_an_episode(tmp_path):
    found = []
    for workers in (1, 2):
        out = tmp_path / f"{workers}"
        control(episodes=3, seed=2, max_steps=3, workers=workers, out=out)
        metrics = json.loads((out / "metrics.json").read_text())
        for entry in [metrics, *metrics["episodes"]]:
            entry["control_ms"] = entry["tracking_ms"] = None
        found.append(metrics)
    assert found[0] == found[1]


def test_the_command_writes_a_report_and_refuses_to_overwrite(tmp_path, capsys):
    out = tmp_path / "report"
    control(model="rod", episodes=2, seed=5, max_steps=3, out=out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["controller"] == "mpc"
    assert len(metrics["episodes"]) == 2
    assert "metrics.json" in capsys.readouterr().out.replace("\n", "")
    with pytest.raises(FileExistsError, match="--overwrite"):
        control(model="rod", episodes=1, max_steps=1, out=out)
    control(model="rod", episodes=1, max_steps=1, out=out, overwrite=True)
    assert len(json.loads((out / "metrics.json").read_text())["episodes"]) == 1
    (out / "policy.safetensors").touch()
    with pytest.raises(FileExistsError, match=r"holds policy\.safetensors"):
        control(model="rod", episodes=1, max_steps=1, out=out, overwrite=True)


@pytest.mark.parametrize("finished", [0, 1])
def test_ctrl_c_keeps_the_finished_episodes(tmp_path, monkeypatch, finished):
    starts = []

    def interrupted(self, goal, boundary, properties):
        starts.append(goal)
        if len(starts) > finished:
            raise KeyboardInterrupt
        return reset(self, goal, boundary, properties)

    reset = ShapeMPC.reset
    monkeypatch.setattr(ShapeMPC, "reset", interrupted)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt, match="of 3 episodes"):
        control(model="rod", episodes=3, max_steps=2, out=out)
    assert out.exists() == bool(finished)
    if finished:
        assert len(json.loads((out / "metrics.json").read_text())["episodes"]) == finished


def test_bad_requests_are_refused(tmp_path):
    with pytest.raises(ValueError, match="ShapeControl-v0"):
        make_env("dlo_gym/NoSuchThing-v0")
    with pytest.raises(ValueError, match="observer"):
        make_env("dlo_gym/ShapeControl-v0", observer="psychic")
    with pytest.raises(ValueError, match="no_such_option"):
        make_env("dlo_gym/ShapeControl-v0", no_such_option=1)
    with pytest.raises(ValueError, match="policy"):
        make_controller("rl", gate_for(ShapeEnvConfig()).limits, ShapeEnvConfig())
    with pytest.raises(ValueError, match="goal is a shape"):
        control(env="CartPole-v1", out=tmp_path / "a")
    with pytest.raises(ValueError, match="episodes"):
        control(episodes=0, out=tmp_path / "b")
    with pytest.raises(ValueError, match="policy: the mpc controller takes none"):
        control(policy=tmp_path / "policy.safetensors", out=tmp_path / "c")
    assert list(tmp_path.iterdir()) == []
