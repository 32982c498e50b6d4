import dataclasses
import json
from pathlib import Path

import pytest
from PIL import Image

from dlo_gym.surrogate import sweep as module
from dlo_gym.surrogate.evaluation import evaluate_predictor
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.simulation import Rollouts, simulate_rollout
from dlo_gym.surrogate.sweep import SweepSettings, evaluate_surrogate, part_errors
from dlo_gym.surrogate.weights_file import SHIPPED, SHIPPED_ONE_ROD

TINY = SweepSettings(
    youngs_moduli=(1e6, 1e7), radii=(0.004,), n_steps=(1, 4), n_rollouts=3, chunk=2, stride=20
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sweep") / "out"
    evaluate_surrogate(folder, TINY, workers=1)
    return folder


def scores(folder: Path) -> list[dict]:
    return json.loads((folder / "scores.json").read_text())["scores"]


def test_means_are_those_of_the_predictor_on_these_rods(finished):
    settings = TINY.rollouts(1e7, 0.004)
    rollouts = Rollouts.joined(simulate_rollout(settings, i) for i in range(3))
    for file in (SHIPPED_ONE_ROD, SHIPPED):
        predictor = ShapePredictor.load(file)
        expected = evaluate_predictor(
            lambda rod, p=predictor: p.for_rod(rod).predict, rollouts, n_steps=(1, 4), stride=20
        )
        cells = [
            cell
            for cell in scores(finished)
            if (cell["network"], cell["youngs_modulus"]) == (file.stem, 1e7)
        ]
        for cell, score in zip(cells, expected, strict=True):
            assert (cell["n_steps"], cell["n_moves"]) == (score.n_steps, score.n_moves)
            assert cell["mean_mm"] == pytest.approx(score.mean_mm, rel=1e-5)


def test_percentiles_table_and_picture(finished):
    for cell in scores(finished):
        assert cell["percentiles_mm"] == sorted(cell["percentiles_mm"])
        assert cell["percentiles_mm"][0] <= cell["mean_mm"]
    table = (finished / "scores.md").read_text().splitlines()
    rows = [line.split("|") for line in table if line.startswith("| 1e+0")]
    assert [(row[1].strip(), row[2].strip()) for row in rows] == [("1e+06", "4"), ("1e+07", "4")]
    means = {(c["youngs_modulus"], c["n_steps"], c["network"]): c["mean_mm"]
             for c in scores(finished)}  # fmt: skip
    expected = " / ".join(f"{means[1e7, 4, f.stem]:.2f}" for f in (SHIPPED_ONE_ROD, SHIPPED))
    assert rows[1][4].strip() == expected
    with Image.open(finished / "scores.png") as picture:
        assert picture.width > 500


@pytest.mark.parametrize("after", [0, 1, 3])
def test_goes_on_where_it_was_interrupted(after, finished, tmp_path, monkeypatch):
    done = []

    def interrupted(*arguments):
        if len(done) == after:
            raise KeyboardInterrupt
        done.append(arguments)
        return part_errors(*arguments)

    monkeypatch.setattr(module, "part_errors", interrupted)
    with pytest.raises(KeyboardInterrupt):
        evaluate_surrogate(tmp_path / "out", TINY, workers=1)
    monkeypatch.setattr(module, "part_errors", lambda *a: done.append(a) or part_errors(*a))
    evaluate_surrogate(tmp_path / "out", TINY, workers=1, resume=True)
    assert len(done) == len(TINY.parts)
    assert scores(tmp_path / "out") == scores(finished)


@pytest.mark.slow
def test_workers_do_not_matter(finished, tmp_path):
    evaluate_surrogate(tmp_path / "out", TINY, workers=2)
    assert scores(tmp_path / "out") == scores(finished)


def test_a_sweep_that_exists_is_spared(finished, tmp_path):
    with pytest.raises(FileExistsError, match="--overwrite"):
        evaluate_surrogate(finished, TINY, workers=1)
    with pytest.raises(ValueError, match="other settings or weights"):
        evaluate_surrogate(finished, dataclasses.replace(TINY, seed=1), workers=1, resume=True)
    with pytest.raises(ValueError, match="resume, overwrite"):
        evaluate_surrogate(finished, TINY, workers=1, resume=True, overwrite=True)
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FileExistsError, match=r"thesis\.tex"):
        evaluate_surrogate(tmp_path, TINY, workers=1, overwrite=True)


def test_files_of_one_name_are_refused(tmp_path):
    with pytest.raises(ValueError, match="different names"):
        evaluate_surrogate(tmp_path / "out", TINY, weights=(SHIPPED, SHIPPED), workers=1)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"radii": ()}, "radii"),
        ({"radii": (-0.003,)}, "radius"),
        ({"n_steps": (51,)}, "n_steps"),
        ({"chunk": 0}, "chunk"),
    ],
)
def test_settings_name_what_is_wrong(change, name):
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(TINY, **change)


def test_default_settings_are_those_of_fig_6():
    settings = SweepSettings()
    assert settings.youngs_moduli == (1e5, 5e5, 1e6, 5e6, 1e7)
    assert settings.radii == (0.003, 0.004, 0.005, 0.006)
    assert settings.n_steps == (1, 2, 3, 4)
    assert settings.n_rollouts == 500
