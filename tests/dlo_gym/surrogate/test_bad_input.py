"""Settings, options and files that cannot be right are refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest

from dlo_gym.exceptions import DatasetError, DloError, WeightsError
from dlo_gym.surrogate.evaluation import evaluate_predictor
from dlo_gym.surrogate.rollouts import Manifest, rollouts
from dlo_gym.surrogate.simulation import RolloutSettings
from dlo_gym.surrogate.sweep import SweepSettings, evaluate_surrogate
from dlo_gym.surrogate.weights_file import SHIPPED

torch = pytest.importorskip("torch")

from dlo_gym.surrogate.train import Trainer, TrainingSettings, train_surrogate  # noqa: E402

SETTINGS = [
    (RolloutSettings, {"n_rollouts": 2.5}, "n_rollouts: expected an integer .* got 2.5"),
    (RolloutSettings, {"n_actions": 0}, "n_actions: expected an integer of at least 1, got 0"),
    (RolloutSettings, {"n_steps": 0}, "n_steps: expected an integer of at least 1, got 0"),
    (RolloutSettings, {"shard_size": -1}, "shard_size: expected an integer .* got -1"),
    (RolloutSettings, {"seed": -1}, "seed: expected an integer of at least 0, got -1"),
    (RolloutSettings, {"n_elements": 3}, "n_elements: expected an integer of at least 4, got 3"),
    (RolloutSettings, {"length_min": 0.7}, "length_min, length_max: expected .* 0.7 and 0.6"),
    (RolloutSettings, {"length_max": np.inf}, "length_min, length_max: expected .* inf"),
    (RolloutSettings, {"radius_min": 0.0}, "radius_min, radius_max: expected 0 < .* got 0.0"),
    (RolloutSettings, {"radius_max": 0.02}, "radius_max: expected at most .* 0.009 m, got 0.02 m"),
    (RolloutSettings, {"youngs_modulus_max": np.nan}, "youngs_modulus_min, .* and nan"),
    (RolloutSettings, {"poisson_ratio_max": 0.7}, "poisson_ratio: expected -1 < nu <= 0.5"),
    (RolloutSettings, {"density": -1.0}, "density: expected a positive number .* got -1.0"),
    (RolloutSettings, {"rest_curvature_max": np.inf}, "rest_curvature_max: expected .* got inf"),
    (RolloutSettings, {"translation": np.nan}, "translation: expected 0 to pi, got nan"),
    (RolloutSettings, {"rotation": 4.0}, "rotation: expected 0 to pi, got 4.0"),
    (TrainingSettings, {"batch_size": 0}, "batch_size: expected at least 1, got 0"),
    (TrainingSettings, {"hidden": 0}, "hidden: expected at least 1, got 0"),
    (TrainingSettings, {"learning_rate": np.inf}, "learning_rate, noise: expected .* got inf"),
    (TrainingSettings, {"noise": -1.0}, "learning_rate, noise: expected .* and -1.0"),
    (TrainingSettings, {"validation_share": 1.0}, "validation_share: expected 0 to 1, got 1.0"),
    (SweepSettings, {"radii": ()}, "radii: expected at least one value, got none"),
    (SweepSettings, {"radii": (0.02,)}, "radius_max: expected at most .* got 0.02 m"),
    (SweepSettings, {"n_steps": (1, 60)}, r"n_steps: expected 0 to 50 each, got \(1, 60\)"),
    (SweepSettings, {"stride": 0}, "stride: expected at least 1, got 0"),
]


@pytest.mark.parametrize(("kind", "change", "message"), SETTINGS)
def test_impossible_settings(kind, change, message):
    with pytest.raises(ValueError, match=message):
        kind(**change)


OPTIONS = {
    "rollouts": (
        lambda folder: rollouts(folder, resume=True, overwrite=True),
        "resume, overwrite: expected one of them at most, got both",
    ),
    "sweep": (
        lambda folder: evaluate_surrogate(folder, resume=True, overwrite=True),
        "resume, overwrite: expected one of them at most, got both",
    ),
    "training": (
        lambda folder: train_surrogate(folder, resume=True, overwrite=True),
        "resume, overwrite: expected one of them at most, got both",
    ),
    "weights that are not used": (
        lambda folder: train_surrogate(folder, weights=SHIPPED),
        "weights: training starts from none",
    ),
    "evaluation that writes": (
        lambda folder: train_surrogate(folder, evaluate=True, overwrite=True),
        "evaluate: trains nothing; expected neither resume nor overwrite",
    ),
    "threads": (
        lambda folder: train_surrogate(folder, threads=0),
        "threads: expected at least 1, got 0",
    ),
    "workers": (
        lambda folder: rollouts(folder, RolloutSettings(n_rollouts=1), workers=-1),
        "workers: expected 0 or more, got -1",
    ),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_options_that_conflict(case, tmp_path):
    attempt, message = OPTIONS[case]
    with pytest.raises(ValueError, match=message):
        attempt(tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_steps": (30,)}, r"n_steps: expected 0 to 20 each, got \(30,\)"),
        ({"stride": 0}, "stride: expected at least 1, got 0"),
        ({"noise": np.nan}, "noise: expected 0 or a positive length .* got nan"),
    ],
)
def test_evaluation_of_moves_that_are_not_there(small_rollouts, options, message):
    with pytest.raises(ValueError, match=message):
        evaluate_predictor(lambda _: lambda x, _: x, small_rollouts, **options)


def manifest(folder: Path, content: object) -> None:
    (folder / "manifest.json").write_text(json.dumps(content))


FILES = {
    "manifest of another version": (
        lambda folder: manifest(folder, {"schema": "dlo-rollouts/9"}),
        lambda folder: Manifest.read(folder),
        "manifest.json: expected schema dlo-rollouts/2, got dlo-rollouts/9",
    ),
    "manifest that is a list": (
        lambda folder: manifest(folder, []),
        lambda folder: Manifest.read(folder),
        "manifest.json: damaged",
    ),
    "manifest of unknown settings": (
        lambda folder: manifest(
            folder, {"schema": "dlo-rollouts/2", "settings": {"colour": "red"}, "shards": {}}
        ),
        lambda folder: Manifest.read(folder),
        "manifest.json: damaged: .*colour",
    ),
    "sweep that is damaged": (
        lambda folder: (folder / "sweep.json").write_text('{"settings": '),
        lambda folder: evaluate_surrogate(folder, resume=True),
        "sweep.json: damaged",
    ),
    "weights that are missing": (
        lambda folder: None,
        lambda folder: evaluate_surrogate(folder / "out", weights=(folder / "none.safetensors",)),
        "none.safetensors: no such file",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_files_of_another_version_or_damaged(case, tmp_path):
    write, attempt, message = FILES[case]
    write(tmp_path)
    with pytest.raises(DloError, match=message) as caught:
        attempt(tmp_path)
    assert isinstance(caught.value, DatasetError | WeightsError)


CHECKPOINTS = {
    "of before versions had names": (
        lambda content: content.pop("schema"),
        "expected a checkpoint of schema dlo-training/1, got None",
    ),
    "of a later version": (
        lambda content: content.update(schema="dlo-training/9"),
        "expected a checkpoint of schema dlo-training/1, got dlo-training/9",
    ),
    "of a network of another shape": (
        lambda content: content["network"].popitem(),
        "a network of another shape: ",
    ),
}


@pytest.mark.parametrize("case", CHECKPOINTS)
def test_checkpoints_of_another_version(case, small_rollouts, tmp_path):
    change, message = CHECKPOINTS[case]
    trainer = Trainer(small_rollouts, TrainingSettings(steps=1, batch_size=4, hidden=8))
    file = tmp_path / "checkpoint.pt"
    trainer.save(file)
    content = torch.load(file, weights_only=True)
    change(content)
    torch.save(content, file)
    with pytest.raises(WeightsError, match=f"checkpoint.pt: {message}"):
        trainer.load(file)
