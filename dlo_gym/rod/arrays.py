"""A rod's properties as the kernels' arrays."""

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod._kernels_energy import RodArrays
from dlo_gym.rod._kernels_inertia import NO_INERTIA, Inertia
from dlo_gym.rod.properties import RodProperties, per_element

RIGID_JOINT = 1e-3  # of an element: the piece between clamp and element when it holds the element


def rod_arrays(properties: RodProperties, n: int, gravity: Array, clamp: str) -> RodArrays:
    """The kernels' constants: element values, and their averages at the nodes between."""
    rest_length = np.full(n, properties.length / n)
    shear = np.column_stack(
        [per_element(properties.shearing_stiffness, n)] * 2
        + [per_element(properties.stretching_stiffness, n)]
    )
    bend = per_element(properties.bending_stiffness, n)
    twist = per_element(properties.twisting_stiffness, n)
    elements = np.column_stack([bend, bend, twist])
    # Two half elements in series: the harmonic mean of their stiffnesses.
    between = 2.0 / (1.0 / elements[:-1] + 1.0 / elements[1:])
    rest = np.asarray(properties.rest_curvature, dtype=np.float64)
    rest = np.broadcast_to(rest, (n - 1, 3))
    joint = (RIGID_JOINT if clamp == "element" else 0.5) * properties.length / n
    voronoi = np.full(n + 1, properties.length / n)
    voronoi[[0, -1]] = joint
    bending = np.ascontiguousarray(np.concatenate([elements[:1], between, elements[-1:]]))
    return RodArrays(
        rest_length,
        np.ascontiguousarray(shear),
        np.zeros((n, 3)),
        bending,
        np.ascontiguousarray(np.concatenate([rest[:1], rest, rest[-1:]])),
        voronoi,
        node_weights(properties, n, gravity),
        np.zeros((n + 1, 2)),
        *_yield(properties, bending),
        np.zeros((n + 1, 3)),
        np.zeros((n + 1, 3)),
    )


def _yield(properties: RodProperties, bending: Array) -> tuple[Array, Array]:
    """Yield moment [N m] and hardening [N m^2] at the nodes; between elements the weaker yields."""
    n = len(bending) - 1
    if properties.yield_curvature is None:
        return np.full(n + 1, np.inf), np.zeros(n + 1)
    curvature = per_element(properties.yield_curvature, n)
    at_nodes = np.concatenate([[np.inf], curvature])
    at_nodes = np.minimum(at_nodes, np.concatenate([curvature, [np.inf]]))
    # Elastic and plastic compliance in series: a slope h of M(kappa) is H = B h / (1 - h).
    slope = properties.hardening / (1.0 - properties.hardening)
    return bending[:, 0] * at_nodes, bending[:, 0] * slope


def node_weights(properties: RodProperties, n: int, gravity: Array) -> Array:
    """(n + 1, 3) weight of each node [N]: half of the elements beside it."""
    mass = per_element(properties.linear_density, n) * properties.length / n
    nodes = np.zeros(n + 1)
    nodes[:-1] += 0.5 * mass
    nodes[1:] += 0.5 * mass
    return nodes[:, None] * gravity


def springs_of(targets: ArrayLike, stiffness: ArrayLike, n: int) -> Inertia:
    """Springs [N/m], one stiffness or (n + 1,), between the nodes and ``targets`` (n + 1, 3) [m].

    Raises:
        ValueError: on a wrong shape or a value that is not finite, or negative stiffness.
    """
    targets = np.asarray(targets, dtype=np.float64)
    if targets.shape != (n + 1, 3) or not np.isfinite(targets).all():
        raise ValueError(
            f"targets: expected finite values of shape ({n + 1}, 3), got {targets.shape}"
        )
    springs = per_element(stiffness, n + 1)
    if not (np.isfinite(springs) & (springs >= 0.0)).all():
        raise ValueError(f"stiffness: expected finite values from 0 up [N/m], got {springs}")
    if not springs.any():
        return NO_INERTIA
    return Inertia(
        np.concatenate([springs, np.zeros(2 * n)]), np.concatenate([targets, np.zeros((2 * n, 3))])
    )
