"""Where a rod would have been: through the clamps' recorded poses, at rest in each."""

from typing import NamedTuple

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from sim2real.identification.cable_motion import CableMotion


class Prediction(NamedTuple):
    """Points of a rod and how they change with what it is made of.

    Attributes:
        points: (T, n_points, 3) [m], NaN where the rod could not follow.
        by_parameters: (T, n_points, 3, 7) their derivatives by ``rod.sensitivity.PARAMETERS``.
    """

    points: Array
    by_parameters: Array


def at_rest(motion: CableMotion, properties: RodProperties) -> Prediction:
    """The equilibrium in every sample, each followed from the one before.

    The first starts from the curve that was seen, and so does one that cannot be followed.
    """
    rod = CosseratRod(properties, motion.n_elements, clamp=motion.clamp)
    points = np.full(motion.points.shape, np.nan)
    by_parameters = np.zeros((*points.shape, 7))
    settled = False
    for sample in range(len(motion)):
        settled = _rest(rod, motion, sample, settled)
        if settled:
            points[sample] = motion.weights @ rod.state.positions
            by_parameters[sample] = np.einsum(
                "pn,nij->pij", motion.weights, rod.parameter_sensitivity()
            )
    return Prediction(points, by_parameters)


def _rest(rod: CosseratRod, motion: CableMotion, sample: int, settled: bool) -> bool:
    """Brings ``rod`` to rest in a sample's clamps; whether that worked."""
    boundary = motion.boundary(sample)
    try:
        if settled:
            rod.move(rod.state.boundary.displacement_to(boundary))
            return True
    except (RodDiverged, ValueError):
        pass
    try:
        rod.settle(boundary, motion.curve(sample))
    except (RodDiverged, ValueError):  # ValueError: a rod shorter than the clamps' distance
        return False
    return True
