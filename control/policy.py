"""A learned policy as a controller: NumPy only, weights without code."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from control.controller import ControlDiagnostics
from dlo_gym.atomic_file import written_aside
from dlo_gym.envs.actions import ClampAction, clamp_numbers
from dlo_gym.exceptions import WeightsError
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.state import ShapeEstimate

FORMAT = "dlo-gym policy 1"
# The centerline is read at these fractions of its length: densely at the clamps, where the
# differences tell its direction.
FRACTIONS = np.array([0.0, 0.04, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 1.0])
N_POINTS = len(FRACTIONS)
N_CLAMPS = 18


def sample_points(centerline: ArrayLike) -> Array:
    """The points (..., 3 N_POINTS), flat, that a policy reads of centerlines (..., n, 3) [m]."""
    centerline = np.asarray(centerline, dtype=np.float64)
    nodes = np.rint(FRACTIONS * (centerline.shape[-2] - 1)).astype(int)
    points = centerline[..., nodes, :]
    return points.reshape(*points.shape[:-2], -1)


def feature_map() -> tuple[Array, Array]:
    """Matrix (n_features, n_inputs) and offset (n_features,) from what a policy reads, that is
    achieved points, desired points, clamps, to features of about unit size.

    They are the distance of each point to its goal, coarse (10 cm) and fine (2 cm); the turn that
    is missing at each end; the shape around its middle; and the clamps.
    """
    flat = 3 * N_POINTS
    identity = np.eye(flat)
    clamps = np.eye(N_CLAMPS)
    none = np.zeros((flat, N_CLAMPS))
    error = np.hstack([-identity, identity, none])
    ends = np.zeros((6, flat))
    ends[:3, 3:6], ends[:3, :3] = np.eye(3), -np.eye(3)
    ends[3:, -3:], ends[3:, -6:-3] = np.eye(3), -np.eye(3)
    missing_turn = np.hstack([-ends, ends, np.zeros((6, N_CLAMPS))]) / 0.02
    centred = identity - np.tile(np.eye(3), (N_POINTS, N_POINTS)) / N_POINTS
    shape = np.hstack([centred, np.zeros_like(identity), none]) / 0.1
    positions = np.tile([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 2)
    clamp_scale = np.where(positions, 5.0, 1.0)
    matrix = np.vstack(
        [
            error / 0.1,
            error / 0.02,
            missing_turn,
            shape,
            np.hstack([np.zeros((N_CLAMPS, 2 * flat)), clamps * clamp_scale[:, None]]),
        ]
    )
    offset = np.zeros(len(matrix))
    offset[-N_CLAMPS:][[2, 11]] = -5.0 * 0.34  # the clamps' height in the middle of the workspace
    return matrix, offset


@dataclass(frozen=True, eq=False)
class Policy:
    """A multi-layer perceptron with ReLU between its layers and tanh at the end.

    Attributes:
        weights: matrices (out, in), first layer first; the first takes what the policy reads:
            achieved points, desired points, clamps.
        biases: (out,) of each.
        action: what its output means.
    """

    weights: Sequence[Array]
    biases: Sequence[Array]
    action: ClampAction

    def __call__(self, inputs: Array) -> Array:
        """Action (size,) in [-1, 1] for inputs (n_inputs,)."""
        hidden = inputs
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = np.maximum(weight @ hidden + bias, 0.0)
        return np.tanh(self.weights[-1] @ hidden + self.biases[-1])

    def save(self, path: Path, **description: str) -> None:
        """Writes safetensors with ``description`` as metadata; replaces the file in one step.

        Raises:
            WeightsError: if it cannot be written.
        """
        tensors = {}
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"weight_{index}"] = np.ascontiguousarray(weight)
            tensors[f"bias_{index}"] = np.ascontiguousarray(bias)
        metadata = {"format": FORMAT, "action": json.dumps(asdict(self.action)), **description}
        with written_aside(path, WeightsError) as part:
            save_file(tensors, part, metadata)

    @classmethod
    def load(cls, path: Path) -> "Policy":
        """Reads what ``save`` wrote.

        Raises:
            WeightsError: if the file is missing, damaged or no policy of this version.
        """
        if not path.is_file():
            raise WeightsError(f"policy {path}: no such file")
        try:
            with safe_open(path, "numpy") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError) as error:
            raise WeightsError(f"policy {path}: damaged or not safetensors: {error}") from error
        if metadata.get("format") != FORMAT:
            raise WeightsError(
                f"policy {path}: expected format {FORMAT!r}, got {metadata.get('format')!r}"
            )
        try:
            action = ClampAction(**json.loads(metadata["action"]))
            n_layers = len(tensors) // 2
            weights = [tensors[f"weight_{index}"] for index in range(n_layers)]
            biases = [tensors[f"bias_{index}"] for index in range(n_layers)]
        except (KeyError, TypeError, ValueError) as error:
            raise WeightsError(f"policy {path}: incomplete: {error!r}") from error
        if {weight.ndim for weight in weights} != {2} or {bias.ndim for bias in biases} != {1}:
            shapes = {name: tensor.shape for name, tensor in tensors.items()}
            raise WeightsError(f"policy {path}: expected matrices and their biases, got {shapes}")
        sizes = [weight.shape[1] for weight in weights] + [action.size]
        expected = [6 * N_POINTS + N_CLAMPS] + [len(bias) for bias in biases]
        finite = all(np.isfinite(tensor).all() for tensor in tensors.values())
        if sizes != expected or not finite:
            raise WeightsError(
                f"policy {path}: expected finite layers that fit each other, from"
                f" {expected[0]} inputs to {action.size} actions, got sizes {sizes}"
            )
        return cls(weights, biases, action)


class PolicyController:
    """Steers the rod by a policy trained with ``dlo train-rl``.

    Args:
        policy: the policy, or the file it is in.

    Raises:
        WeightsError: if the file is missing, damaged or no policy of this version.
    """

    def __init__(self, policy: Policy | Path | str) -> None:
        self.policy = policy if isinstance(policy, Policy) else Policy.load(Path(policy))
        self._diagnostics = ControlDiagnostics()

    @property
    def diagnostics(self) -> ControlDiagnostics:
        return self._diagnostics

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        """Starts an episode.

        Raises:
            ValueError: if the policy moves another number of clamps than hold the rod.
        """
        if len(boundary.clamps) != self.policy.action.n_clamps:
            raise ValueError(
                f"policy: expected one for the {len(boundary.clamps)} clamps that hold the rod,"
                f" got one that moves {self.policy.action.n_clamps}"
            )
        self._diagnostics = ControlDiagnostics()

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        held = np.zeros(N_CLAMPS)  # of a free right end nothing
        numbers = np.concatenate([clamp_numbers(clamp) for clamp in boundary.clamps])
        held[: len(numbers)] = numbers
        inputs = np.concatenate([sample_points(estimate.centerline), sample_points(goal), held])
        return self.policy.action.to_displacement(self.policy(inputs), boundary)
