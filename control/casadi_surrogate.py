"""The shape predictor's network as a CasADi function, for solvers that differentiate symbolically.

The controller itself plans on ``ShapePredictor``, which is about ten times faster with its own
tangents; this is the same map for ``mpc_reference`` and for users of CasADi.
"""

from collections.abc import Callable
from math import factorial
from typing import NamedTuple

import casadi as ca
import numpy as np

from dlo_gym.surrogate.weights_file import Layer, Layers, Scales, Weights

Activation = Callable[[ca.MX], ca.MX]
ACTIVATIONS: dict[str, Activation] = {
    "relu": lambda x: ca.fmax(x, 0.0),
    "silu": lambda x: 0.5 * x * (1.0 + ca.tanh(0.5 * x)),
}

# Of the series of Rodrigues' coefficients: below 1e-9 up to 2 rad.
SERIES_TERMS = 10


def casadi_step(weights: Weights) -> ca.Function:
    """The map of ``ShapePredictor.predict`` with ``weights``, in float64.

    Returns:
        a function ``(centerline, displacement) -> next_centerline``: (3 n_nodes,) node by node
        [m]; (12,) left then right, translation [m] and rotation vector [rad] of up to 2 rad, world
        axes; (3 n_nodes,) [m].

    Raises:
        ValueError: if the weights are of a network for many rods.
    """
    if weights.conditioning is not None:
        raise ValueError("weights: expected those of one rod; take weights.for_rod(properties)")
    layers, scales = weights.layers, weights.scales
    activation = ACTIVATIONS[weights.activation]
    n = len(layers.prediction[-1][1]) // 3
    flat, displacement = ca.MX.sym("centerline", 3 * n), ca.MX.sym("displacement", 12)
    x = ca.reshape(flat, 3, n)
    heading = _heading(x[:, n - 1] - x[:, 0])
    seen = heading.T @ (x - ca.repmat(ca.sum2(x) / n, 1, n))
    twists = heading.T @ ca.reshape(displacement, 3, 4)
    left = _end(seen[:, 0], seen[:, 1], twists[:, 0], twists[:, 1], 1.0, scales)
    right = _end(seen[:, n - 1], seen[:, n - 2], twists[:, 2], twists[:, 3], -1.0, scales)

    state = _forward(layers.state, ca.vec(seen) / scales.position, activation)
    null = ca.MX(ca.DM([0, 0, 0, 1, 0, 0, 0]))
    moved, still = (
        _prediction(layers, state, actions, activation)
        for actions in ((left.features, right.features), (null, null))
    )
    offset = ca.vertcat(left.features - null, right.features - null)
    change = scales.change * (moved - still + _dm(layers.guess.T) @ offset)
    inner = ca.reshape(change, 3, n)[:, 2 : n - 2]
    change = ca.horzcat(left.shift, left.moved, inner, right.moved, right.shift)
    return ca.Function(
        "shape_step",
        [flat, displacement],
        [flat + ca.vec(heading @ change)],
        ["centerline", "displacement"],
        ["next_centerline"],
    )


class _End(NamedTuple):
    """A clamped end: changes (3,) of its node and of the next, and the action's features (7,)."""

    shift: ca.MX
    moved: ca.MX
    features: ca.MX


def _end(node: ca.MX, inner: ca.MX, shift: ca.MX, turn: ca.MX, sign: float, s: Scales) -> _End:
    edge = inner - node
    turned_edge = _rotated(edge, turn)
    length = ca.norm_2(edge)
    d3, turned = sign * edge / length, sign * turned_edge / length
    features = ca.vertcat(shift / s.translation, ca.dot(d3, turned), (turned - d3) / s.turn)
    return _End(shift, shift + turned_edge - edge, features)


def _heading(chord: ca.MX) -> ca.MX:
    """Rotation (3, 3) about the vertical that takes x to the chord's horizontal direction."""
    squared = chord[0] ** 2 + chord[1] ** 2
    level = squared >= 1e-12
    norm = ca.sqrt(ca.if_else(level, squared, 1.0))
    cosine, sine = ca.if_else(level, chord[0] / norm, 1.0), ca.if_else(level, chord[1] / norm, 0.0)
    return ca.vertcat(
        ca.horzcat(cosine, -sine, 0), ca.horzcat(sine, cosine, 0), ca.horzcat(0, 0, 1)
    )


def _rotated(vector: ca.MX, turn: ca.MX) -> ca.MX:
    """Rodrigues' formula by its series in the squared angle, which is smooth at zero."""
    squared = ca.dot(turn, turn)
    first = sum((-squared) ** k / factorial(2 * k + 1) for k in range(SERIES_TERMS))
    second = sum((-squared) ** k / factorial(2 * k + 2) for k in range(SERIES_TERMS))
    across = ca.cross(turn, vector)
    return vector + first * across + second * ca.cross(turn, across)


def _prediction(
    layers: Layers, state: ca.MX, actions: tuple[ca.MX, ca.MX], activation: Activation
) -> ca.MX:
    """The prediction block on the embedded state and actions; its last layer is linear."""
    embedded = [_forward(layers.action, action, activation) for action in actions]
    weight, bias = layers.prediction[-1]
    inner = _forward(layers.prediction[:-1], ca.vertcat(state, *embedded), activation)
    return _dm(weight) @ inner + _dm(bias)


def _forward(layers: list[Layer], value: ca.MX, activation: Activation) -> ca.MX:
    for weight, bias in layers:
        value = activation(_dm(weight) @ value + _dm(bias))
    return value


def _dm(array: np.ndarray) -> ca.DM:
    return ca.DM(array.astype(np.float64))
