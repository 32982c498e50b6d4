"""Least squares: the parameters of which a rod moves most like the cable did."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from dlo_gym.exceptions import IdentificationFailed
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import RodProperties
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.parameters import (
    N_DAMPING,
    N_REST,
    Parameter,
    prior,
    rod_of,
    values_of,
)
from sim2real.identification.prediction import Model
from sim2real.identification.residuals import Residuals

LEARNT = 0.5  # posterior over prior deviation above which a motion told nothing of a parameter
MEMORY = 1.0  # errors less apart than this are taken as correlated [s]
ROUNDS = 2  # of estimating the errors' size and the parameters in turn
FIRST_SCALE = 0.02  # taken for it at first [m]
SMALLEST_SCALE = 1e-7  # [m]
MOST_TRIALS = 50  # in each
CONFIDENCE = 1.96  # deviations, 95 %


@dataclass(frozen=True, eq=False)
class Identified:
    """Parameters with what the motion said about them.

    Attributes:
        parameters: with their priors, in order.
        z: (n,) estimate in prior standard deviations from what is typical.
        covariance: (n, n) of z: prior and motion together, so 1 is a diagonal entry of which the
            motion told nothing.
        rms: root mean square distance that is left [m].
        properties: the rod with the estimated parameters.
    """

    parameters: tuple[Parameter, ...]
    z: Array
    covariance: Array
    rms: float
    properties: RodProperties

    @property
    def values(self) -> dict[str, float]:
        return {p.name: p.value(z) for p, z in zip(self.parameters, self.z, strict=True)}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by parameter."""
        reach = CONFIDENCE * np.sqrt(np.diag(self.covariance))
        return {
            p.name: (p.value(z - d), p.value(z + d))
            for p, z, d in zip(self.parameters, self.z, reach, strict=True)
        }

    @property
    def told(self) -> dict[str, float]:
        """Posterior over prior standard deviation: 0 where the motion told all, 1 where nothing."""
        deviations = np.sqrt(np.diag(self.covariance))
        return {p.name: float(d) for p, d in zip(self.parameters, deviations, strict=True)}

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Names of what the motion does not tell; the prior stands in."""
        return tuple(name for name, ratio in self.told.items() if ratio > LEARNT)


def fit(
    motions: Sequence[CableMotion],
    *,
    model: Model = "motion",
    start: ArrayLike | None = None,
    callback: Callable[[float], None] | None = None,
) -> Identified:
    """The parameters of which a rod moves most like the cable did in all ``motions``.

    The posterior's mode: residuals count by a scale that is estimated with the parameters, such
    that errors may be correlated at will along the cable and over a second (Newey and West 1987);
    what moves so unsteadily that it tells nothing hardly counts (``Residuals.weights``).

    Args:
        motions: of one cable.
        model: of the motion; "motion" for a rod with inertia, see ``predict``.
        start: values to start from; if None the priors' medians, or for a rod with inertia what
            is found in equilibrium with the accelerations seen.
        callback: called with the RMS [m] of every trial.

    Raises:
        ValueError: if there is no motion.
        IdentificationFailed: if the rod cannot follow the motion at the start.
    """
    if not motions:
        raise ValueError("motions: expected at least one, got none")
    parameters = prior(motions[0], model)
    if start is not None:
        values = np.asarray(start, dtype=np.float64)
        z = np.array([p.z(value) for p, value in zip(parameters, values, strict=True)])
    elif model == "motion":
        z = np.insert(
            fit(motions, model="accelerated", callback=callback).z, N_REST, [0] * N_DAMPING
        )
    else:
        z = np.zeros(len(parameters))
    residuals = Residuals(motions, parameters, model, callback)
    if not np.isfinite(residuals.rms(z)):
        raise IdentificationFailed("no rod of plausible parameters could follow the motion")
    weights, scale = residuals.weights(z), FIRST_SCALE
    for _ in range(ROUNDS):
        z = _mode(residuals, z, weights / scale)
        weights = residuals.weights(z)
        scale = _scale(residuals, z, weights)
    z = _mode(residuals, z, weights / scale)
    jacobian = residuals.jacobian(z) * (weights / scale)[:, None]
    information = jacobian.T @ jacobian + np.eye(len(z))
    return Identified(
        parameters, z, np.asarray(np.linalg.inv(information), dtype=np.float64), residuals.rms(z),
        rod_of(values_of(parameters, z), motions[0], model),
    )  # fmt: skip


def _mode(residuals: Residuals, z: Array, weights: Array) -> Array:
    """The best z from ``z`` on, with residuals times ``weights`` beside the prior's."""
    jacobian: Any = lambda z: np.concatenate(  # noqa: E731
        [residuals.jacobian(z) * weights[:, None], np.eye(len(z))]
    )
    found = least_squares(
        lambda z: np.concatenate([residuals.vector(z) * weights, z]), z, jacobian,
        method="lm", xtol=1e-4, ftol=1e-5, max_nfev=MOST_TRIALS,
    )  # fmt: skip
    return found.x


def _scale(residuals: Residuals, z: Array, weights: Array) -> float:
    """Of the weighted residuals [m] if they were independent and told as much as they do."""
    jacobian, vector = residuals.jacobian(z) * weights[:, None], residuals.vector(z) * weights
    spread = np.zeros((len(z), len(z)))
    for rows, n_samples, per_sample, period in residuals.clips():
        scores = np.einsum(
            "tr,trp->tp",
            vector[rows].reshape(n_samples, per_sample),
            jacobian[rows].reshape(n_samples, per_sample, -1),
        )
        reach = min(n_samples - 1, round(MEMORY / period))
        for lag in range(reach + 1):
            product = scores[lag:].T @ scores[: n_samples - lag]
            weight = 1.0 - lag / (reach + 1.0)
            spread += weight * (product + product.T) * (0.5 if lag == 0 else 1.0)
    information = jacobian.T @ jacobian
    inverse = np.linalg.pinv(information, rcond=1e-8, hermitian=True)
    rank = np.linalg.matrix_rank(information, tol=1e-8 * np.linalg.norm(information))
    return max(SMALLEST_SCALE, float(np.sqrt(np.trace(spread @ inverse) / max(rank, 1))))
