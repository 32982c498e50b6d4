import json
import pickle
import shutil
import signal
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from control import policy_env, rl
from control.policy import PolicyController, feature_map, sample_points
from control.policy_env import PolicyObservation
from control.rl_checkpoints import load_checkpoint
from dlo_gym.cli import main
from dlo_gym.envs import tasks
from dlo_gym.exceptions import DloError

SMALL = {
    "steps": 140,
    "hidden": (16, 16),
    "batch_size": 32,
    "buffer_size": 1000,
    "learning_starts": 120,
    "eval_every": 70,
    "eval_episodes": 1,
    "test_episodes": 1,
    "checkpoint_every": 70,
}


@pytest.fixture(scope="module")
def env():
    env = PolicyObservation(gym.make(rl.ENV_IDS["state"]))
    yield env
    env.close()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "run"
    rl.train_rl(out, **SMALL)
    return out


def new_model(env, **changes):
    settings = {"observer": "state", "seed": 0, "goal_distance": (0.06, 0.25)} | changes
    names = ("hidden", "batch_size", "buffer_size", "learning_starts")
    return rl._new_model(
        env,
        rl.TrainingConfig(
            learning_rate=1e-3,
            discount=0.9,
            gradient_steps=1,
            **settings,
            **{name: SMALL[name] for name in names},
        ),
    )


def test_a_missing_library_is_named_with_the_command_that_adds_it():
    code = (
        "import sys; sys.modules['stable_baselines3'] = None;"
        "from dlo_gym.cli import main; sys.exit(main(['train-rl', '--out', 'nowhere']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1
    assert "pip install 'dlo-gym[train]'" in " ".join(run.stderr.split())


def test_the_policy_reads_points_of_the_same_story(env):
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    inner = env.unwrapped
    np.testing.assert_allclose(
        observation["achieved_goal"], sample_points(inner.estimate.centerline), atol=1e-6
    )
    np.testing.assert_allclose(observation["desired_goal"], sample_points(inner.goal), atol=1e-6)
    after, reward, _, _, info = env.step(np.zeros(10, dtype=np.float32))
    batch = env.compute_reward(
        np.stack([after["achieved_goal"]] * 2), np.stack([after["desired_goal"]] * 2), [info, info]
    )
    assert batch[0] == reward
    error = tasks.shape_error(inner.cell.rod_state.positions, inner.goal)
    assert reward == pytest.approx(-error / policy_env.REWARD_UNIT, rel=0.2)


def test_a_failure_costs_in_relabelled_transitions_too(env):
    observation, _ = env.reset(seed=0)
    points = np.stack([observation["achieved_goal"]] * 2)
    rewards = env.compute_reward(points, points, [{"termination": "overstretch"}, {}])
    np.testing.assert_allclose(rewards, [-policy_env.FAILURE_COST, 0.0])


def test_the_exported_policy_is_the_actors_mean(env):
    model = new_model(env)
    policy = rl.export_policy(model, env.unwrapped.clamp_action)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        expected, _ = model.predict(observation, deterministic=True)
        keys = ("achieved_goal", "desired_goal", "observation")
        inputs = np.concatenate([observation[key] for key in keys]).astype(np.float64)
        np.testing.assert_allclose(policy(inputs), expected, atol=1e-5)
        inner = env.unwrapped
        displacement = PolicyController(policy).control(
            inner.estimate, inner.cell.boundary, inner.goal
        )
        np.testing.assert_allclose(inner.displacement_to_action(displacement), expected, atol=1e-5)


def test_features_are_the_same_in_torch(env):
    observation, _ = env.reset(seed=0)
    extractor = rl.LinearFeatures(env.observation_space)
    tensors = {key: torch.as_tensor(value)[None] for key, value in observation.items()}
    matrix, offset = feature_map()
    keys = ("achieved_goal", "desired_goal", "observation")
    inputs = np.concatenate([observation[key] for key in keys])
    np.testing.assert_allclose(extractor(tensors)[0], matrix @ inputs + offset, atol=1e-4)


def test_a_run_leaves_policy_scores_and_checkpoint(trained):
    metrics = json.loads((trained / "metrics.json").read_text())
    for name in ("hold_still", "untrained_policy", "trained_policy"):
        assert metrics[name]["final_shape_error_mm"] > 0
    assert metrics["steps"] == 140
    lines = (trained / "evaluations.jsonl").read_text().splitlines()
    assert [json.loads(line)["steps"] for line in lines] == [70, 140]
    assert [path.name for path in trained.glob("checkpoint*")] == ["checkpoint-000000140"]
    assert list((trained / "tensorboard").iterdir())
    PolicyController(trained / "policy.safetensors")


def test_a_worse_policy_does_not_replace_the_best(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    (newest,) = (tmp_path / "run").glob("checkpoint-*")
    progress = json.loads((newest / "progress.json").read_text())
    (newest / "progress.json").write_text(json.dumps(progress | {"best_error": 0.0}))
    best = (trained / "policy.safetensors").read_bytes()
    rl.train_rl(tmp_path / "run", **SMALL | {"steps": 145}, resume=True)
    assert len((tmp_path / "run" / "evaluations.jsonl").read_text().splitlines()) == 3
    assert (tmp_path / "run" / "policy.safetensors").read_bytes() == best


def test_holding_still_keeps_the_start_error(env):
    inner_env = gym.make(rl.ENV_IDS["state"])
    _, info = inner_env.reset(seed=11)
    error = rl.final_errors(inner_env, rl.HoldStill(), [11])
    assert error == pytest.approx(info["shape_error"], abs=1e-6)


def test_an_output_folder_is_not_overwritten_unasked(trained, capsys):
    with pytest.raises(FileExistsError, match="pass --overwrite"):
        rl.train_rl(trained, **SMALL)
    assert main(["train-rl", "--out", str(trained)]) == 1
    assert "pass --overwrite" in " ".join(capsys.readouterr().err.split())
    assert (trained / "policy.safetensors").is_file()


def test_a_folder_of_other_things_is_not_deleted(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(FileExistsError, match=r"thesis\.tex"):
        rl.train_rl(tmp_path, **SMALL, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_resume_goes_on_with_model_and_replay_buffer(trained, env):
    model, best_error = load_checkpoint(trained, env, seed=0)
    assert model.num_timesteps == 140
    assert model.replay_buffer.size() == 140
    assert 0.0 < best_error < 0.5
    stored = model.replay_buffer.observations["achieved_goal"][:140]
    assert (np.abs(stored).max(axis=(1, 2)) > 0.1).all()
    rl.train_rl(trained, **SMALL | {"steps": 160}, resume=True)
    assert json.loads((trained / "metrics.json").read_text())["steps"] == 160
    assert [path.name for path in trained.glob("checkpoint*")] == ["checkpoint-000000160"]
    with pytest.raises(ValueError, match="has 160 already, got 150"):
        rl.train_rl(trained, **SMALL | {"steps": 150}, resume=True)


def test_a_run_interrupted_in_its_last_test_is_finished_by_resume(trained):
    before = json.loads((trained / "metrics.json").read_text())
    (trained / "metrics.json").unlink()
    rl.train_rl(trained, **SMALL | {"steps": before["steps"]}, resume=True)
    assert json.loads((trained / "metrics.json").read_text()) == before


def test_resume_refuses_other_settings_and_empty_folders(trained, tmp_path):
    with pytest.raises(ValueError, match="other settings: seed 0 -> 1"):
        rl.train_rl(trained, **SMALL, seed=1, resume=True)
    with pytest.raises(FileNotFoundError, match="no run to resume"):
        rl.train_rl(tmp_path, **SMALL, resume=True)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0),
        ("discount", 1.0),
        ("learning_rate", 0.0),
        ("learning_starts", 100),
        ("buffer_size", 50),
        ("hidden", ()),
        ("test_episodes", 0),
        ("seed", -1),
        ("goal_distance", (0.2, 0.1)),
    ],
)
def test_a_bad_setting_is_refused_by_name_before_anything_is_written(name, value, tmp_path):
    with pytest.raises(ValueError, match=name):
        rl.train_rl(tmp_path / "run", **SMALL | {name: value})
    assert not (tmp_path / "run").exists()


def test_a_damaged_checkpoint_is_named(tmp_path, env):
    folder = tmp_path / "checkpoint-000000010"
    folder.mkdir()
    (folder / "model.zip").write_bytes(b"not a zip")
    with pytest.raises(DloError, match="checkpoint-000000010 is damaged"):
        load_checkpoint(tmp_path, env, seed=0)


def test_a_damaged_replay_buffer_is_named(trained, tmp_path, env):
    (newest,) = trained.glob("checkpoint-*")
    shutil.copytree(newest, tmp_path / newest.name)
    (tmp_path / newest.name / "replay_buffer.pkl").write_bytes(b"not a pickle")
    with pytest.raises(DloError, match=f"{newest.name} is damaged"):
        load_checkpoint(tmp_path, env, seed=0)


class GoneSince:
    """What a replay buffer of another version may hold."""


def test_a_checkpoint_of_another_version_is_named(trained, tmp_path, env, monkeypatch):
    (newest,) = trained.glob("checkpoint-*")
    folder = shutil.copytree(newest, tmp_path / newest.name)
    progress = json.loads((folder / "progress.json").read_text())
    for changed, message in (
        (progress | {"format": "dlo-gym checkpoint 9"}, "checkpoint 1', got 'dlo-gym checkpoint 9"),
        ({"best_error": 0.1}, "checkpoint 1', got None"),
        ([], "is damaged"),
    ):
        (folder / "progress.json").write_text(json.dumps(changed))
        with pytest.raises(DloError, match=f"{newest.name}.*{message}"):
            load_checkpoint(tmp_path, env, seed=0)
    (folder / "progress.json").write_text(json.dumps(progress))
    (folder / "replay_buffer.pkl").write_bytes(pickle.dumps(GoneSince()))
    monkeypatch.delattr(sys.modules[__name__], "GoneSince")
    with pytest.raises(DloError, match=f"{newest.name}.*another version.*GoneSince"):
        load_checkpoint(tmp_path, env, seed=0)


def test_a_checkpoint_for_other_grippers_is_named(trained, env):
    other = PolicyObservation(gym.make("dlo_gym/ShapeControlOneArm-v0"))
    with pytest.raises(DloError, match=r"checkpoint-.*Action spaces do not match.*\(10,\).*\(5,\)"):
        load_checkpoint(trained, other, seed=0)


def test_settings_of_another_version_are_named(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    file = tmp_path / "run" / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"entropy": 0.1}))
    with pytest.raises(DloError, match="config.json is of another version: .*entropy"):
        rl.train_rl(tmp_path / "run", **SMALL, resume=True)
    file.write_text("{")
    with pytest.raises(DloError, match="config.json is damaged"):
        rl.train_rl(tmp_path / "run", **SMALL, resume=True)


def test_resume_and_overwrite_at_once_delete_nothing(trained):
    before = sorted(path.name for path in trained.iterdir())
    with pytest.raises(ValueError, match="resume, overwrite: expected one of them"):
        rl.train_rl(trained, **SMALL, resume=True, overwrite=True)
    assert sorted(path.name for path in trained.iterdir()) == before


@pytest.mark.parametrize("step", [5, 90])  # before and after the first evaluation
def test_ctrl_c_keeps_a_checkpoint_to_resume_from(tmp_path, monkeypatch, step):
    on_step = rl.TrainingLog._on_step

    def interrupted(log):
        if log.num_timesteps == step:
            signal.raise_signal(signal.SIGINT)
        return on_step(log)

    handler = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(rl.TrainingLog, "_on_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rl.train_rl(tmp_path / "run", **SMALL)
    assert [p.name for p in (tmp_path / "run").glob("checkpoint*")] == [f"checkpoint-{step:09d}"]
    assert signal.getsignal(signal.SIGINT) is handler
    monkeypatch.undo()
    rl.train_rl(tmp_path / "run", **SMALL, resume=True)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 140


@pytest.mark.slow
def test_a_short_training_beats_the_untrained_policy(tmp_path):
    rl.train_rl(tmp_path / "run", steps=4000, eval_every=2000, test_episodes=10)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    trained, untrained = (
        metrics[name]["final_shape_error_mm"] for name in ("trained_policy", "untrained_policy")
    )
    assert trained < 0.3 * untrained
    assert trained < 0.3 * metrics["hold_still"]["final_shape_error_mm"]
