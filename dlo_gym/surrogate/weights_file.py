"""The file of the shape predictor's weights: safetensors, which holds numbers and no code."""

import json
from dataclasses import asdict, dataclass
from itertools import chain, islice
from math import inf
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import WeightsError
from dlo_gym.rod.properties import RodProperties
from dlo_gym.surrogate.conditioning import (
    N_GROUPS,
    N_TERMS,
    Conditioning,
    Float32,
    Layer,
    guess_terms,
)

SCHEMA_ONE_ROD, SCHEMA = "dlo-shape-predictor/1", "dlo-shape-predictor/2"
SHIPPED = Path(__file__).parent / "weights" / "shape_predictor.safetensors"
SHIPPED_ONE_ROD = SHIPPED.with_name("shape_predictor_reference.safetensors")
ACTION_SIZE = 7
DEPTHS = {"state": 3, "action": 2, "prediction": 4}


@dataclass(frozen=True)
class Scales:
    """What one unit of the network's inputs and outputs is.

    Lengths are in rod lengths for a network that knows many rods, and in metres for one rod.

    Attributes:
        position: of a node.
        translation: of a clamp.
        turn: of a clamp's change of tangent [-].
        change: of the predicted change of a coordinate.

    Raises:
        ValueError: naming the field.
    """

    position: float = 0.2
    translation: float = 0.012
    turn: float = 0.04
    change: float = 0.012

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (isinstance(value, int | float) and 0.0 < value < inf):
                raise ValueError(f"{name}: expected a positive number, got {value!r}")

    def times(self, length: float) -> "Scales":
        """For a rod of ``length`` [m]."""
        return Scales(
            self.position * length, self.translation * length, self.turn, self.change * length
        )


class Layers(NamedTuple):
    """The network: per block its layers' (weight (out, in), bias (out,)).

    Attributes:
        state: 3 n -> hidden, three layers.
        action: 7 -> hidden / 2, two layers, shared by the clamps.
        prediction: 2 hidden -> 3 n, four layers.
        guess: (14, 3 n) linear first guess of the change from both actions; of a network that
            knows many rods (7, 14, 3 n), one for each of ``guess_terms``.
    """

    state: list[Layer]
    action: list[Layer]
    prediction: list[Layer]
    guess: Float32


class Weights(NamedTuple):
    """A trained network.

    Attributes:
        layers: of the network.
        scales: of its inputs and outputs.
        training: how it came about.
        conditioning: what makes it another rod's; None where it knows one kind of rod.
        activation: between the layers: ReLU as in the paper, or SiLU.
    """

    layers: Layers
    scales: Scales
    training: dict[str, Any]
    conditioning: Conditioning | None = None
    activation: Literal["relu", "silu"] = "relu"

    def for_rod(self, properties: RodProperties) -> "Weights":
        """The same network for one rod; itself where it knows but one kind of rod."""
        if self.conditioning is None:
            return self
        gains, shifts = self.conditioning.gains_and_shifts(properties)
        folded, first = [], 0
        for weight, bias in chain(*self.layers[:3]):
            units = slice(first, first := first + len(bias))
            gain = gains[units]
            shifted = gain * bias + shifts[units]
            folded.append(
                (np.asarray(gain[:, None] * weight, np.float32), np.asarray(shifted, np.float32))
            )
        rest = iter(folded)
        state, action, prediction = (list(islice(rest, depth)) for depth in DEPTHS.values())
        terms = guess_terms(self.conditioning.inputs(properties))
        guess = np.tensordot(terms, self.layers.guess, 1).astype(np.float32)
        scales = self.scales.times(properties.length)
        return Weights(
            Layers(state, action, prediction, guess), scales, self.training, None, self.activation
        )


def save_weights(file: Path, weights: Weights) -> None:
    """Writes ``file``, whole or not at all.

    Raises:
        WeightsError: if it cannot be written.
    """
    tensors = {"guess": weights.layers.guess}
    blocks: dict[str, list[Layer]] = {name: getattr(weights.layers, name) for name in DEPTHS}
    if weights.conditioning is not None:
        low, high, embedding, modulation = weights.conditioning
        tensors |= {"groups.low": low, "groups.high": high}
        blocks |= {"embedding": embedding, "modulation": [modulation]}
    for block, pairs in blocks.items():
        for i, (weight, bias) in enumerate(pairs):
            tensors[f"{block}.{i}.weight"], tensors[f"{block}.{i}.bias"] = weight, bias
    metadata = {
        "schema": SCHEMA_ONE_ROD if weights.conditioning is None else SCHEMA,
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
    schema = metadata.get("schema")
    if schema not in (SCHEMA, SCHEMA_ONE_ROD):
        raise WeightsError(f"{file}: expected schema {SCHEMA} or {SCHEMA_ONE_ROD}, got {schema}")
    many_rods = schema == SCHEMA
    try:
        scales = Scales(**json.loads(metadata["scales"]))
        training = json.loads(metadata["training"])
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{file}: damaged metadata: {error!r}") from error
    for name, shape in _expected_shapes(file, tensors, many_rods).items():
        got = tensors[name].shape if name in tensors else "none"
        if got != shape:
            raise WeightsError(f"{file}: tensor {name}: expected shape {shape}, got {got}")
        if tensors[name].dtype != np.float32 or not np.isfinite(tensors[name]).all():
            raise WeightsError(f"{file}: tensor {name}: expected finite float32 values")

    def block(name: str, depth: int) -> list[Layer]:
        return [(tensors[f"{name}.{i}.weight"], tensors[f"{name}.{i}.bias"]) for i in range(depth)]

    state, action, prediction = (block(name, depth) for name, depth in DEPTHS.items())
    layers = Layers(state, action, prediction, tensors["guess"])
    if not many_rods:
        return Weights(layers, scales, training)
    (modulation,) = block("modulation", 1)
    conditioning = Conditioning(
        tensors["groups.low"], tensors["groups.high"], block("embedding", 2), modulation
    )
    return Weights(layers, scales, training, conditioning, "silu")


def _expected_shapes(
    file: Path, tensors: dict[str, Float32], many_rods: bool
) -> dict[str, tuple[int, ...]]:
    """Shapes that follow from those of the first layer and of the embedding."""
    first = _matrix(file, tensors, "state.0.weight")
    (hidden, size), half = first.shape, len(first) // 2
    if size % 3:
        raise WeightsError(f"{file}: tensor state.0.weight: expected 3 n columns, got {size}")
    widths = {
        "state": (size, hidden, hidden, hidden),
        "action": (ACTION_SIZE, half, half),
        "prediction": (2 * hidden, hidden, hidden, hidden, size),
    }
    shapes: dict[str, tuple[int, ...]] = {"guess": (2 * ACTION_SIZE, size)}
    if many_rods:
        units = sum(sum(sizes[1:]) for sizes in widths.values())
        first, second = (len(_matrix(file, tensors, f"embedding.{i}.weight")) for i in range(2))
        widths |= {"embedding": (N_GROUPS, first, second), "modulation": (second, 2 * units)}
        shapes |= {"groups.low": (N_GROUPS,), "groups.high": (N_GROUPS,)}
        shapes["guess"] = (N_TERMS, *shapes["guess"])
    for block, sizes in widths.items():
        for i in range(len(sizes) - 1):
            shapes[f"{block}.{i}.weight"] = (sizes[i + 1], sizes[i])
            shapes[f"{block}.{i}.bias"] = (sizes[i + 1],)
    return shapes


def _matrix(file: Path, tensors: dict[str, Float32], name: str) -> Float32:
    if name not in tensors or tensors[name].ndim != 2:
        raise WeightsError(f"{file}: expected the tensor {name} as a matrix")
    return tensors[name]
