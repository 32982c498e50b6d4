"""Derivatives of a rod by its parameters: at an equilibrium, and carried along a motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod._kernels_banded import solve
from dlo_gym.rod._kernels_energy import Ends, RodArrays, Work
from dlo_gym.rod._kernels_parameters import explicit_gradient
from dlo_gym.rod._kernels_sensitivity import Carried, empty_carried
from dlo_gym.rod._kernels_solve import free_range
from dlo_gym.rod._kernels_tangent import empty_geometry, measure
from dlo_gym.rod.contact import ContactModel

PARAMETERS = (
    "log_EI",
    "log_GJ",
    "log_weight",
    "rest_curvature_1",
    "rest_curvature_2",
    "rest_twist",
    "length",
)
"""Logarithms are natural; weight is the linear density; the length [m] carries mass with it."""

MOTION_PARAMETERS = (*PARAMETERS, "external_damping", "internal_damping")
"""Those, of which the linear density now has inertia too, and the dampings [1/s], [s]."""

DISPLACEMENT = tuple(
    f"{side}_{axis}" for side in ("left", "right") for axis in ("dx", "dy", "dz", "rx", "ry", "rz")
)
"""Names of the columns that are an advance's clamp displacement."""


@dataclass(frozen=True, eq=False)
class MotionSensitivity:
    """Derivatives of a rod in motion by m quantities, one a column of the last axis.

    Any columns can be put together by hand, such as those of a change of the initial state.

    Attributes:
        columns: (m,) their names; one of ``MOTION_PARAMETERS`` is that parameter of the rod, any
            other is what the derivatives below say it is.
        positions: (n_nodes, 3, m) of the nodes [m].
        turns: (n_elements, 3, m) of the elements' frames, about d1, d2, d3 of each [rad].
        velocities: (n_nodes, 3, m) of the nodes [m/s].
        angular_velocities: (n_elements, 3, m) about d1, d2, d3 of each element [rad/s].
        clamps: (12, m) of the clamp poses, world axes, left then right: translation [m], rotation
            vector [rad]; the right one's are of no effect where that end is free.

    Raises:
        ValueError: naming the field that is not finite or of another shape than the columns ask.
    """

    columns: tuple[str, ...]
    positions: Array
    turns: Array
    velocities: Array
    angular_velocities: Array
    clamps: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(self.columns))
        m, n = len(self.columns), len(self.turns)
        shapes = {
            "positions": (n + 1, 3, m),
            "turns": (n, 3, m),
            "velocities": (n + 1, 3, m),
            "angular_velocities": (n, 3, m),
            "clamps": (12, m),
        }
        for name, shape in shapes.items():
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(
                    f"{name}: expected finite values of shape {shape}, got {values.shape}"
                )
            object.__setattr__(self, name, values)

    @classmethod
    def zero(cls, columns: Sequence[str], n_elements: int) -> "MotionSensitivity":
        """Of a state that no column changes."""
        n, m = n_elements, len(columns)
        return cls(
            tuple(columns), np.zeros((n + 1, 3, m)), np.zeros((n, 3, m)), np.zeros((n + 1, 3, m)),
            np.zeros((n, 3, m)), np.zeros((12, m)),
        )  # fmt: skip

    def of(self, column: str) -> Array:
        """d(positions)/d(column), shape (n_nodes, 3).

        Raises:
            ValueError: if there is no such column, or more than one: ``positions`` has them all.
        """
        places = [place for place, name in enumerate(self.columns) if name == column]
        if not places:
            raise ValueError(f"column: expected one of {self.columns}, got {column!r}")
        if len(places) > 1:
            raise ValueError(
                f"column: expected a name that comes once, got {column!r};"
                f" take positions[:, :, k] with k one of {places}"
            )
        return self.positions[:, :, places[0]]


def check_parameters(parameters: Sequence[str]) -> tuple[str, ...]:
    """``parameters`` as a tuple.

    Raises:
        ValueError: if one is no parameter, or comes twice.
    """
    unknown = [name for name in parameters if name not in MOTION_PARAMETERS]
    if unknown or len(set(parameters)) != len(parameters):
        raise ValueError(
            f"parameters: expected distinct ones of {MOTION_PARAMETERS}, got {tuple(parameters)}"
        )
    return tuple(parameters)


def parameter_gradient(rod: RodArrays, weight: Array, x: Array, q: Array, ends: Ends) -> Array:
    """d(gradient)/d(PARAMETERS), shape (n_dofs, 7), at the shape x, q, without contact.

    ``weight`` (n + 1, 3) [N] is of the nodes.
    """
    n = len(q)
    columns, geometry = np.empty((6 * n + 3, len(PARAMETERS))), empty_geometry(n)
    measure(rod, x, q, ends, geometry)
    explicit_gradient(rod, geometry, np.arange(len(PARAMETERS)), ends.right_held, weight, columns)
    return columns


def parameter_sensitivity(gradients: Array, ends: Ends, work: Work, contact: ContactModel) -> Array:
    """d(unknowns)/d(PARAMETERS), shape (n_dofs, 7), given the last solve's factors of H:
    H d(unknowns) = -d(gradient)/d(parameters)."""
    first, last = free_range((len(gradients) - 3) // 6, ends.right_held)
    columns = -gradients
    columns[:first] = 0.0
    columns[last:] = 0.0
    if contact.possible:
        contact.solve(first, last, columns)
    else:
        solve(work.band, first, last, columns)
    return columns


def at_rest(parameters: Sequence[str], unknowns: Array) -> MotionSensitivity:
    """Of an equilibrium between given clamps; ``unknowns`` (n_dofs, 7) are by PARAMETERS."""
    start = MotionSensitivity.zero(check_parameters(parameters), (len(unknowns) - 3) // 6)
    nodes, elements = 6 * np.arange(len(start.positions)), 6 * np.arange(len(start.turns)) + 3
    for column, name in enumerate(start.columns):
        if name in PARAMETERS:
            change = unknowns[:, PARAMETERS.index(name)]
            start.positions[:, :, column] = change[nodes[:, None] + np.arange(3)]
            start.turns[:, :, column] = change[elements[:, None] + np.arange(3)]
    return start


def with_displacement(sensitivity: MotionSensitivity, n_clamps: int) -> MotionSensitivity:
    """With columns for a displacement of the clamps that is still to come."""
    names = DISPLACEMENT[: 6 * n_clamps]
    later = MotionSensitivity.zero(names, len(sensitivity.turns))
    return MotionSensitivity(
        (*sensitivity.columns, *names),
        *(
            np.concatenate([getattr(sensitivity, name), getattr(later, name)], axis=-1)
            for name in ("positions", "turns", "velocities", "angular_velocities", "clamps")
        ),
    )


def with_clamps(sensitivity: MotionSensitivity, unknowns: Array) -> MotionSensitivity:
    """With columns for the twists of the clamps that hold an equilibrium, whose ``unknowns``
    (n_dofs, 6 or 12) have those derivatives."""
    whole = with_displacement(sensitivity, unknowns.shape[1] // 6)
    added = slice(len(sensitivity.columns), None)
    n = len(whole.turns)
    elements = unknowns[:-3].reshape(n, 6, -1)
    whole.positions[:-1, :, added], whole.positions[-1, :, added] = elements[:, :3], unknowns[-3:]
    whole.turns[..., added] = elements[:, 3:]
    whole.clamps[: unknowns.shape[1], added] = np.eye(unknowns.shape[1])
    return whole


def carried_of(
    sensitivity: MotionSensitivity,
    moving: int,
    duration: float,
    rotations: Array,
    internal_damping: float,
    weight: Array,
) -> Carried:
    """What the kernels carry from ``sensitivity``.

    Args:
        sensitivity: of the rod's present state.
        moving: how many of its last columns are of the clamps' displacement.
        duration: in which they are displaced [s].
        rotations: (2, 3, 3) R_world_clamp.
        internal_damping: of the rod [s].
        weight: (n + 1, 3) of the nodes [N].
    """
    names, n = sensitivity.columns, len(sensitivity.turns)
    codes = np.array(
        [MOTION_PARAMETERS.index(name) if name in MOTION_PARAMETERS else -1 for name in names],
        dtype=np.int64,
    )
    viscous = internal_damping > 0.0 or "internal_damping" in names
    carried = empty_carried(n, codes, viscous, weight)
    poses = sensitivity.clamps.reshape(2, 2, 3, -1)
    carried.positions[:] = poses[:, 0]
    carried.turns[:] = rotations.transpose(0, 2, 1) @ poses[:, 1]
    for k in range(moving):
        carried.velocity[k, len(names) - moving + k] = 1.0 / duration
    unknowns = carried.now.unknowns
    unknowns[:-3].reshape(n, 6, -1)[:, :3] = sensitivity.positions[:-1]
    unknowns[-3:] = sensitivity.positions[-1]
    unknowns[:-3].reshape(n, 6, -1)[:, 3:] = sensitivity.turns
    carried.now.speeds[: n + 1] = sensitivity.velocities
    carried.now.w[:] = sensitivity.angular_velocities
    return carried


def sensitivity_of(
    columns: tuple[str, ...], carried: Carried, rotations: Array, duration: float
) -> MotionSensitivity:
    """What has been carried over ``duration`` [s] to clamps with ``rotations`` (2, 3, 3)."""
    now, n = carried.now, len(carried.now.w)
    elements = now.unknowns[:-3].reshape(n, 6, -1)
    clamps = np.empty((2, 2, 3, len(columns)))
    clamps[:, 0] = carried.positions + duration * carried.velocity.reshape(2, 2, 3, -1)[:, 0]
    clamps[:, 1] = rotations @ now.turns
    return MotionSensitivity(
        columns,
        np.concatenate([elements[:, :3], now.unknowns[None, -3:]]),
        elements[:, 3:].copy(),
        now.speeds[: n + 1].copy(),
        now.w.copy(),
        clamps.reshape(12, -1),
    )
