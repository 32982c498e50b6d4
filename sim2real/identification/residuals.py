"""Residuals of several motions and their Jacobian, by parameters in prior deviations."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.parameters import Parameter, properties_of
from sim2real.identification.prediction import Prediction, at_rest

LOST = 0.3  # distance counted where the rod could not follow [m]
EI, GJ, WEIGHT, REST, LENGTH = 0, 1, 2, slice(3, 6), 6  # columns of rod.sensitivity.PARAMETERS


class Clip(NamedTuple):
    """Where a motion's residuals are: ``n_samples`` times ``per_sample`` ``rows``."""

    rows: slice
    n_samples: int
    per_sample: int
    period: float


class Residuals:
    """What remains between motions and the rod's, as functions of z; the last z is remembered."""

    def __init__(
        self,
        motions: Sequence[CableMotion],
        parameters: Sequence[Parameter],
        callback: Callable[[float], None] | None = None,
    ) -> None:
        self._motions = motions
        self._parameters = parameters
        self._callback = callback
        self._z = np.full(len(parameters), np.nan)
        self._predictions: list[Prediction] = []

    def clips(self) -> Iterator[Clip]:
        first = 0
        for motion in self._motions:
            last = first + motion.points.size
            period = float(np.median(np.diff(motion.stamps)))
            yield Clip(slice(first, last), len(motion), motion.points[0].size, period)
            first = last

    def vector(self, z: Array) -> Array:
        """(n_rows,) [m]."""
        parts = []
        for motion, prediction in self._predicted(z):
            there = np.isfinite(prediction.points)
            parts.append(
                motion.difference(np.where(there, prediction.points, motion.points + LOST))
            )
        return np.concatenate([part.ravel() for part in parts])

    def jacobian(self, z: Array) -> Array:
        """(n_rows, n_parameters) [m per prior deviation]."""
        return np.concatenate([
            self._by_z(z, motion, prediction) for motion, prediction in self._predicted(z)
        ])  # fmt: skip

    def rms(self, z: Array) -> float:
        """Over all points seen [m]; NaN where the rod could not follow one."""
        squares, count = 0.0, 0
        for motion, prediction in self._predicted(z):
            squares += float((motion.difference(prediction.points) ** 2).sum())
            count += int(motion.seen.sum())
        return float(np.sqrt(squares / count))

    def _values(self, z: Array) -> Array:
        return np.array([p.value(a) for p, a in zip(self._parameters, z, strict=True)])

    def _predicted(self, z: Array) -> list[tuple[CableMotion, Prediction]]:
        if not np.array_equal(z, self._z):
            values = self._values(z)
            self._predictions = [
                at_rest(motion, properties_of(values, motion)) for motion in self._motions
            ]
            self._z = np.array(z)
            if self._callback is not None:
                self._callback(self.rms(z))
        return list(zip(self._motions, self._predictions, strict=True))

    def _by_z(self, z: Array, motion: CableMotion, prediction: Prediction) -> Array:
        """Chain rule from the rod's parameters to z; that stretch follows EI is neglected."""
        by_rod = prediction.by_parameters
        values = self._values(z)
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
        return np.einsum("tnij,tnjp->tnip", motion.projectors, columns * spreads).reshape(
            -1, len(z)
        )
