"""How one network knows many rods: by the dimensionless groups that their equilibria depend on.

A uniform rod in equilibrium, its lengths counted in rod lengths L, is the same rod whenever

    EI / (w L^3),  GJ / EI,  w L / EA,  |rest curvature| L

are the same, w its weight per length. An embedding of these groups scales and shifts every layer
before its activation; for one rod this is again the plain network, with other weights.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import GRAVITY

N_GROUPS = 4
N_TERMS = 7  # of the first guess

Float32 = NDArray[np.float32]
Layer = tuple[Float32, Float32]


class Conditioning(NamedTuple):
    """What makes a rod's network of the one for many rods.

    Attributes:
        low, high: (4,) range of the groups in training; rods beyond it are taken for its edge.
        embedding: 4 -> D -> E, two layers, each followed by ReLU.
        modulation: (2 M, E) and (2 M,), from the embedding to the gains, less one, and the shifts
            of the M units of all layers in order.
    """

    low: Float32
    high: Float32
    embedding: list[Layer]
    modulation: Layer

    def inputs(self, properties: RodProperties) -> Array:
        """The rod's groups (4,), each from -1 to 1 over the range of training."""
        return scaled_groups(groups(properties), self.low, self.high)

    def gains_and_shifts(self, properties: RodProperties) -> tuple[Array, Array]:
        """(M,) each, of the units of all layers in order."""
        embedded = self.inputs(properties)
        for weight, bias in self.embedding:
            embedded = np.maximum(weight.astype(np.float64) @ embedded + bias, 0.0)
        weight, bias = self.modulation
        gains, shifts = np.split(weight.astype(np.float64) @ embedded + bias, 2)
        return 1.0 + gains, shifts


def groups(properties: RodProperties) -> Array:
    """The four groups (4,): log10 of the first, the others as they are.

    Of a rod that is not uniform, those of the uniform one with its mean compliances, weight and
    rest curvature. Rest twist does not matter: twist cannot be seen in a centerline.
    """
    p = properties
    weight = float(np.linalg.norm(GRAVITY)) * float(np.mean(p.linear_density))
    bending, twisting, stretching = (
        1.0 / float(np.mean(1.0 / np.asarray(stiffness)))
        for stiffness in (p.bending_stiffness, p.twisting_stiffness, p.stretching_stiffness)
    )
    rest = np.reshape(np.asarray(p.rest_curvature, dtype=np.float64), (-1, 3)).mean(axis=0)
    return np.array(
        [
            np.log10(bending / (weight * p.length**3)),
            twisting / bending,
            weight * p.length / stretching,
            float(np.hypot(rest[0], rest[1])) * p.length,
        ]
    )


def scaled_groups(values: Array, low: Float32, high: Float32) -> Array:
    """Groups (..., 4), each from -1 to 1 over the range (4,) to (4,); 0 where that is a point."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return (np.clip(values, low, high) - middle) / np.maximum(half, 1e-6)


def guess_terms(inputs: Array) -> Array:
    """Terms (..., 7) in the scaled groups (..., 4) that the first guess is linear in."""
    stiffness = inputs[..., :1]
    powers = [np.ones_like(stiffness), stiffness, stiffness**2, stiffness**3]
    return np.concatenate([*powers, inputs[..., 1:]], axis=-1)
