"""When the solver holds a shape for an equilibrium, and what shapes are believed."""

import numpy as np

from dlo_gym.rod._kernels_energy import RodArrays
from dlo_gym.rod._kernels_move import Bounds
from dlo_gym.rod._kernels_solve import Limits
from dlo_gym.rod.properties import RodProperties

TOLERANCE = 1e-9  # residual relative to the rod's own weight and stiffness
LARGEST_STRAIN = 0.25  # beside what a few times the rod's own weight stretches
LARGEST_BEND = 2.4  # between neighbouring elements [rad]
LARGEST_MOVE = (0.08, 0.3)  # of one sub-step: translation per rod length, rotation [rad]


def limits_of(properties: RodProperties, rod: RodArrays) -> Limits:
    """Scales of force and torque by the rod's stiffness and weight, and above rounding errors."""
    length, element = properties.length, properties.length / len(rod.rest_length)
    stiffness = float(rod.bending[:, 0].mean())
    # Differences of coordinates of about 1 m carry this much of rounding error in the force times
    # an element's length.
    rounding = np.finfo(np.float64).eps * rod.shear[:, 2].max() / TOLERANCE
    weight = _weight(rod)
    return Limits(
        residual=TOLERANCE,
        force=stiffness / length**2 + weight + 8.0 * rounding / element,
        torque=stiffness / length + weight * element + rounding,
    )


def bounds_of(properties: RodProperties, rod: RodArrays) -> Bounds:
    """Of a sub-step, and of its end."""
    return Bounds(
        translation=LARGEST_MOVE[0] * properties.length,
        rotation=LARGEST_MOVE[1],
        strain=LARGEST_STRAIN + 3.0 * _weight(rod) / rod.shear[:, 2].min(),
        bend=LARGEST_BEND,
    )


def _weight(rod: RodArrays) -> float:
    return float(np.abs(rod.forces).sum())
