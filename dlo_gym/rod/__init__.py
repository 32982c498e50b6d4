"""The Cosserat rod."""

from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.obstacles import Box, Capsule, Plane, Sphere
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.sensitivity import MotionSensitivity
from dlo_gym.rod.state import RodContact, RodState, ShapeEstimate

__all__ = [
    "BoundaryDisplacement",
    "BoundaryPoses",
    "Box",
    "Capsule",
    "CosseratRod",
    "MotionSensitivity",
    "Plane",
    "RodContact",
    "RodProperties",
    "RodState",
    "ShapeEstimate",
    "Sphere",
]
