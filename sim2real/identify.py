"""What a cable is made of, from how it moved: tracked motion in, ``RodProperties`` out.

A cable's shape answers only to ratios of its stiffnesses and its mass, for nothing here measures a
force. So what is identified is EI over the weight of a metre, GJ over EI, the curvature at rest and
two dampings; mass is given, and stretch is not asked for.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import BoundaryPoses, CosseratRod, RodProperties, RodState

GRAVITY = 9.81
NAMES = ("EI / weight", "GJ / EI", "rest curvature 1", "rest curvature 2",
         "external damping", "internal damping")  # fmt: skip
UNITS = ("m³", "", "1/m", "1/m", "1/s", "s")
LOGARITHMIC = np.array([True, True, False, False, True, True])
LOWEST = (1e-6, 0.05, -10.0, -10.0, 1e-3, 1e-4)
HIGHEST = (1.0, 5.0, 10.0, 10.0, 10.0, 0.5)
STEPS = np.where(LOGARITHMIC, 0.05, 0.1)  # for differences: beyond the solver's own noise
LOST = 0.3  # error that a motion counts where the rod could not follow it [m]


@dataclass(frozen=True, eq=False)
class CableMotion:
    """Points seen on a cable that two clamps hold and move.

    Attributes:
        period: between samples [s].
        left, right: (n_samples, 4, 4) clamp poses; a clamp whose roll is not known is given one
            that is carried along without roll.
        points: (n_samples, n_points, 3) of the cable between the clamps [m], NaN where not seen.
        arc_length: (n_points,) of the points from the left clamp [m].
        length: of cable between the clamps [m].

    Raises:
        ValueError: if the shapes do not fit each other.
    """

    period: float
    left: Array
    right: Array
    points: Array
    arc_length: Array
    length: float

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.left.shape != (n, 4, 4) or self.right.shape != (n, 4, 4):
            raise ValueError(
                f"left, right: expected {n} poses each, as many as points has samples,"
                f" got shapes {self.left.shape} and {self.right.shape}"
            )
        if self.points.shape[1:] != (len(self.arc_length), 3):
            raise ValueError(
                f"points: expected {len(self.arc_length)} points per sample, as arc_length has,"
                f" got shape {self.points.shape}"
            )

    def boundary(self, sample: int) -> BoundaryPoses:
        return BoundaryPoses(self.left[sample], self.right[sample])

    def beginning(self, seconds: float) -> "CableMotion":
        """Its first ``seconds`` [s]."""
        n = round(seconds / self.period)
        return replace(self, left=self.left[:n], right=self.right[:n], points=self.points[:n])

    def error(self, predicted: Array) -> float:
        """Mean distance [m] of ``predicted`` points (n_samples, n_points, 3) from those seen."""
        return float(np.nanmean(np.linalg.norm(predicted - self.points, axis=-1)))


class CableParameters(NamedTuple):
    """What motion tells of a cable; fields in the order and units of ``NAMES`` and ``UNITS``."""

    stiffness_over_weight: float
    twist_over_bending: float
    rest_curvature_1: float
    rest_curvature_2: float
    external_damping: float
    internal_damping: float

    def properties(
        self, length: float, radius: float = 0.003, mass_per_length: float = 0.03
    ) -> RodProperties:
        """A rod of this behaviour; its mass per length [kg/m] only sets the scale of forces."""
        EI = self.stiffness_over_weight * mass_per_length * GRAVITY
        return RodProperties(
            length, radius, EI=EI, GJ=self.twist_over_bending * EI,
            EA=4.0 * EI / radius**2, kGA=EI / radius**2, mass_per_length=mass_per_length,
            rest_curvature=(self.rest_curvature_1, self.rest_curvature_2, 0.0),
            external_damping=self.external_damping, internal_damping=self.internal_damping,
        )  # fmt: skip

    @property
    def vector(self) -> Array:
        """(6,) with logarithms of what must be positive."""
        values = np.array(self)
        return np.where(LOGARITHMIC, np.log(np.where(LOGARITHMIC, values, 1.0)), values)

    @classmethod
    def from_vector(cls, vector: Array) -> "CableParameters":
        return cls(*(float(np.exp(v)) if log else float(v)
                     for v, log in zip(vector, LOGARITHMIC, strict=True)))  # fmt: skip


def predict(motion: CableMotion, parameters: CableParameters, n_elements: int = 16) -> Array:
    """Points (n_samples, n_points, 3) [m] from the first two samples and the clamps' motion alone.

    The rod starts in the shape of the first sample with the velocities that take it to the second.
    NaN from where it could not follow.
    """
    rod = CosseratRod(parameters.properties(motion.length), n_elements, clamp="node")
    predicted = np.full(motion.points.shape, np.nan)
    try:
        rod.restore(_in_motion(first_shape(rod, motion), motion))
        predicted[0] = _at(rod.state.positions, motion)
        for sample in range(1, len(motion.points)):
            displacement = motion.boundary(sample - 1).displacement_to(motion.boundary(sample))
            state = rod.advance(displacement, motion.period, dt=motion.period)
            predicted[sample] = _at(state.positions, motion)
    except RodDiverged:
        pass
    return predicted


def predict_at_rest(
    motion: CableMotion, parameters: CableParameters, n_elements: int = 16
) -> Array:
    """As ``predict``, but in equilibrium at every sample: no inertia."""
    rod = CosseratRod(parameters.properties(motion.length), n_elements, clamp="node")
    start = _curve(motion, n_elements + 1)
    predicted = [_at(rod.settle(motion.boundary(0), start).positions, motion)]
    for sample in range(1, len(motion.points)):
        displacement = motion.boundary(sample - 1).displacement_to(motion.boundary(sample))
        predicted.append(_at(rod.move(displacement).positions, motion))
    return np.array(predicted)


def predict_blend(motion: CableMotion) -> Array:
    """The first sample carried along rigidly by both clamps, blended from one to the other."""
    w = (motion.arc_length / motion.length)[:, None]
    blend = w * w * (3.0 - 2.0 * w)
    carried = []
    for clamp in (motion.left, motion.right):
        change = clamp @ np.linalg.inv(clamp[0])
        turned = motion.points[0] @ np.swapaxes(change[:, :3, :3], 1, 2)
        carried.append(turned + change[:, None, :3, 3])
    return (1.0 - blend) * carried[0] + blend * carried[1]


def first_shape(rod: CosseratRod, motion: CableMotion, rounds: int = 30) -> RodState:
    """The shape the rod takes when it is pulled at the points of the first sample until it fits."""
    nodes = motion.arc_length / motion.length * rod.n_elements
    below = np.minimum(nodes.astype(int), rod.n_elements - 1)
    weights = np.zeros((len(nodes), rod.n_nodes))
    rows = np.arange(len(nodes))
    weights[rows, below] = 1.0 - (nodes - below)
    weights[rows, below + 1] = nodes - below
    seen = np.isfinite(motion.points[0]).all(axis=1)
    weight = float(np.max(rod.properties.linear_density)) * GRAVITY * rod.properties.length
    gain = 4.0 * weight / rod.properties.length
    state = rod.settle(motion.boundary(0), _curve(motion, rod.n_nodes))
    forces = np.zeros((rod.n_nodes, 3))
    missing = motion.points[0, seen] - weights[seen] @ state.positions
    for _ in range(rounds):
        pulled = forces + gain * weights[seen].T @ missing
        rod.apply_forces(pulled)
        trial = rod.settle(motion.boundary(0), state.positions)
        left = motion.points[0, seen] - weights[seen] @ trial.positions
        if np.sum(left**2) < np.sum(missing**2):
            state, forces, missing = trial, pulled, left
        else:
            gain *= 0.5
    rod.apply_forces(np.zeros((rod.n_nodes, 3)))
    return state


STARTS = tuple(
    CableParameters(stiffness, 0.7, 0.0, 0.0, external, 0.03)
    for stiffness in (1e-3, 3e-3, 1e-2, 3e-2)
    for external in (0.5, 2.0)
)


class Identified(NamedTuple):
    """Parameters with what the motion says about them.

    Attributes:
        parameters: that fit best.
        standard_error: (6,) of ``parameters.vector``: relative for those that must be positive,
            absolute for the rest curvature. From blocks of a second, as residuals of neighbouring
            samples say the same thing (a sandwich estimate).
        rms: of what is left [m].
    """

    parameters: CableParameters
    standard_error: Array
    rms: float

    def interval(self, index: int) -> tuple[float, float]:
        """The 95 % confidence interval of parameter ``index``."""
        low, high = (
            CableParameters.from_vector(self.parameters.vector + sign * 1.96 * self.standard_error)
            for sign in (-1.0, 1.0)
        )
        return low[index], high[index]

    def undetermined(self) -> tuple[str, ...]:
        """Names of what the motion does not tell: known no better than within a factor of two, or
        for a rest curvature, than within 1/m."""
        widest = np.where(LOGARITHMIC, np.log(2.0), 1.0)
        return tuple(
            name for name, error, bound in zip(NAMES, self.standard_error, widest, strict=True)
            if 1.96 * error > bound
        )  # fmt: skip


def identify(
    motions: Sequence[CableMotion],
    start: CableParameters | None = None,
    n_elements: int = 16,
    max_iterations: int = 12,
    callback: Callable[[int, float], None] | None = None,
) -> Identified:
    """The parameters whose predictions come closest to all ``motions``, by least squares.

    Args:
        start: to begin from; when omitted the best of a few, from soft to stiff and in damping.
        n_elements: of the rod.
        max_iterations: of Gauss and Newton's method; each predicts every motion about eight times.
        callback: called with the number of predictions made and the present RMS [m].

    Raises:
        ValueError: if there is no motion.
    """
    if not motions:
        raise ValueError("motions: expected at least one, got none")
    calls = 0

    def residuals(vector: Array) -> Array:
        nonlocal calls
        parameters = CableParameters.from_vector(vector)
        parts = []
        for motion in motions:
            difference = predict(motion, parameters, n_elements) - motion.points
            difference[~np.isfinite(difference)] = LOST
            difference[~np.isfinite(motion.points)] = 0.0
            parts.append(difference.ravel())
            calls += 1
        residual = np.concatenate(parts)
        if callback is not None:
            callback(calls, float(np.sqrt(3.0 * np.mean(residual**2))))
        return residual

    if start is None:
        costs = [np.mean(np.hypot(residuals(trial.vector), 0.05)) for trial in STARTS]
        start = STARTS[int(np.argmin(costs))]
    vector = start.vector
    bounds = CableParameters(*LOWEST).vector, CableParameters(*HIGHEST).vector

    def jacobian(vector: Array) -> Array:
        here = residuals(vector)
        steps = np.where(vector + STEPS < bounds[1], STEPS, -STEPS)
        moved = [residuals(vector + step) for step in np.diag(steps)]
        return (np.stack(moved, axis=1) - here[:, None]) / steps

    jac: Any = jacobian  # SciPy's stubs only know names of schemes
    found = least_squares(
        residuals, vector, jac, bounds=bounds, loss="soft_l1", f_scale=0.05,
        xtol=1e-3, ftol=1e-3, max_nfev=max_iterations,
    )  # fmt: skip
    error = _standard_error(found.jac, found.fun, motions)
    parameters = CableParameters.from_vector(found.x)
    return Identified(parameters, error, float(np.sqrt(3.0 * np.mean(found.fun**2))))


def _standard_error(jacobian: Array, residual: Array, motions: Sequence[CableMotion]) -> Array:
    """Cluster-robust: residuals may be correlated at will within a second of one motion."""
    blocks, first = [], 0
    for motion in motions:
        row = motion.points[0].size
        per_block = max(1, round(1.0 / motion.period)) * row
        last = first + motion.points.size
        edges = np.arange(first, last, per_block)
        blocks += [slice(a, min(a + per_block, last)) for a in edges]
        first = last
    scores = np.stack([jacobian[block].T @ residual[block] for block in blocks])
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    return np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse))


def _in_motion(state: RodState, motion: CableMotion) -> RodState:
    """``state`` with the velocities that take the first sample to the second."""
    moved = _curve(motion, state.n_nodes, 1) - _curve(motion, state.n_nodes, 0)
    return replace(state, velocities=moved / motion.period)


def _curve(motion: CableMotion, n_nodes: int, sample: int = 0) -> Array:
    """(n_nodes, 3) a smooth curve through a sample's points and both clamps [m]."""
    seen = np.isfinite(motion.points[sample]).all(axis=1)
    ends = motion.left[sample, :3, 3], motion.right[sample, :3, 3]
    points = np.concatenate([ends[:1], motion.points[sample, seen], ends[1:]])
    s = np.concatenate([[0.0], motion.arc_length[seen], [motion.length]])
    return CubicSpline(s, points)(np.linspace(0.0, motion.length, n_nodes))


def _at(positions: Array, motion: CableMotion) -> Array:
    """(n_points, 3) of the rod at the points' arc lengths."""
    s = np.linspace(0.0, motion.length, len(positions))
    return np.column_stack([np.interp(motion.arc_length, s, positions[:, k]) for k in range(3)])
