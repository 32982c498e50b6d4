"""The rod's surrogate at run time: NumPy in, NumPy out, with exact derivatives."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.surrogate.weights_file import SHIPPED, Weights, load_weights

Float = NDArray[Any]  # of the network's dtype
Layer = tuple[Float, Float]

CLAMP_NODES = np.array([0, 1, -1, -2])  # of the elements that the clamps hold


class ShapePredictor:
    """Predicts the centerline after a motion of both clamps.

    Around the paper's network (Section IV-B1) stand what is known without learning: the rod's
    behaviour does not depend on its place and heading, a null action moves nothing, the first and
    last elements follow their clamps, and what the rod is made of matters by dimensionless groups
    alone. Rotation about the rod's own axis is without effect.

    Derivatives are hand-written forward-mode tangents.

    Args:
        weights: as loaded by ``load_weights``.
        properties: of the rod; the paper's rod of 0.5 m when omitted.
        dtype: of the network's arithmetic; all else is float64.
    """

    def __init__(
        self,
        weights: Weights,
        properties: RodProperties | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        self._weights, self._dtype = weights, np.dtype(dtype)
        self.properties = RodProperties(length=0.5) if properties is None else properties
        self.training = weights.training
        layers, self._scales, *_, activation = weights.for_rod(self.properties)
        self._activation = ACTIVATIONS[activation]
        scale = self._activation.scale
        self._state, self._action, prediction = (
            [
                ((scale * weight).astype(dtype), (scale * bias).astype(dtype))
                for weight, bias in block
            ]
            for block in (layers.state, layers.action, layers.prediction[:-1])
        )
        hidden = len(layers.state[-1][1])
        first, self._bias = prediction[0]
        self._from_state = first[:, :hidden].copy()
        self._from_actions = [part.copy() for part in np.split(first[:, hidden:], 2, axis=1)]
        self._inner, self._last = prediction[1:], layers.prediction[-1][0].astype(dtype)
        self._guess = np.ascontiguousarray(layers.guess.T, dtype)
        self._null = np.zeros((2, 7), dtype)
        self._null[:, 3] = 1.0
        self._still, _ = self._actions(self._null, None)

    @classmethod
    def load(
        cls, path: Path | None = None, properties: RodProperties | None = None
    ) -> "ShapePredictor":
        """From a file of ``dlo train-surrogate``; the shipped weights by default.

        Raises:
            WeightsError: if the file is missing, damaged or of another version.
        """
        return cls(load_weights(SHIPPED if path is None else Path(path)), properties)

    def for_rod(self, properties: RodProperties) -> "ShapePredictor":
        """The same network for another rod.

        Rods beyond those of its training are taken for the nearest of them, of one that is not
        uniform its means (see ``conditioning.groups``).
        """
        return ShapePredictor(self._weights, properties, self._dtype)

    @property
    def n_nodes(self) -> int:
        return len(self._last) // 3

    def predict(
        self,
        centerline: ArrayLike,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses | None = None,
    ) -> Array:
        """The centerline (n_nodes, 3) [m] after ``displacement`` from ``centerline`` (n_nodes, 3).

        ``boundary`` is not needed: the ends of the centerline say where the clamps are.

        Raises:
            ValueError: on another number of nodes, values that are not finite, or a displacement
                of one clamp only.
        """
        del boundary
        return self._evaluate(centerline, displacement, None, None)[0]

    def predict_with_jacobian(
        self, centerline: ArrayLike, displacement: BoundaryDisplacement
    ) -> tuple[Array, Array]:
        """The prediction, and its derivative (n_nodes, 3, 12) with respect to the displacement's
        vector: translation and rotation vector of the left clamp, then of the right.

        Raises:
            ValueError: as ``predict``.
        """
        return self._evaluate(centerline, displacement, None, np.eye(12))

    def predict_with_tangents(
        self,
        centerline: ArrayLike,
        displacement: BoundaryDisplacement,
        centerline_tangents: ArrayLike,
        displacement_tangents: ArrayLike,
    ) -> tuple[Array, Array]:
        """The prediction, and its derivatives (n_nodes, 3, k) in k directions in which centerline
        and displacement change together: (n_nodes, 3, k) and (12, k).

        Raises:
            ValueError: as ``predict``, and if the tangents' shapes do not fit.
        """
        dx = np.asarray(centerline_tangents, dtype=np.float64)
        da = np.asarray(displacement_tangents, dtype=np.float64)
        if da.ndim != 2 or len(da) != 12:
            raise ValueError(f"displacement_tangents: expected shape (12, k), got {da.shape}")
        if dx.shape != (self.n_nodes, 3, da.shape[1]):
            raise ValueError(
                f"centerline_tangents: expected shape ({self.n_nodes}, 3, {da.shape[1]}),"
                f" got {dx.shape}"
            )
        return self._evaluate(centerline, displacement, dx, da)

    def _evaluate(
        self,
        centerline: ArrayLike,
        displacement: BoundaryDisplacement,
        dx: Array | None,
        da: Array | None,
    ) -> tuple[Array, Array]:
        x = np.asarray(centerline, dtype=np.float64)
        if x.shape != (self.n_nodes, 3) or not np.isfinite(x).all():
            raise ValueError(
                f"centerline: expected finite values of shape ({self.n_nodes}, 3), got"
                f" shape {x.shape}"
            )
        if displacement.right is None:
            raise ValueError(
                "displacement: expected a motion of both clamps, got one of the left clamp only;"
                " the network knows no rod with a free end, use the rod model"
            )
        twists = np.stack([displacement.left, displacement.right]).reshape(2, 2, 3)
        cosine, sine, turning = _heading(x)
        seen = _turn(x - x.mean(axis=0), cosine, -sine)
        twists = _turn(twists.reshape(4, 3), cosine, -sine).reshape(2, 2, 3)
        if da is None:
            change, _ = self._change(seen, twists, None, None)
            return x + _turn(change, cosine, sine), np.empty((self.n_nodes, 3, 0))
        dtwists = _turn(da.reshape(4, 3, -1), cosine, -sine)
        if dx is None:
            dseen, dheading = None, 0.0
        else:
            dheading = np.einsum("i,ik->k", turning, dx[-1] - dx[0])
            dseen = _turn(dx - dx.mean(axis=0), cosine, -sine) - dheading * _quarter_turn(seen)
            dtwists = dtwists - dheading * _quarter_turn(twists.reshape(4, 3))
        dtwists = dtwists.reshape(2, 2, 3, -1)
        change, dchange = self._change(seen, twists, dseen, dtwists)
        moved = x + _turn(change, cosine, sine)
        if dx is None:
            return moved, _turn(dchange, cosine, sine)
        return moved, dx + _turn(dchange + dheading * _quarter_turn(change), cosine, sine)

    def _change(
        self, x: Array, twists: Array, dx: Array | None, dtwists: Array | None
    ) -> tuple[Array, Array]:
        """The change (n, 3) of a centered centerline seen along its heading, and its tangents
        (n, 3, k); ``twists`` (2, 2, 3) are translation and rotation vector of each clamp."""
        left, right = (
            _end(x[a], x[b], twist, sign)
            for a, b, twist, sign in ((0, 1, twists[0], 1.0), (-1, -2, twists[1], -1.0))
        )
        actions = np.stack([self._features(left), self._features(right)])
        if dtwists is None:
            change, _ = self._network(x, actions, None, None)
            dchange = np.empty((self.n_nodes, 3, 0))
            change[CLAMP_NODES] = [left.shift, left.moved, right.shift, right.moved]
            return change, dchange
        edges = (None, None) if dx is None else (dx[1] - dx[0], dx[-2] - dx[-1])
        dleft = _end_tangents(left, dtwists[0], edges[0])
        dright = _end_tangents(right, dtwists[1], edges[1])
        dactions = np.stack(
            [self._feature_tangents(left, dleft), self._feature_tangents(right, dright)]
        )
        change, dchange = self._network(x, actions, dx, dactions)
        change[CLAMP_NODES] = [left.shift, left.moved, right.shift, right.moved]
        dchange[CLAMP_NODES] = [dleft.shift, dleft.moved, dright.shift, dright.moved]
        return change, dchange

    def _features(self, end: "_End") -> Float:
        """The seven numbers of an action; see ``dataset.encode``."""
        features = np.empty(7, self._dtype)
        features[:3] = end.shift / self._scales.translation
        features[3] = end.d3 @ end.turned
        features[4:] = (end.turned - end.d3) / self._scales.turn
        return features

    def _feature_tangents(self, end: "_End", tangents: "_EndTangents") -> Float:
        features = np.empty((7, tangents.shift.shape[1]), self._dtype)
        features[:3] = tangents.shift / self._scales.translation
        features[3] = end.d3 @ tangents.turned + end.turned @ tangents.d3
        features[4:] = (tangents.turned - tangents.d3) / self._scales.turn
        return features

    def _network(
        self, x: Array, actions: Float, dx: Array | None, dactions: Float | None
    ) -> tuple[Array, Array]:
        """The change (n, 3) and its tangents (n, 3, k): guess(A) + f(S, A) - f(S, 0)."""
        state, dstate = (x / self._scales.position).astype(self._dtype).ravel(), None
        if dx is None:
            state = self._from_state @ _forward(self._state, state, self._activation)
        else:
            dstate = (dx / self._scales.position).astype(self._dtype).reshape(len(state), -1)
            state, dstate = _forward_tangents(self._state, state, dstate, self._activation)
            state, dstate = self._from_state @ state, self._from_state @ dstate
        moved, dmoved = self._actions(actions, dactions)
        if dmoved is not None and dstate is not None:
            dmoved += dstate
        moved, dmoved = self._inner_layers(state + moved, dmoved)
        still, dstill = self._inner_layers(state + self._still, dstate)
        offset = (actions - self._null).ravel()
        change = self._physical(self._last @ (moved - still) + self._guess @ offset)
        if dmoved is None or dactions is None:
            return change, np.empty((self.n_nodes, 3, 0))
        if dstill is not None:
            dmoved -= dstill
        dactions = dactions.reshape(len(offset), -1)
        return change, self._physical(self._last @ dmoved + self._guess @ dactions)

    def _actions(self, actions: Float, dactions: Float | None) -> tuple[Float, Float | None]:
        """What both actions (2, 7) add in the prediction block's first layer, and its tangents."""
        value, tangents = self._bias, None
        for i, block in enumerate(self._from_actions):
            if dactions is None:
                value = value + block @ _forward(self._action, actions[i], self._activation)
                continue
            embedded, dembedded = _forward_tangents(
                self._action, actions[i], dactions[i], self._activation
            )
            value = value + block @ embedded
            tangents = block @ dembedded if tangents is None else tangents + block @ dembedded
        return value, tangents

    def _physical(self, change: Float) -> Array:
        """(3 n, ...) in network units as (n, 3, ...) [m]."""
        change = change.reshape(self.n_nodes, 3, *change.shape[1:])
        return self._scales.change * change.astype(np.float64)

    def _inner_layers(self, value: Float, tangents: Float | None) -> tuple[Float, Float | None]:
        """From the sum that enters the prediction block's first activation to its last one."""
        if tangents is None:
            return _forward(self._inner, self._activation.value(value), self._activation), None
        value, slope = self._activation.value_and_slope(value)
        return _forward_tangents(self._inner, value, tangents * slope[:, None], self._activation)


class _End(NamedTuple):
    """A clamped end: its clamp's ``shift`` (3,), the clamped element from the end node, ``edge``
    (3,), before and ``turned_edge`` after, and the element's tangent ``d3`` and ``turned``."""

    shift: Array
    edge: Array
    turned_edge: Array
    rotation: Array
    rotation_vector: Array
    length: float
    sign: float

    @property
    def d3(self) -> Array:
        return self.edge * (self.sign / self.length)

    @property
    def turned(self) -> Array:
        return self.turned_edge * (self.sign / self.length)

    @property
    def moved(self) -> Array:
        """The change (3,) of the clamped element's inner node."""
        return self.shift + self.turned_edge - self.edge


class _EndTangents(NamedTuple):
    """Tangents (3, k) of what ``_End`` names so."""

    shift: Array
    moved: Array
    d3: Array
    turned: Array


def _end(node: Array, inner: Array, twist: Array, sign: float) -> _End:
    edge = inner - node
    length = max(float(np.sqrt(edge @ edge)), 1e-9)
    rotation = _rotation(twist[1])
    return _End(twist[0], edge, rotation @ edge, rotation, twist[1], length, sign)


def _end_tangents(end: _End, dtwist: Array, dedge: Array | None) -> _EndTangents:
    # d(R e) = (J_l dr) x (R e) + R de, with J_l the left Jacobian of SO(3).
    turned = -_skew(end.turned_edge) @ (_left_jacobian(end.rotation_vector) @ dtwist[1])
    scale = end.sign / end.length
    if dedge is None:
        nothing = np.zeros_like(turned)
        return _EndTangents(dtwist[0], dtwist[0] + turned, nothing, scale * turned)
    turned = turned + end.rotation @ dedge
    stretch = (end.edge @ dedge) / end.length**2
    return _EndTangents(
        dtwist[0],
        dtwist[0] + turned - dedge,
        scale * (dedge - np.outer(end.edge, stretch)),
        scale * (turned - np.outer(end.turned_edge, stretch)),
    )


class _Activation(NamedTuple):
    """Elementwise: the function alone, and with its derivative; of ``scale`` times the sum that
    enters a unit, which is multiplied into the weights beforehand."""

    value: Callable[[Float], Float]
    value_and_slope: Callable[[Float], tuple[Float, Float]]
    scale: float


def _relu(x: Float) -> Float:
    return np.maximum(x, 0.0)


def _relu_and_slope(x: Float) -> tuple[Float, Float]:
    active = x > 0
    return x * active, active


def _silu(half: Float) -> Float:
    """x / (1 + exp(-x)) of x / 2."""
    value = np.tanh(half)
    value += 1.0
    value *= half
    return value


def _silu_and_slope(half: Float) -> tuple[Float, Float]:
    doubled = np.tanh(half)  # the logistic function, twice
    doubled += 1.0
    value = half * doubled
    return value, doubled + value * (2.0 - doubled)


ACTIVATIONS = {
    "relu": _Activation(_relu, _relu_and_slope, 1.0),
    "silu": _Activation(_silu, _silu_and_slope, 0.5),
}


def _forward(layers: list[Layer], value: Float, activation: _Activation) -> Float:
    for weight, bias in layers:
        value = activation.value(weight @ value + bias)
    return value


def _forward_tangents(
    layers: list[Layer], value: Float, tangents: Float, activation: _Activation
) -> tuple[Float, Float]:
    for weight, bias in layers:
        value, slope = activation.value_and_slope(weight @ value + bias)
        tangents = weight @ tangents
        tangents *= slope[:, None]
    return value, tangents


def _heading(x: Array) -> tuple[float, float, Array]:
    """Cosine and sine of the chord's angle about the vertical, and that angle's gradient (3,) in
    the chord; zero angle where the ends are above each other."""
    a, b, _ = x[-1] - x[0]
    squared = float(a * a + b * b)
    if squared < 1e-12:
        return 1.0, 0.0, np.zeros(3)
    norm = np.sqrt(squared)
    return a / norm, b / norm, np.array([-b, a, 0.0]) / squared


def _turn(vectors: Array, cosine: float, sine: float) -> Array:
    """Vectors (m, 3, ...) turned about the vertical."""
    turned = np.empty_like(vectors)
    turned[:, 0] = cosine * vectors[:, 0] - sine * vectors[:, 1]
    turned[:, 1] = sine * vectors[:, 0] + cosine * vectors[:, 1]
    turned[:, 2] = vectors[:, 2]
    return turned


def _quarter_turn(vectors: Array) -> Array:
    """The vertical crossed with vectors (m, 3), as (m, 3, 1)."""
    crossed = np.zeros((*vectors.shape, 1))
    crossed[:, 0, 0], crossed[:, 1, 0] = -vectors[:, 1], vectors[:, 0]
    return crossed


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _rotation(r: Array) -> Array:
    """Rodrigues' formula, for one vector and in a few microseconds."""
    squared = float(r @ r)
    angle = np.sqrt(squared)
    if angle < 1e-4:
        a, b = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
    skew = _skew(r)
    return np.eye(3) + a * skew + b * (skew @ skew)


def _left_jacobian(r: Array) -> Array:
    squared = float(r @ r)
    angle = np.sqrt(squared)
    if angle < 1e-3:
        b, c = 0.5 - squared / 24.0, 1.0 / 6.0 - squared / 120.0
    else:
        b, c = (1.0 - np.cos(angle)) / squared, (1.0 - np.sin(angle) / angle) / squared
    skew = _skew(r)
    return np.eye(3) + b * skew + c * (skew @ skew)
