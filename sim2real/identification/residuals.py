"""Residuals of several motions and their Jacobian, by parameters in prior deviations."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.parameters import Parameter, properties_of
from sim2real.identification.prediction import at_rest, in_motion

LOST = 0.3  # distance counted where the rod could not follow [m]
STEP = 3e-3  # of differences, in prior deviations
EI, GJ, REST, LENGTH = 0, 1, slice(3, 6), 6  # columns of rod.sensitivity.PARAMETERS


class Clip(NamedTuple):
    """Where a motion's residuals are: ``n_samples`` times ``per_sample`` ``rows``."""

    rows: slice
    n_samples: int
    per_sample: int
    period: float


class Residuals:
    """What remains between motions and the rod's, as functions of z, (n_parameters,) in prior
    deviations. What belongs to the last z is remembered.

    Args:
        motions: of one cable.
        parameters: those of ``AT_REST`` or ``IN_MOTION``.
        dynamic: whether the rod has inertia.
        callback: called with the RMS [m] of every trial.
    """

    def __init__(
        self,
        motions: Sequence[CableMotion],
        parameters: Sequence[Parameter],
        dynamic: bool,
        callback: Callable[[float], None] | None = None,
    ) -> None:
        self._motions = motions
        self._parameters = parameters
        self._dynamic = dynamic
        self._callback = callback
        self._z = np.full(len(parameters), np.nan)
        self._points: list[Array] = []
        self._jacobian: Array | None = None

    def clips(self) -> Iterator[Clip]:
        first = 0
        for motion in self._motions:
            last = first + motion.points.size
            period = float(np.median(np.diff(motion.stamps)))
            yield Clip(slice(first, last), len(motion), motion.points[0].size, period)
            first = last

    def vector(self, z: Array) -> Array:
        """(n_rows,) [m]."""
        self._predict(z)
        return self._of(self._points)

    def jacobian(self, z: Array) -> Array:
        """(n_rows, n_parameters) [m per prior deviation]."""
        self._predict(z)
        if self._jacobian is None:
            here = self._of(self._points)
            self._jacobian = np.column_stack(
                [
                    (self._of(self._in_motion(z + step)) - here) / STEP
                    for step in STEP * np.eye(len(z))
                ]
            )
        return self._jacobian

    def rms(self, z: Array) -> float:
        """Over all points seen [m]; NaN where the rod could not follow one."""
        self._predict(z)
        squares, count = 0.0, 0
        for motion, points in zip(self._motions, self._points, strict=True):
            squares += float((motion.difference(points) ** 2).sum())
            count += int(motion.seen.sum())
        return float(np.sqrt(squares / count))

    def _of(self, predicted: Sequence[Array]) -> Array:
        parts = []
        for motion, points in zip(self._motions, predicted, strict=True):
            there = np.where(np.isfinite(points), points, motion.points + LOST)
            parts.append(motion.difference(there).ravel())
        return np.concatenate(parts)

    def _values(self, z: Array) -> Array:
        return np.array([p.value(a) for p, a in zip(self._parameters, z, strict=True)])

    def _predict(self, z: Array) -> None:
        if np.array_equal(z, self._z):
            return
        self._z, self._jacobian = np.array(z), None
        if self._dynamic:
            self._points = self._in_motion(z)
        else:
            values = self._values(z)
            predictions = [at_rest(m, properties_of(values, m)) for m in self._motions]
            self._points = [prediction.points for prediction in predictions]
            self._jacobian = np.concatenate([
                self._by_z(values, motion, prediction.by_parameters)
                for motion, prediction in zip(self._motions, predictions, strict=True)
            ])  # fmt: skip
        if self._callback is not None:
            self._callback(self.rms(z))

    def _in_motion(self, z: Array) -> list[Array]:
        values = self._values(z)
        return [in_motion(motion, properties_of(values, motion)) for motion in self._motions]

    def _by_z(self, values: Array, motion: CableMotion, by_rod: Array) -> Array:
        """Chain rule from the rod's parameters to z; that stretch follows EI is neglected."""
        columns = np.concatenate(
            [
                by_rod[..., [EI]] + by_rod[..., [GJ]],
                by_rod[..., [GJ]],
                by_rod[..., REST],
                by_rod[..., [LENGTH]] * values[5],
            ],
            axis=-1,
        )
        spreads = [np.log(p.spread) if p.positive else p.spread for p in self._parameters]
        jacobian = np.einsum("tnij,tnjp->tnip", motion.projectors, columns * spreads)
        return jacobian.reshape(-1, len(values))
