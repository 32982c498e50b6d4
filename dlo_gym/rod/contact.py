"""What a rod can touch, and how: contact points, stiffness, friction, and the solver's storage."""

from collections.abc import Sequence
from math import ceil

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import _kernels_contact as point_kernels
from dlo_gym.rod import _kernels_contact_solve as kernels
from dlo_gym.rod import _kernels_self_contact as pair_kernels
from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_contact import Hold, Touch
from dlo_gym.rod._kernels_distance import ObstacleArrays
from dlo_gym.rod._kernels_energy import Ends, Work
from dlo_gym.rod._kernels_solve import (
    CONVERGED,
    STALLED,
    UNSTABLE,
    Limits,
    exact_stress,
    free_range,
)
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.obstacles import Obstacle, check_obstacles, pack, same_bodies
from dlo_gym.rod.properties import RodProperties, per_element
from dlo_gym.rod.state import RodContact

STIFFNESS = 4.0  # of EA over the section: force per length and overlap [N/m^2]
ONSET = 0.005  # of the radius: overlap within which the force sets in smoothly
SLIP = 0.002  # of the radius: motion within which friction builds up
SPACING = 1.0  # of the radius: contact points along the rod are no further apart
UNTOUCHING = 4.0  # radii along the rod within which it does not touch itself
DEEPEST = 0.5  # of the radius: more overlap is not believed
DESCENT = 200  # steps of descent in a move, before a shorter one is tried
ROUGH = 1e6  # of the tolerance: where descent first gives way to Newton's method
CLAMP_DEPTH = 0.05  # of the radius: what the rod may overlap at a clamp
NO_LAG = np.zeros((0, 0, 4))

Shape = tuple[System, Array, Array, Ends]  # what the solver's kernels begin with


class ContactModel:
    """The obstacles around a rod, where friction holds it on them, and the tangent with contact.

    Args:
        properties, n_elements: of the rod.
        obstacles: rigid bodies it can touch.
        self_contact: whether it can touch itself.
        friction: Coulomb's coefficient against all obstacles.

    Raises:
        ValueError: naming the argument.
    """

    def __init__(
        self,
        properties: RodProperties,
        n_elements: int,
        obstacles: Sequence[Obstacle],
        self_contact: bool,
        friction: float,
    ) -> None:
        if not (np.isfinite(friction) and friction >= 0):
            raise ValueError(f"friction: expected a coefficient of at least 0, got {friction}")
        self.friction = float(friction)
        self.constants = _constants(properties, n_elements, self_contact, self.friction)
        self.matrix = np.zeros((6 * n_elements + 3, 17))
        self.remote = pair_kernels.no_remote()
        modulus = _modulus(properties, n_elements).max()
        self._stiffness = float(modulus * properties.length / n_elements)
        self.replace(obstacles)

    @property
    def possible(self) -> bool:
        """Whether there is anything to touch."""
        return bool(self.obstacles) or self.constants.neighbours > 0

    @property
    def n_points(self) -> int:
        return len(self.constants.elements)

    @property
    def radii(self) -> tuple[float, float]:
        """Of the rod at its two ends [m]."""
        return float(self.constants.radius[0]), float(self.constants.radius[-1])

    def replace(self, obstacles: Sequence[Obstacle]) -> None:
        """Other obstacles, on which friction holds nothing yet."""
        self.obstacles = check_obstacles(obstacles)
        self.arrays = pack(self.obstacles)
        self.let_go()

    def let_go(self) -> None:
        """Friction holds nothing anywhere."""
        m = len(self.obstacles) if self.friction > 0 else 0
        self.anchors = np.full((m, self.n_points, 3), np.nan)

    def place(self, positions: Array, after: Array, obstacles: Sequence[Obstacle] | None) -> bool:
        """Take the same bodies to other poses, with what rests on them, and say whether nothing
        is passed through on the way and on the rod's from ``positions`` to ``after``."""
        before = self.arrays
        if obstacles is not None:
            self.obstacles, self.arrays = tuple(obstacles), pack(obstacles)
        return self.free_fraction(before, positions, after) == 1.0

    def check_same(self, obstacles: Sequence[Obstacle]) -> tuple[Obstacle, ...]:
        """``obstacles``, after checking that they are the rod's own at whatever poses."""
        obstacles = check_obstacles(obstacles)
        if not same_bodies(self.obstacles, obstacles):
            raise ValueError(
                "obstacles: expected the rod's own bodies, in their order, at other poses;"
                f" got {obstacles}"
            )
        return obstacles

    def save(self):
        return self.obstacles, self.arrays, self.anchors.copy()

    def load(self, saved) -> None:
        self.obstacles, self.arrays, self.anchors = saved

    def gaps(self, positions: Array) -> Array:
        """(m, p) gaps [m] to each obstacle, negative where the rod overlaps it."""
        gaps = np.empty((len(self.obstacles), self.n_points))
        point_kernels.gaps(self.constants, self.arrays, positions, gaps)
        return gaps

    def free_fraction(self, before: ObstacleArrays, positions: Array, after: Array) -> float:
        """The part of the way from ``positions`` to ``after`` that goes through nothing, while the
        obstacles come from ``before`` to where they are."""
        depth = kernels.DEPTH
        fraction = point_kernels.free_fraction(
            self.constants, before, self.arrays, positions, after, depth
        )
        if self.constants.neighbours:
            pairs = pair_kernels.free_fraction_of_pairs(self.constants, positions, after, depth)
            fraction = min(fraction, pairs)
        return fraction

    def linearise(self, shape: Shape, work: Work) -> tuple[float, int]:
        """Factorise the tangent; returns the potential [J] and the number of negative eigenvalues
        (where friction slides, of negative pivots)."""
        energy, negative, self.remote = kernels.linearise(
            *shape, self._contact(), work, self.matrix
        )
        _, _, q, ends = shape
        free = free_range(len(q), ends.right_held)
        return energy, negative + pair_kernels.negative_beyond(self.remote, *free)

    def minimise(self, shape: Shape, limits: Limits, max_steps: int, work: Work) -> tuple[int, int]:
        """Settle from the present shape; returns a status and the steps.

        Descends near to the solution with lagging normal forces of friction, and finishes by
        Newton's method."""
        system, x, q, _ = shape
        limits = self._within_rounding(system, limits)
        hold = Hold(self.anchors, np.zeros((*self.anchors.shape[:2], 4)), True)
        rough, steps, kick = ROUGH * limits.residual, 0, False
        while steps < max_steps:
            point_kernels.update_lag(self.constants, self.arrays, x, hold.lag)
            status, taken = kernels.descend(
                *shape, self._contact(hold), limits._replace(residual=rough), max_steps - steps,
                kick, work, self.matrix,
            )  # fmt: skip
            steps += taken
            if status != CONVERGED:
                break
            near = x.copy(), q.copy(), self.anchors.copy()
            exact_stress(system.rod, x, q, work.stress)
            status, taken = kernels.newton(
                *shape, self._contact(), limits, kernels.NEWTON_STEPS, work, self.matrix
            )
            steps += taken
            kick = False
            if status == CONVERGED:
                if self.linearise(shape, work)[1] == 0:
                    return CONVERGED, steps
                kick = True
            x[:], q[:], self.anchors[:] = near
            rough = max(limits.residual, 1e-2 * rough)
        return STALLED, steps

    def follow(
        self,
        shape: Shape,
        twist: Array,
        rotations: Array,
        obstacles: Sequence[Obstacle] | None,
        limits: Limits,
        work: Work,
    ) -> tuple[int, float]:
        """Answer a ``twist`` (12,) of the clamps, and the obstacles' way to other poses if they
        move; returns a status and the potential [J]."""
        _, x, _, _ = shape
        if obstacles is not None:
            if not self.place(x, x, obstacles):
                return kernels.BLOCKED, 0.0
            self.linearise(shape, work)
        contact = self._contact()
        status = kernels.predict(*shape, contact, twist, rotations, work, self.matrix, self.remote)
        if status == CONVERGED or (status == kernels.BLOCKED and not twist.any()):
            # Clamps that hold still leave the shape where it was; Newton's steps go no deeper.
            status, _ = kernels.newton(
                *shape, contact, self._within_rounding(shape[0], limits), kernels.NEWTON_STEPS,
                work, self.matrix,
            )  # fmt: skip
            if status == STALLED:
                status, _ = self.minimise(shape, limits, DESCENT, work)
        if status != CONVERGED:
            return status, 0.0
        energy, negative = self.linearise(shape, work)
        return (UNSTABLE if negative else CONVERGED), energy

    def sensitivity(self, work: Work, rotations: Array, right_held: bool, columns: Array) -> None:
        """Update ``columns`` (n_dofs, 12) with d(unknowns)/d(clamp twists)."""
        kernels.sensitivity(work, self.matrix, self.remote, rotations, right_held, columns)

    def lengthen(self, positions: Array, length: float, gradient: Array) -> None:
        """Add to ``gradient`` (n_dofs,) its derivative by the rod's ``length`` [m], on which the
        stiffness of each contact point with obstacles depends."""
        change = np.zeros(len(gradient))
        point_kernels.add_obstacles(
            self.constants, self.arrays, Hold(self.anchors, NO_LAG, False), positions, change,
            np.zeros_like(self.matrix),
        )  # fmt: skip
        gradient += change / length

    def solve(self, first: int, last: int, columns: Array) -> None:
        """Update ``columns`` (n_dofs, m), zero but for rows ``first`` to ``last``, to their product
        with the inverse of the tangent last factorised."""
        pair_kernels.solve(self.matrix, self.remote, first, last, columns)

    def _within_rounding(self, system: System, limits: Limits) -> Limits:
        """Limits that coordinates of about 1 m can meet, given the stiffness of their springs."""
        springs = self._stiffness + system.inertia.weight.max(initial=0.0)
        rounding = 32.0 * np.finfo(np.float64).eps * springs
        return limits._replace(force=limits.force + rounding / limits.residual)

    def _contact(self, hold: Hold | None = None) -> kernels.Contact:
        if hold is None:
            hold = Hold(self.anchors, NO_LAG, False)
        return kernels.Contact(self.constants, self.arrays, hold)

    def problem(self, positions: Array) -> str:
        """What is wrong with the overlaps of a shape, or ""."""
        deepest = float((self.gaps(positions) / self.constants.radius).min(initial=0.0))
        if not deepest > -DEEPEST:
            return f"the rod overlaps an obstacle by {-deepest:.2g} radii"
        return ""

    def state(self, positions: Array) -> RodContact:
        m, p = len(self.obstacles), self.n_points
        points, forces = np.empty((p, 3)), np.empty((m, p, 3))
        point_kernels.point_forces(
            self.constants, self.arrays, positions, self.anchors, points, forces
        )
        gradient = np.zeros(len(self.matrix))
        pair_kernels.add_pairs(self.constants, positions, gradient, np.zeros_like(self.matrix))
        nodes = np.arange(len(positions))[:, None] * 6 + np.arange(3)
        return RodContact(
            self.obstacles, points, self.gaps(positions), forces, -gradient[nodes],
            self.anchors.copy(),
        )  # fmt: skip

    def held_energy(self, positions: Array) -> float:
        """What friction may hold elastically, mu N c over all points, and give back [J]."""
        if self.friction == 0.0:
            return 0.0
        points = np.empty((self.n_points, 3))
        forces = np.empty((len(self.obstacles), self.n_points, 3))
        point_kernels.point_forces(
            self.constants, self.arrays, positions, self.anchors, points, forces
        )
        normal = np.linalg.norm(forces, axis=2) @ self.constants.slip
        return self.friction * float(normal.sum())

    def restore(self, state: RodContact | None) -> None:
        """Return to the obstacles and anchors of ``state``, as far as it has any."""
        if state is None:
            self.replace(self.obstacles if self.constants.neighbours else ())
            return
        self.replace(state.obstacles)
        if state.anchors.shape == self.anchors.shape:
            self.anchors = state.anchors.copy()


def check_clamps(
    boundary: BoundaryPoses, obstacles: Sequence[Obstacle], radii: tuple[float, float]
) -> None:
    """Check that no clamp holds the rod, of these ``radii`` [m] at its ends, in an obstacle.

    Raises:
        ValueError: naming the clamp and the obstacle.
    """
    for side, clamp, r in zip(
        ("left", "right"), (boundary.left, boundary.right), radii, strict=True
    ):
        if clamp is None:
            continue
        for index, obstacle in enumerate(obstacles):
            gap = float(obstacle.signed_distance(clamp[:3, 3])) - r
            if gap < -CLAMP_DEPTH * r:
                raise ValueError(
                    f"clamp {side}: expected outside of obstacles[{index}], got"
                    f" {type(obstacle).__name__} overlapping the rod there by {-gap:.4g} m"
                )


def _modulus(properties: RodProperties, n: int) -> Array:
    """(n,) contact force per length and overlap [N/m^2], of the rod's own stiffness."""
    section = np.pi * per_element(properties.radius, n) ** 2
    return STIFFNESS * per_element(properties.stretching_stiffness, n) / section


def _constants(properties: RodProperties, n: int, self_contact: bool, friction: float) -> Touch:
    """Contact points, equally spaced along all elements, each for its piece of the rod."""
    radius = per_element(properties.radius, n)
    modulus = _modulus(properties, n)
    length = properties.length / n
    count = max(2, ceil(length / (SPACING * radius.min())))
    elements = np.append(np.repeat(np.arange(n), count), n - 1)
    weights = np.append(np.tile(np.arange(count) / count, n), 1.0)
    piece = np.full(len(elements), length / count)
    piece[[0, -1]] *= 0.5
    return Touch(
        elements=elements,
        weights=weights,
        radius=radius[elements],
        stiffness=modulus[elements] * piece,
        onset=ONSET * radius[elements],
        slip=SLIP * radius[elements],
        friction=friction,
        neighbours=max(3, ceil(UNTOUCHING * radius.max() / length)) if self_contact else 0,
        pair_radius=radius,
        pair_stiffness=modulus * radius,
    )
