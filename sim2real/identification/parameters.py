"""What a cable's motion can tell of it, and what is plausible before it has moved.

No force is measured, so shapes and motion only tell ratios: stiffness over weight. The mass of a
metre is given and never asked for. Stretch and shear follow bending as in a solid round section;
both are too stiff to matter.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array, exp_so3
from dlo_gym.rod.properties import SHEAR_CORRECTION, RodProperties
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.prediction import GRAVITY, Model


class Parameter(NamedTuple):
    """One parameter and what is plausible for it, as a normal or log-normal distribution.

    Attributes:
        name, unit: of the parameter.
        typical: its median.
        spread: standard deviation; of a positive parameter the factor of one.
        positive: whether it is log-normal.
    """

    name: str
    unit: str
    typical: float
    spread: float
    positive: bool = False

    def value(self, z: float) -> float:
        """At ``z`` standard deviations from what is typical."""
        if self.positive:
            return float(self.typical * self.spread**z)
        return float(self.typical + self.spread * z)

    def z(self, value: float) -> float:
        """The inverse of ``value``."""
        if self.positive:
            return float(np.log(value / self.typical) / np.log(self.spread))
        return float((value - self.typical) / self.spread)

    def slope(self, value: float) -> float:
        """d(value)/dz."""
        return value * float(np.log(self.spread)) if self.positive else self.spread


N_REST, N_DAMPING = 6, 2


def prior(motion: CableMotion, model: Model) -> tuple[Parameter, ...]:
    """The parameters of a ``model`` of the cable in ``motion``; wide on purpose.

    Six for its shapes, two more for its motion, and six where it is not known how the clamps hold.
    """
    length = motion.length
    parameters = [
        Parameter("EI / weight", "m³", 2e-3 * length**3, 10.0, positive=True),
        Parameter("GJ / EI", "", 0.7, 1.6, positive=True),
        Parameter("rest curvature 1", "1/m", 0.0, 2.0 / length),
        Parameter("rest curvature 2", "1/m", 0.0, 2.0 / length),
        Parameter("rest twist", "1/m", 0.0, 1.0 / length),
        Parameter("length", "m", length, 1.1, positive=True),
    ]
    if model == "motion":
        parameters.append(Parameter("external damping", "1/s", 1.0, 5.0, positive=True))
        parameters.append(Parameter("internal damping", "s", 0.02, 5.0, positive=True))
    if not motion.grip_known:
        for side in ("left", "right") if motion.right is not None else ("left",):
            parameters.append(Parameter(f"{side} roll", "rad", 0.0, 1.5))
            parameters.append(Parameter(f"{side} tilt 1", "rad", 0.0, 0.4))
            parameters.append(Parameter(f"{side} tilt 2", "rad", 0.0, 0.4))
    return tuple(parameters)


def values_of(parameters: Sequence[Parameter], z: Array) -> Array:
    return np.array([p.value(a) for p, a in zip(parameters, z, strict=True)])


def rod_of(values: Array, motion: CableMotion, model: Model) -> RodProperties:
    """The rod with the ``values`` of the ``prior``'s parameters."""
    stiffness, twist, kappa_1, kappa_2, tau, length = map(float, values[:N_REST])
    external, internal = map(float, values[N_REST:][:N_DAMPING]) if model == "motion" else (0, 0)
    EI = stiffness * motion.mass_per_length * GRAVITY
    EA = 4.0 * EI / motion.radius**2
    return RodProperties(
        length, motion.radius, EI=EI, GJ=twist * EI, EA=EA, kGA=SHEAR_CORRECTION * EA / 3.0,
        mass_per_length=motion.mass_per_length, rest_curvature=(kappa_1, kappa_2, tau),
        external_damping=external, internal_damping=internal,
    )  # fmt: skip


class Grip(NamedTuple):
    """How a clamp holds, beside what is known of its pose: a roll, then two tilts [rad].

    Attributes:
        rotation: (3, 3) R_clamp_held.
        axes: (3, 3) in columns the axes, in the held frame, that roll and tilts turn it about.
    """

    rotation: Array
    axes: Array

    @classmethod
    def of(cls, roll: float, tilt_1: float, tilt_2: float) -> "Grip":
        first, second = exp_so3([tilt_1, 0.0, 0.0]), exp_so3([0.0, tilt_2, 0.0])
        tilted = first @ second
        return cls(
            exp_so3([0.0, 0.0, roll]) @ tilted,
            np.column_stack([tilted[2], second[0], [0.0, 1.0, 0.0]]),
        )


def grips_of(values: Array, motion: CableMotion, model: Model) -> list[Grip]:
    """Of the left clamp, then of the right; none where the clamps' poses are known in full."""
    if motion.grip_known:
        return []
    angles = values[N_REST + (N_DAMPING if model == "motion" else 0) :].reshape(-1, 3)
    return [Grip.of(*map(float, row)) for row in angles]
