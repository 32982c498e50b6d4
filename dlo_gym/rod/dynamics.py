"""What the time steps need to know: masses, the clamps' path, the plan of steps."""

from math import ceil, isfinite

import numpy as np

from dlo_gym.geometry.se3 import Array, matrix_to_quaternion
from dlo_gym.rod._kernels_assembly import System, assemble
from dlo_gym.rod._kernels_dynamics import Plan
from dlo_gym.rod._kernels_energy import Ends, Work, strains
from dlo_gym.rod._kernels_inertia import NO_INERTIA
from dlo_gym.rod._kernels_moment import Motion
from dlo_gym.rod._kernels_rates import ClampPath, strain_rates
from dlo_gym.rod._kernels_solve import exact_stress
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties, per_element


def motion_of(properties: RodProperties, n: int, rest_curvature: Array) -> Motion:
    """Masses of nodes, half of the elements beside them, and of spins; damping and creep."""
    mass = per_element(properties.linear_density, n) * properties.length / n
    nodes = np.zeros(n + 1)
    nodes[:-1] += 0.5 * mass
    nodes[1:] += 0.5 * mass
    spin = 0.25 * mass * per_element(properties.radius, n) ** 2
    return Motion(
        np.concatenate([nodes, np.repeat(spin, 2)]),
        float(properties.external_damping),
        float(properties.internal_damping),
        float(properties.creep),
        float(properties.relaxation_time),
        properties.yield_curvature is not None,
        rest_curvature,
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


def damping_wrenches(
    system: System,
    motion: Motion,
    shape: tuple[Array, Array, Ends],
    velocities: tuple[Array, Array],
    clamp_rotations: Array,
    clamp_spins: Array,
) -> Array:
    """(2, 6) what damping adds to the clamps' force [N] and torque [N m] on the rod, world axes.

    Args:
        shape: nodes, quaternions, ends.
        velocities: of the nodes [m/s] and the elements' spins [rad/s].
        clamp_rotations: (2, 3, 3).
        clamp_spins: (2, 3) in world axes [rad/s].
    """
    x, q, ends = shape
    v, w = velocities
    n = len(q)
    wrenches = np.zeros((2, 6))
    wrenches[:, :3] = motion.external * motion.mass[[0, n], None] * v[[0, n]]
    if motion.internal == 0.0:
        return wrenches
    rod, eta = system.rod, motion.internal
    rates, curvature = np.empty((2 * n + 1, 3)), np.empty((n + 1, 3))
    strains(rod, x, q, ends, np.empty((n, 3)), curvature)
    spins = np.einsum("sij,si->sj", clamp_rotations, clamp_spins)
    strain_rates(rod, x, q, ends, v, w, spins, rates)
    # The stress S eta d(strain)/dt as that of springs at rest where they were a second ago.
    damped = rod._replace(
        rest_strain=rod.rest_strain - eta * rates[:n],
        viscous=eta * rod.bending,
        viscous_centre=curvature - rates[n:],
    )
    loads = [empty_work(n), empty_work(n)]
    for load, material in zip(loads, (damped, rod), strict=True):
        exact_stress(material, x, q, load.stress)
        assemble(System(material, NO_INERTIA), x, q, ends, load, False)
    difference = loads[0].gradient - loads[1].gradient
    wrenches[0, :3] += difference[:3]
    wrenches[1, :3] += difference[-3:]
    torques = loads[0].clamp_terms[:, 0] - loads[1].clamp_terms[:, 0]
    wrenches[:, 3:] = np.einsum("sij,sj->si", clamp_rotations, torques)
    return wrenches


def empty_work(n: int) -> Work:
    """Storage for the assembly of a rod of ``n`` elements."""
    n_dofs = 6 * n + 3
    return Work(np.zeros((n, 3)), np.zeros(n_dofs), np.zeros((n_dofs, 9)), np.zeros((2, 4, 3)))


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
