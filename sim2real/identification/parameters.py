"""What a cable's motion can tell of it, and what is plausible before it has moved.

No force is measured, so shapes and motion only tell ratios: stiffness over weight. The mass of a
metre is given and never asked for. Stretch and shear follow bending as in a solid round section;
both are too stiff to matter.
"""

from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import SHEAR_CORRECTION, RodProperties
from sim2real.identification.cable_motion import CableMotion

GRAVITY = 9.81


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


AT_REST = ("EI / weight", "GJ / EI", "rest curvature 1", "rest curvature 2", "rest twist", "length")
IN_MOTION = (*AT_REST, "external damping", "internal damping")


def prior(length: float) -> tuple[Parameter, ...]:
    """Of the parameters ``IN_MOTION`` of a cable of about ``length`` [m]; wide on purpose."""
    return (
        Parameter("EI / weight", "m³", 2e-3 * length**3, 10.0, positive=True),
        Parameter("GJ / EI", "", 0.7, 2.0, positive=True),
        Parameter("rest curvature 1", "1/m", 0.0, 2.0 / length),
        Parameter("rest curvature 2", "1/m", 0.0, 2.0 / length),
        Parameter("rest twist", "1/m", 0.0, 1.0 / length),
        Parameter("length", "m", length, 1.1, positive=True),
        Parameter("external damping", "1/s", 0.5, 5.0, positive=True),
        Parameter("internal damping", "s", 0.01, 5.0, positive=True),
    )


def properties_of(values: Array, motion: CableMotion) -> RodProperties:
    """The rod with the ``values`` of ``AT_REST`` or ``IN_MOTION``."""
    stiffness, twist, kappa_1, kappa_2, tau, length = map(float, values[:6])
    external, internal = map(float, values[6:8]) if len(values) > 6 else (0.0, 0.0)
    EI = stiffness * motion.mass_per_length * GRAVITY
    EA = 4.0 * EI / motion.radius**2
    return RodProperties(
        length, motion.radius, EI=EI, GJ=twist * EI, EA=EA, kGA=SHEAR_CORRECTION * EA / 3.0,
        mass_per_length=motion.mass_per_length, rest_curvature=(kappa_1, kappa_2, tau),
        external_damping=external, internal_damping=internal,
    )  # fmt: skip
