"""The file of the shape predictor's weights: safetensors, which holds numbers and no code."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import WeightsError

SCHEMA = "dlo-shape-predictor/1"
SHIPPED = Path(__file__).parent / "weights" / "shape_predictor.safetensors"
ACTION_SIZE = 7
DEPTHS = {"state": 3, "action": 2, "prediction": 4}

Float32 = NDArray[np.float32]
Layer = tuple[Float32, Float32]


@dataclass(frozen=True)
class Scales:
    """What one unit of the network's inputs and outputs is.

    Attributes:
        position: [m].
        translation: of a clamp [m].
        turn: of a clamp's change of tangent [-].
        change: of the predicted change of a coordinate [m].
    """

    position: float = 0.1
    translation: float = 0.006
    turn: float = 0.04
    change: float = 0.006


class Layers(NamedTuple):
    """The network: per block its layers' (weight (out, in), bias (out,)).

    Attributes:
        state: 3 n -> hidden, three layers.
        action: 7 -> hidden / 2, two layers, shared by the clamps.
        prediction: 2 hidden -> 3 n, four layers.
        guess: (14, 3 n) linear first guess of the change from both actions.
    """

    state: list[Layer]
    action: list[Layer]
    prediction: list[Layer]
    guess: Float32


class Weights(NamedTuple):
    """Attributes: ``layers``, ``scales``, and ``training``: how they came about."""

    layers: Layers
    scales: Scales
    training: dict[str, Any]


def save_weights(file: Path, weights: Weights) -> None:
    """Writes ``file``, whole or not at all.

    Raises:
        WeightsError: if it cannot be written.
    """
    tensors = {"guess": weights.layers.guess}
    for block in DEPTHS:
        for i, (weight, bias) in enumerate(getattr(weights.layers, block)):
            tensors[f"{block}.{i}.weight"], tensors[f"{block}.{i}.bias"] = weight, bias
    metadata = {
        "schema": SCHEMA,
        "scales": json.dumps(asdict(weights.scales)),
        "training": json.dumps(weights.training),
    }
    with written_aside(file, WeightsError) as part:
        part.write_bytes(save(tensors, metadata))


def load_weights(file: Path) -> Weights:
    """Reads and checks ``file``.

    Raises:
        WeightsError: naming the file, what was expected and what it holds.
    """
    if not file.is_file():
        raise WeightsError(
            f"{file}: no such file; expected weights of schema {SCHEMA}: reinstall dlo-gym for the"
            " shipped ones, or make them by  dlo rollouts  and  dlo train-surrogate"
        )
    try:
        with safe_open(file, framework="np") as stored:
            metadata = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"{file}: expected a safetensors file, got a damaged one: {error}"
        ) from error
    if metadata.get("schema") != SCHEMA:
        raise WeightsError(f"{file}: expected schema {SCHEMA}, got {metadata.get('schema')}")
    try:
        scales = Scales(**json.loads(metadata["scales"]))
        training = json.loads(metadata["training"])
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{file}: damaged metadata: {error!r}") from error
    for name, shape in _expected_shapes(file, tensors).items():
        got = tensors[name].shape if name in tensors else "none"
        if got != shape:
            raise WeightsError(f"{file}: tensor {name}: expected shape {shape}, got {got}")
        if tensors[name].dtype != np.float32 or not np.isfinite(tensors[name]).all():
            raise WeightsError(f"{file}: tensor {name}: expected finite float32 values")
    blocks = [
        [(tensors[f"{block}.{i}.weight"], tensors[f"{block}.{i}.bias"]) for i in range(depth)]
        for block, depth in DEPTHS.items()
    ]
    return Weights(Layers(*blocks, guess=tensors["guess"]), scales, training)


def _expected_shapes(file: Path, tensors: dict[str, Float32]) -> dict[str, tuple[int, ...]]:
    """Shapes that follow from those of the first layer and of the guess."""
    first, guess = tensors.get("state.0.weight"), tensors.get("guess")
    if first is None or guess is None or first.ndim != 2 or guess.ndim != 2:
        raise WeightsError(f"{file}: expected the tensors state.0.weight and guess as matrices")
    (hidden, size), half = first.shape, len(first) // 2
    if size % 3:
        raise WeightsError(f"{file}: tensor state.0.weight: expected 3 n columns, got {size}")
    widths = {
        "state": (size, hidden, hidden, hidden),
        "action": (ACTION_SIZE, half, half),
        "prediction": (2 * hidden, hidden, hidden, hidden, size),
    }
    shapes: dict[str, tuple[int, ...]] = {"guess": (2 * ACTION_SIZE, size)}
    for block, sizes in widths.items():
        for i in range(len(sizes) - 1):
            shapes[f"{block}.{i}.weight"] = (sizes[i + 1], sizes[i])
            shapes[f"{block}.{i}.bias"] = (sizes[i + 1],)
    return shapes
