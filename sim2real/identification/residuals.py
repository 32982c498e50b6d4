"""Residuals of several motions and their Jacobian, by parameters in prior deviations."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.parameters import Grip, Parameter, grips_of, rod_of, values_of
from sim2real.identification.prediction import ROD, Model, Prediction, predict

LOST = 0.3  # counted along each axis where the rod could not follow [m]
STEADY = 0.3  # [m per prior deviation]


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
        parameters: of the ``prior`` of the model.
        model: of the motion.
        callback: called with the RMS [m] of every trial.
    """

    def __init__(
        self,
        motions: Sequence[CableMotion],
        parameters: Sequence[Parameter],
        model: Model,
        callback: Callable[[float], None] | None = None,
    ) -> None:
        self._motions = motions
        self._parameters = parameters
        self._model: Model = model
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
        for motion, (points, _) in self.predicted(z):
            there = np.where(np.isfinite(points), points, motion.points + LOST)
            parts.append(motion.difference(there).ravel())
        return np.concatenate(parts)

    def jacobian(self, z: Array) -> Array:
        """(n_rows, n_parameters) [m per prior deviation]."""
        values = values_of(self._parameters, z)
        slopes = [p.slope(v) for p, v in zip(self._parameters, values, strict=True)]
        return np.concatenate([
            np.einsum(
                "tnij,tnjp->tnip",
                motion.projectors,
                _by_values(by, values, grips_of(values, motion, self._model), self._model) * slopes,
            ).reshape(-1, len(values))
            for motion, (_, by) in self.predicted(z)
        ])  # fmt: skip

    def weights(self, z: Array) -> Array:
        """(n_rows,) of the residuals: 1 where the rod moves steadily, less where it answers a prior
        deviation by more than ``STEADY``. A snap or a whip enlarges the errors of the first sample,
        which nobody knows, as it does those of the parameters."""
        answer = np.linalg.norm(self.jacobian(z), axis=1)
        return 1.0 / np.hypot(1.0, answer / STEADY)

    def rms(self, z: Array) -> float:
        """Over all points seen [m]; NaN where the rod could not follow one."""
        squares, count = 0.0, 0
        for motion, (points, _) in self.predicted(z):
            squares += float((motion.difference(points) ** 2).sum())
            count += int(motion.seen.sum())
        return float(np.sqrt(squares / count))

    def predicted(self, z: Array) -> list[tuple[CableMotion, Prediction]]:
        """Every motion with its prediction."""
        if not np.array_equal(z, self._z):
            values = values_of(self._parameters, z)
            self._predictions = [
                predict(
                    motion.held([g.rotation for g in grips_of(values, motion, self._model)]),
                    rod_of(values, motion, self._model),
                    self._model,
                )
                for motion in self._motions
            ]
            self._z = np.array(z)
            if self._callback is not None:
                self._callback(self.rms(z))
        return list(zip(self._motions, self._predictions, strict=True))


def _by_values(by: Array, values: Array, grips: Sequence[Grip], model: Model) -> Array:
    """Derivatives (..., 14) by ``prediction.COLUMNS`` as those by the parameters' values.

    That stretch follows EI is neglected.
    """
    EI, GJ = by[..., [0]], by[..., [1]]
    rod = by[..., 2 : len(ROD) if model == "motion" else len(ROD) - 2]
    turns = [
        by[..., len(ROD) + 3 * side : len(ROD) + 3 * side + 3] @ grip.axes
        for side, grip in enumerate(grips)
    ]
    return np.concatenate([(EI + GJ) / values[0], GJ / values[1], rod, *turns], axis=-1)
