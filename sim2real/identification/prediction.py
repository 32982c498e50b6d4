"""Where a rod would have been: its clamps go through the recorded poses, and it rests or moves.

Derivatives are by ``COLUMNS``: the rod's parameters, then a turn of either clamp in its own axes.
"""

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.sensitivity import PARAMETERS, MotionSensitivity
from dlo_gym.rod.state import RodState
from sim2real.identification.cable_motion import CableMotion

GRAVITY = 9.81
LARGEST_STEP = 0.025  # in time [s]
HOLD = 100.0  # springs to the first sample, in weights of the cable per length
LAUNCH = 0.02  # over which its velocity is taken [s]

ROD = (
    "log_EI", "log_GJ", "rest_curvature_1", "rest_curvature_2", "rest_twist", "length",
    "external_damping", "internal_damping",
)  # fmt: skip
TURNS = tuple(f"{side}_turn_{axis}" for side in ("left", "right") for axis in (1, 2, 3))
COLUMNS = (*ROD, *TURNS)

Model = Literal["rest", "accelerated", "motion"]


class Prediction(NamedTuple):
    """Points of a rod and how they change.

    Attributes:
        points: (T, n_points, 3) [m], NaN where the rod could not follow.
        by: (T, n_points, 3, 14) their derivatives by ``COLUMNS``; zero where it could not.
    """

    points: Array
    by: Array


def predict(
    motion: CableMotion, properties: RodProperties, model: Model, *, derivatives: bool = True
) -> Prediction:
    """The rod in equilibrium in every sample ("rest"), in equilibrium with the accelerations seen
    ("accelerated"), or started as the cable did and then moved by its clamps alone ("motion").

    In motion ``derivatives`` may grow beyond all bounds and end the prediction.
    """
    if model == "motion":
        return in_motion(motion, properties, derivatives=derivatives)
    return at_rest(motion, properties, accelerated=model == "accelerated")


def at_rest(
    motion: CableMotion, properties: RodProperties, *, accelerated: bool = False
) -> Prediction:
    """The equilibrium in every sample, each followed from the one before.

    ``accelerated`` forces grow with the rod's length, which the derivative by it leaves out.
    The first starts from the curve that was seen, and so does one that cannot be followed.
    """
    rod = CosseratRod(properties, motion.n_elements, clamp=motion.clamp)
    mass = np.full((rod.n_nodes, 1), motion.mass_per_length * properties.length / rod.n_elements)
    mass[[0, -1]] *= 0.5
    prediction = _nothing(motion)
    rests = False
    for sample in range(len(motion)):
        if accelerated:
            rod.apply_forces(-mass * motion.accelerations[sample])
        rests = _rest(rod, motion, sample, rests)
        if rests:
            prediction.points[sample] = motion.weights @ rod.state.positions
            prediction.by[sample] = np.tensordot(motion.weights, _by_columns(rod), 1)
    return prediction


def _nothing(motion: CableMotion) -> Prediction:
    shape = motion.points.shape
    return Prediction(np.full(shape, np.nan), np.zeros((*shape, len(COLUMNS))))


def _rest(rod: CosseratRod, motion: CableMotion, sample: int, rests: bool) -> bool:
    """Brings ``rod`` to rest in a sample's clamps; whether that worked."""
    boundary = motion.boundary(sample)
    try:
        if rests:
            rod.move(rod.state.boundary.displacement_to(boundary))
            return True
    except (RodDiverged, ValueError):
        pass
    try:
        rod.settle(boundary, motion.curve(sample))
    except (RodDiverged, ValueError):  # ValueError: a rod shorter than the clamps' distance
        return False
    return True


def _by_columns(rod: CosseratRod) -> Array:
    """(n_nodes, 3, 14) derivatives of an equilibrium."""
    by = np.zeros((rod.n_nodes, 3, len(COLUMNS)))
    wanted = [name for name in ROD if name in PARAMETERS]
    by[..., : len(wanted)] = rod.parameter_sensitivity()[..., [PARAMETERS.index(n) for n in wanted]]
    by_clamps = rod.sensitivity()
    for side, clamp in enumerate(rod.state.boundary.clamps):
        turns = by_clamps[..., 6 * side + 3 : 6 * side + 6] @ clamp[:3, :3]
        by[..., len(ROD) + 3 * side : len(ROD) + 3 * side + 3] = turns
    return by


def in_motion(
    motion: CableMotion, properties: RodProperties, *, derivatives: bool = True
) -> Prediction:
    """A rod that starts as the cable did; ``derivatives`` are carried along exactly, or zero."""
    rod = CosseratRod(properties, motion.n_elements, clamp=motion.clamp)
    prediction = _nothing(motion)
    try:
        state, sensitivity = start(rod, motion)
        for sample in range(len(motion)):
            if sample:
                step = state.boundary.displacement_to(motion.boundary(sample))
                duration = float(motion.stamps[sample] - motion.stamps[sample - 1])
                if derivatives:
                    state, sensitivity = rod.advance_with_sensitivity(
                        sensitivity, step, duration, dt=LARGEST_STEP
                    )
                else:
                    state = rod.advance(step, duration, dt=LARGEST_STEP)
            prediction.points[sample] = motion.weights @ state.positions
            if derivatives:
                prediction.by[sample] = np.tensordot(motion.weights, sensitivity.positions, 1)
    except (RodDiverged, ValueError):  # ValueError: a rod shorter than the clamps' distance
        pass
    return prediction


def start(rod: CosseratRod, motion: CableMotion) -> tuple[RodState, MotionSensitivity]:
    """Brings ``rod`` to the first sample: springs hold it to the curve that was seen, whose change
    over ``LAUNCH`` gives the velocities."""
    curve = motion.curve(0)
    weight = motion.mass_per_length * GRAVITY * rod.properties.length
    rod.attract(curve, HOLD * weight / rod.properties.length)
    state = rod.settle(motion.boundary(0), curve)
    held = rod.motion_sensitivity(ROD, by_clamps=True)
    rod.attract(curve, 0.0)
    since = motion.stamps - motion.stamps[0]
    later = next((s for s in motion.clear if since[s] >= LAUNCH), len(motion) - 1)
    velocities = (motion.curve(later) - curve) / since[later]
    along = np.diff(state.positions, axis=0)
    turning = np.cross(along, np.diff(velocities, axis=0))
    turning /= (along**2).sum(axis=1, keepdims=True)
    spins = np.einsum("nji,nj->ni", state.directors, turning)
    rod.restore(replace(state, velocities=velocities, angular_velocities=spins))
    return rod.state, _with_turns(held, motion.boundary(0).clamps)


def _with_turns(held: MotionSensitivity, clamps: Array) -> MotionSensitivity:
    """With columns for turns of the clamps in their own axes, which stay the same as they move, in
    place of those for twists in the world's."""
    sensitivity = MotionSensitivity.zero(COLUMNS, len(held.turns))
    for name in ("positions", "turns", "clamps"):
        values, former = getattr(sensitivity, name), getattr(held, name)
        values[..., : len(ROD)] = former[..., : len(ROD)]
        for side, clamp in enumerate(clamps):
            columns, twists = len(ROD) + 3 * side, len(ROD) + 6 * side + 3
            values[..., columns : columns + 3] = former[..., twists : twists + 3] @ clamp[:3, :3]
    return sensitivity
