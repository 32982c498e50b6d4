"""Where a rod would have been: through the clamps' recorded poses, at rest in each or in motion."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState
from sim2real.identification.cable_motion import CableMotion

GRAVITY = 9.81
LARGEST_STEP = 0.025  # in time [s]
HOLD = 100.0  # springs to the first sample, in weights of the cable per length
LAUNCH = 0.02  # over which its velocity is taken [s]


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


def in_motion(motion: CableMotion, properties: RodProperties) -> Array:
    """Points (T, n_points, 3) [m] of a rod that starts as the cable did and then is moved by its
    clamps alone; NaN from where it could not follow."""
    rod = CosseratRod(properties, motion.n_elements, clamp=motion.clamp)
    points = np.full(motion.points.shape, np.nan)
    try:
        state = first_state(rod, motion)
        points[0] = motion.weights @ state.positions
        for sample in range(1, len(motion)):
            state = rod.advance(
                state.boundary.displacement_to(motion.boundary(sample)),
                float(motion.stamps[sample] - motion.stamps[sample - 1]),
                dt=LARGEST_STEP,
            )
            points[sample] = motion.weights @ state.positions
    except (RodDiverged, ValueError):  # ValueError: a rod shorter than the clamps' distance
        pass
    return points


def first_state(rod: CosseratRod, motion: CableMotion) -> RodState:
    """Brings ``rod`` to the first sample: springs hold it to the curve that was seen, whose change
    over ``LAUNCH`` gives the velocities. A cable that stood is at rest."""
    curve, start = motion.curve(0), motion.boundary(0)
    weight = float(np.mean(rod.properties.linear_density)) * GRAVITY * rod.properties.length
    rod.attract(curve, HOLD * weight / rod.properties.length)
    state = rod.settle(start, curve)
    rod.attract(curve, 0.0)
    later = max(1, int(np.searchsorted(motion.stamps - motion.stamps[0], LAUNCH)))
    duration = float(motion.stamps[later] - motion.stamps[0])
    velocities = (motion.curve(later) - curve) / duration
    along = np.diff(state.positions, axis=0)
    turning = np.cross(along, np.diff(velocities, axis=0))
    turning /= (along**2).sum(axis=1, keepdims=True)
    spins = np.einsum("nji,nj->ni", state.directors, turning)
    rod.restore(replace(state, velocities=velocities, angular_velocities=spins))
    return rod.state
