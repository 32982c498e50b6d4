"""The Cosserat rod."""

from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState, ShapeEstimate

__all__ = [
    "BoundaryDisplacement",
    "BoundaryPoses",
    "CosseratRod",
    "RodProperties",
    "RodState",
    "ShapeEstimate",
]
