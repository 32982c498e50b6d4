"""What is known of a rod: its full mechanical state, or an estimate of its shape."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array, quaternion_to_matrix
from dlo_gym.rod.boundary import BoundaryPoses


@dataclass(frozen=True, eq=False)
class RodState:
    """A rod in equilibrium or in motion.

    Attributes:
        positions: (n_nodes, 3) centerline in world [m].
        quaternions: (n_elements, 4) wxyz of R_world_element, the elements' material frames.
        curvature: (n_elements - 1, 3) curvature and twist at the inner nodes, in the material
            frame [1/m].
        strain: (n_elements, 3) shear (d1, d2) and stretch (d3) of each element [-].
        boundary: the clamp poses that hold it.
        wrench_left, wrench_right: (6,) force [N] and torque [N m], world axes, that the clamp
            exerts on the rod at its end node; zero at a free end. In motion without the part of
            internal damping.
        energy: elastic plus gravitational [J].
        stress: (n_elements, 3) internal force along d1, d2 (shear) and d3 (tension) [N].
        velocities: (n_nodes, 3) in world axes [m/s]; zero in equilibrium.
        angular_velocities: (n_elements, 3) about d1, d2, d3 of each element [rad/s].
        kinetic_energy: [J].
        time: advanced since the rod last settled [s].
    """

    positions: Array
    quaternions: Array
    curvature: Array
    strain: Array
    boundary: BoundaryPoses
    wrench_left: Array
    wrench_right: Array
    energy: float
    stress: Array
    velocities: Array
    angular_velocities: Array
    kinetic_energy: float
    time: float

    @property
    def n_nodes(self) -> int:
        return len(self.positions)

    @property
    def directors(self) -> Array:
        """(n_elements, 3, 3) R_world_element; columns d1 d2 d3, d3 along the rod."""
        return quaternion_to_matrix(self.quaternions)


@dataclass(frozen=True, eq=False)
class ShapeEstimate:
    """A rod's shape as an observer knows it.

    Attributes:
        centerline: (n_nodes, 3) in world [m], node 0 at the left clamp.
        visible: (n_views, n_nodes) whether the node was seen in each view; (0, n_nodes) when the
            shape does not come from images.
        confidence: (n_nodes,) from 0 (prediction only) to 1 (seen in two views or more).
        stamp: time of the images [s].
        seen: False if no view contributed and the centerline is the prediction alone.
        message: why a view or the whole update fell back to the prediction; empty if none did.
        timings_ms: time of the update by component [ms], with their sum as "total"; empty when the
            shape does not come from images.
    """

    centerline: Array
    visible: NDArray[np.bool_]
    confidence: Array
    stamp: float = 0.0
    seen: bool = True
    message: str = ""
    timings_ms: dict[str, float] = field(default_factory=dict)
