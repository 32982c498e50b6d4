"""What the time steps need to know: masses, the clamps' path, the plan of steps."""

from math import ceil, isfinite

import numpy as np

from dlo_gym.geometry.se3 import matrix_to_quaternion
from dlo_gym.rod._kernels_dynamics import Motion, Plan
from dlo_gym.rod._kernels_rates import ClampPath
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties, per_element


def motion_of(properties: RodProperties, n: int) -> Motion:
    """Masses of nodes, half of the elements beside them, and of spins; damping."""
    mass = per_element(properties.linear_density, n) * properties.length / n
    nodes = np.zeros(n + 1)
    nodes[:-1] += 0.5 * mass
    nodes[1:] += 0.5 * mass
    spin = 0.25 * mass * per_element(properties.radius, n) ** 2
    return Motion(
        np.concatenate([nodes, np.repeat(spin, 2)]),
        float(properties.external_damping),
        float(properties.internal_damping),
    )


def clamp_path(
    boundary: BoundaryPoses, displacement: BoundaryDisplacement, duration: float
) -> ClampPath:
    """From ``boundary`` along ``displacement`` in ``duration`` [s], with constant velocities."""
    clamps = [boundary.left, boundary.left if boundary.right is None else boundary.right]
    poses = np.stack(clamps)
    velocity = np.zeros(12)
    velocity[: len(displacement.vector)] = displacement.vector / duration
    return ClampPath(
        np.ascontiguousarray(poses[:, :3, 3]), matrix_to_quaternion(poses[:, :3, :3]), velocity
    )


def plan_of(duration: float, dt: float, order: int, tolerance: float | None) -> Plan:
    """Equal steps of at most ``dt`` [s].

    Raises:
        ValueError: naming the argument that is out of range.
    """
    for name, value in (("duration", duration), ("dt", dt)):
        if not (isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: expected a positive time [s], got {value}")
    if order not in (1, 2):
        raise ValueError(f"order: expected 1 or 2, got {order}")
    if tolerance is not None and not (isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"tolerance: expected None or a positive length [m], got {tolerance}")
    steps = max(1, ceil(duration / dt * (1.0 - 1e-9)))
    return Plan(float(duration), steps, int(order), 0.0 if tolerance is None else float(tolerance))
