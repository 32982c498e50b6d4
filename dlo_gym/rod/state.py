"""What is known of a rod: its full mechanical state, or an estimate of its shape."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array, quaternion_to_matrix
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.obstacles import Obstacle


@dataclass(frozen=True, eq=False)
class RodContact:
    """How a rod touches m obstacles at its p contact points, which lie along all its elements.

    Attributes:
        obstacles: (m,) the bodies, as they stand.
        points: (p, 3) the contact points, on the centerline, in world [m].
        gaps: (m, p) from the rod's surface to each obstacle's [m]; negative where they overlap.
        forces: (m, p, 3) of each obstacle on the rod at each point, friction included [N].
        self_forces: (n_nodes, 3) of the rod on itself, as forces on its nodes [N].
        anchors: (m, p, 3) where friction holds each point, in its obstacle's frame [m]; NaN where
            it holds none; (0, p, 3) without friction.
    """

    obstacles: tuple[Obstacle, ...]
    points: Array
    gaps: Array
    forces: Array
    self_forces: Array
    anchors: Array

    @property
    def on_obstacles(self) -> Array:
        """(m, 3) total force of the rod on each obstacle [N]."""
        return -self.forces.sum(axis=1)


class RodMemory(NamedTuple):
    """The inelastic rod's past.

    Attributes:
        plastic: (n_nodes, 2) plastic curvature before the last solve [1/m].
        creep: (n_nodes, 3) curvature at which the relaxing stiffness rests [1/m].
        clamp_spins: (2, 3) angular velocities of the clamps, world axes [rad/s].
    """

    plastic: Array
    creep: Array
    clamp_spins: Array


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
            exerts on the rod at its end node, damping included; zero at a free end.
        energy: elastic plus gravitational, and that of contact [J].
        stress: (n_elements, 3) internal force along d1, d2 (shear) and d3 (tension) [N].
        velocities: (n_nodes, 3) in world axes [m/s]; zero in equilibrium.
        angular_velocities: (n_elements, 3) about d1, d2, d3 of each element [rad/s].
        kinetic_energy: [J].
        plastic_curvature: (n_elements - 1, 2) curvature about d1 and d2 that stays [1/m].
        memory: what else the rod must know to go on from here to the last bit.
        time: advanced since the rod last settled [s].
        contact: what the rod touches; None for a rod that can touch nothing.
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
    plastic_curvature: Array
    memory: RodMemory
    time: float
    contact: RodContact | None = None

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
