import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from dlo_gym.exceptions import WeightsError
from dlo_gym.rod.properties import RodProperties
from dlo_gym.surrogate.conditioning import Conditioning
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.weights_file import (
    SHIPPED,
    SHIPPED_ONE_ROD,
    Layers,
    Scales,
    Weights,
    load_weights,
    save_weights,
)


def random_weights(n_nodes: int = 7, hidden: int = 8, seed: int = 0) -> Weights:
    rng = np.random.default_rng(seed)

    def block(*sizes):
        return [
            (
                rng.normal(0.0, 1.5 / np.sqrt(a), (b, a)).astype(np.float32),
                rng.normal(0.0, 0.1, b).astype(np.float32),
            )
            for a, b in itertools.pairwise(sizes)
        ]

    size, half = 3 * n_nodes, hidden // 2
    layers = Layers(
        block(size, hidden, hidden, hidden),
        block(7, half, half),
        block(2 * hidden, hidden, hidden, hidden, size),
        rng.normal(0.0, 0.3, (14, size)).astype(np.float32),
    )
    return Weights(layers, Scales(), {"seed": seed})


def random_weights_for_many_rods(seed: int = 0) -> Weights:
    one = random_weights(seed=seed)
    rng = np.random.default_rng(seed)
    units = sum(len(bias) for block in one.layers[:3] for _, bias in block)

    def layer(inputs, outputs):
        weight = rng.normal(0.0, 0.3, (outputs, inputs)).astype(np.float32)
        return weight, rng.normal(0.0, 0.1, outputs).astype(np.float32)

    conditioning = Conditioning(
        np.array([-4.0, 0.6, 0.0, 0.0], np.float32),
        np.array([0.0, 1.0, 0.1, 3.0], np.float32),
        [layer(4, 6), layer(6, 5)],
        layer(5, 2 * units),
    )
    guess = rng.normal(0.0, 0.3, (7, *one.layers.guess.shape)).astype(np.float32)
    return Weights(one.layers._replace(guess=guess), one.scales, {}, conditioning, "silu")


@pytest.fixture
def file(tmp_path) -> Path:
    save_weights(tmp_path / "w.safetensors", random_weights())
    return tmp_path / "w.safetensors"


@pytest.fixture
def file_for_many_rods(tmp_path) -> Path:
    save_weights(tmp_path / "w.safetensors", random_weights_for_many_rods())
    return tmp_path / "w.safetensors"


def rewrite(file: Path, change) -> None:
    """Stores the file again with tensors and metadata changed in place."""
    with safe_open(file, framework="np") as stored:
        metadata = dict(stored.metadata())
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    change(tensors, metadata)
    save_file(tensors, file, metadata)


def test_weights_survive_the_disk(file):
    stored, expected = load_weights(file), random_weights()
    assert stored.scales == expected.scales
    assert stored.training == {"seed": 0}
    for block in ("state", "action", "prediction"):
        pairs = zip(getattr(stored.layers, block), getattr(expected.layers, block), strict=True)
        for (weight, bias), (weight_expected, bias_expected) in pairs:
            np.testing.assert_array_equal(weight, weight_expected)
            np.testing.assert_array_equal(bias, bias_expected)
    np.testing.assert_array_equal(stored.layers.guess, expected.layers.guess)
    assert stored.activation == "relu"
    assert stored.conditioning is None
    assert stored.for_rod(RodProperties(0.5)) is stored


def test_weights_for_many_rods_survive_the_disk(file_for_many_rods):
    stored, expected = load_weights(file_for_many_rods), random_weights_for_many_rods()
    assert stored.activation == "silu"
    for got, known in zip(stored.conditioning[:2], expected.conditioning[:2], strict=True):
        np.testing.assert_array_equal(got, known)
    for rod in (RodProperties(0.5), RodProperties(0.7, 0.005, 3e6, 2e3, 0.2, (1.0, 2.0, 0.0))):
        one, same = stored.for_rod(rod), expected.for_rod(rod)
        assert one.scales == same.scales
        for block, known in zip(one.layers[:3], same.layers[:3], strict=True):
            for (weight, bias), (weight_expected, bias_expected) in zip(block, known, strict=True):
                np.testing.assert_array_equal(weight, weight_expected)
                np.testing.assert_array_equal(bias, bias_expected)
        np.testing.assert_array_equal(one.layers.guess, same.layers.guess)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(WeightsError, match=r"nothing.safetensors: no such file"):
        ShapePredictor.load(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("keep", [0, 5, 200, 3000])
def test_a_truncated_file_is_named(file, keep):
    content = file.read_bytes()
    file.write_bytes(content[:keep])
    with pytest.raises(WeightsError, match=r"w.safetensors: expected a safetensors file"):
        load_weights(file)


def set_schema(tensors, metadata):
    metadata["schema"] = "dlo-shape-predictor/9"


def drop_scales(tensors, metadata):
    del metadata["scales"]


def unknown_scale(tensors, metadata):
    metadata["scales"] = json.dumps({"position": 1.0, "smell": 2.0})


def negative_scale(tensors, metadata):
    metadata["scales"] = json.dumps({"position": -1.0})


def drop_tensor(tensors, metadata):
    del tensors["prediction.2.bias"]


def drop_first(tensors, metadata):
    del tensors["state.0.weight"]


def wrong_shape(tensors, metadata):
    tensors["action.1.weight"] = np.zeros((3, 3), np.float32)


def not_finite(tensors, metadata):
    tensors["guess"] = tensors["guess"] * np.float32(np.nan)


def wrong_type(tensors, metadata):
    tensors["state.1.bias"] = tensors["state.1.bias"].astype(np.float64)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_schema, r"expected schema dlo-shape-predictor/2.*got dlo-shape-predictor/9"),
        (drop_scales, "scales"),
        (unknown_scale, "smell"),
        (negative_scale, "position: expected a positive number, got -1.0"),
        (drop_tensor, r"prediction.2.bias: expected shape \(8,\), got none"),
        (drop_first, r"state.0.weight"),
        (wrong_shape, r"action.1.weight: expected shape \(4, 4\), got \(3, 3\)"),
        (not_finite, "guess: expected finite"),
        (wrong_type, r"state.1.bias: expected finite float32"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(file, change, message):
    rewrite(file, change)
    with pytest.raises(WeightsError, match=rf"w\.safetensors.*{message}"):
        load_weights(file)


def drop_groups(tensors, metadata):
    del tensors["groups.low"]


def narrow_modulation(tensors, metadata):
    tensors["modulation.0.weight"] = tensors["modulation.0.weight"][1:]


def drop_embedding(tensors, metadata):
    del tensors["embedding.1.weight"]


def guess_of_one_rod(tensors, metadata):
    tensors["guess"] = tensors["guess"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop_groups, r"groups.low: expected shape \(4,\), got none"),
        (narrow_modulation, r"modulation.0.weight: expected shape \(154, 5\), got \(153, 5\)"),
        (drop_embedding, r"embedding.1.weight as a matrix"),
        (guess_of_one_rod, r"guess: expected shape \(7, 14, 21\), got \(14, 21\)"),
    ],
)
def test_what_is_wrong_for_many_rods_is_named(file_for_many_rods, change, message):
    rewrite(file_for_many_rods, change)
    with pytest.raises(WeightsError, match=rf"w\.safetensors.*{message}"):
        load_weights(file_for_many_rods)


def test_the_shipped_weights_say_how_they_were_trained():
    training = load_weights(SHIPPED).training
    assert training["seed"] == 0
    assert training["rollouts"]["youngs_modulus_max"] == 1e7
    assert load_weights(SHIPPED_ONE_ROD).training["rollouts"]["n_rollouts"] == 2500
    assert len(training["data_sha256"]) == 64
    assert SHIPPED.with_name("MODEL_CARD.md").is_file()
