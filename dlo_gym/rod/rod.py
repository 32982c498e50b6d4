"""The Cosserat rod: equilibrium between clamps, moves, sensitivities."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import _kernels_dynamics as dynamics_kernels
from dlo_gym.rod import _kernels_energy as energy_kernels
from dlo_gym.rod import _kernels_move as move_kernels
from dlo_gym.rod import _kernels_solve as kernels
from dlo_gym.rod import contact_dynamics, contact_moves
from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_clamps import clamp_frame
from dlo_gym.rod._kernels_dynamics import Plan
from dlo_gym.rod._kernels_inertia import NO_INERTIA
from dlo_gym.rod._kernels_rates import kinetic_energy
from dlo_gym.rod._kernels_sensitivity import Carried
from dlo_gym.rod.arrays import node_weights, rod_arrays, springs_of
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.contact import ContactModel, check_clamps
from dlo_gym.rod.dynamics import clamp_path, damping_wrenches, empty_work, motion_of, plan_of
from dlo_gym.rod.initial_shapes import frames_along, hanging
from dlo_gym.rod.limits import bounds_of, limits_of
from dlo_gym.rod.obstacles import Obstacle, check_obstacles
from dlo_gym.rod.plausibility import problem_of
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.sensitivity import (
    MOTION_PARAMETERS,
    PARAMETERS,
    MotionSensitivity,
    at_rest,
    carried_of,
    check_parameters,
    parameter_gradient,
    parameter_sensitivity,
    sensitivity_of,
    with_clamps,
    with_displacement,
)
from dlo_gym.rod.state import RodMemory, RodState

GRAVITY = (0.0, 0.0, -9.81)


class CosseratRod:
    """A rod in quasi-static equilibrium between two clamps, or held by the left one alone.

    The discretisation is PyElastica's (see ``_kernels_energy``); the solver is an implicit Newton
    method on the exact banded Hessian, with stresses predicted along each step as in the mixed
    integration point Newton method (Magisano, Leonetti, Garcea 2017).

    Args:
        properties: what the rod is made of.
        n_elements: number of elements, at least 2; the rod has one node more.
        gravity: (3,) [m/s^2].
        clamp: "element" clamps the frame of the whole first and last element, as PyElastica and
            the tracking paper do; "node" clamps the frame at the end node itself, which converges
            to the continuous rod with second order in n.
        obstacles: rigid bodies that the rod can touch.
        self_contact: whether it can touch itself.
        friction: Coulomb's coefficient between rod and obstacles.

    Raises:
        ValueError: naming the argument, or the per-element property that has another number of
            values.
    """

    def __init__(
        self,
        properties: RodProperties,
        n_elements: int = 50,
        *,
        gravity: ArrayLike = GRAVITY,
        clamp: Literal["element", "node"] = "element",
        obstacles: Sequence[Obstacle] = (),
        self_contact: bool = False,
        friction: float = 0.0,
    ) -> None:
        if not isinstance(n_elements, int | np.integer) or n_elements < 2:
            raise ValueError(f"n_elements: expected an integer of at least 2, got {n_elements}")
        if clamp not in ("element", "node"):
            raise ValueError(f"clamp: expected 'element' or 'node', got {clamp!r}")
        properties.check_n_elements(n_elements)
        self.properties = properties
        self.n_elements = n_elements
        self.gravity = np.asarray(gravity, dtype=np.float64)
        if self.gravity.shape != (3,) or not np.isfinite(self.gravity).all():
            raise ValueError(f"gravity: expected three finite numbers [m/s^2], got {gravity}")
        self._arrays = rod_arrays(properties, n_elements, self.gravity, clamp)
        self._system = System(self._arrays, NO_INERTIA)
        self._motion = motion_of(properties, n_elements, self._arrays.rest_curvature.copy())
        self._limits = limits_of(properties, self._arrays)
        self._bounds = bounds_of(properties, self._arrays)
        self._work = empty_work(n_elements)
        self._boundary: BoundaryPoses | None = None
        self._energy = 0.0
        self._contact = ContactModel(properties, n_elements, obstacles, self_contact, friction)
        self._stop()

    @property
    def n_nodes(self) -> int:
        return self.n_elements + 1

    @property
    def settled(self) -> bool:
        """Whether the rod has a state."""
        return self._boundary is not None

    def apply_forces(self, forces: ArrayLike) -> None:
        """Dead loads (n_nodes, 3) [N] on the nodes beside the weight, from the next solve on.

        Raises:
            ValueError: on a wrong shape or a value that is not finite.
        """
        forces = np.asarray(forces, dtype=np.float64)
        if forces.shape != (self.n_nodes, 3) or not np.isfinite(forces).all():
            raise ValueError(
                f"forces: expected finite values of shape ({self.n_nodes}, 3), got {forces.shape}"
            )
        weight = node_weights(self.properties, self.n_elements, self.gravity)
        self._arrays = self._arrays._replace(forces=weight + forces)
        self._set_potential(self._system._replace(rod=self._arrays))

    def attract(self, targets: ArrayLike, stiffness: ArrayLike) -> None:
        """Springs from the nodes to ``targets``, from the next solve on; zero ends them.

        They are for ``settle`` and ``move``: ``advance`` refuses a rod that they pull.

        Args:
            targets: (n_nodes, 3) [m].
            stiffness: of all springs, or (n_nodes,) of each [N/m].

        Raises:
            ValueError: on a wrong shape or a value that is not finite, or negative stiffness.
        """
        self._set_potential(System(self._arrays, springs_of(targets, stiffness, self.n_elements)))

    def settle(self, boundary: BoundaryPoses, start: ArrayLike | None = None) -> RodState:
        """Find the equilibrium between clamps from afar.

        Args:
            boundary: the clamp poses.
            start: (n_nodes, 3) centerline to start from [m]; a curve that hangs between the clamps
                when omitted. Of several equilibria the one downhill from the start is found.

        Raises:
            ValueError: if the clamps are further apart than the rod is long, or one is inside an
                obstacle.
            RodDiverged: if no equilibrium was found; the rod keeps its former state, which is the
                error's ``last_good``: None the first time.
        """
        self._check_boundary(boundary, self._contact.obstacles)
        if start is None:
            start = hanging(boundary, self.properties.length, self.n_nodes)
        start = np.asarray(start, dtype=np.float64)
        if start.shape != (self.n_nodes, 3) or not np.isfinite(start).all():
            raise ValueError(
                f"start: expected a finite centerline of shape ({self.n_nodes}, 3),"
                f" got shape {start.shape}"
            )
        former = self.state if self._boundary is not None else None
        self._stop()
        positions = start.copy()
        positions[0] = boundary.left[:3, 3]
        if boundary.right is not None:
            positions[-1] = boundary.right[:3, 3]
        self._set(positions, frames_along(positions, boundary), boundary)
        self._contact.let_go()
        problem, _ = self._go(np.zeros(12), descend=True)
        if problem:
            if former is not None:
                self.restore(former)
            else:
                self._boundary = None
            raise RodDiverged(
                f"no equilibrium found for clamps {boundary.distance:.4g} m apart on a rod of"
                f" {self.properties.length:.4g} m: {problem}",
                last_good=former,
            )
        return self.state

    def move(
        self, displacement: BoundaryDisplacement, obstacles: Sequence[Obstacle] | None = None
    ) -> RodState:
        """Move the clamps and follow the equilibrium; large moves are taken in sub-steps.

        Args:
            displacement: of the clamps.
            obstacles: the rod's own obstacles at the poses to which they go meanwhile; None where
                they stay.

        Raises:
            ValueError: if the rod has not settled, the clamps would end further apart than the rod
                is long or inside an obstacle, or the obstacles are other ones.
            RodDiverged: if the equilibrium was lost; the rod keeps its state before the move.
        """
        before = self._settled("move")
        target = before.displaced(displacement)
        if obstacles is not None:
            obstacles = self._contact.check_same(obstacles)
        self._check_boundary(target, self._contact.obstacles if obstacles is None else obstacles)
        twist = np.zeros(12)
        twist[: len(displacement.vector)] = displacement.vector
        problem, reached = self._go(twist, obstacles=obstacles)
        if problem:
            raise RodDiverged(
                f"the equilibrium was lost at {100 * reached:.0f} % of a move by"
                f" {np.array2string(displacement.vector, precision=4, max_line_width=200)}"
                f" [m, rad]: {problem}",
                last_good=self.state,
            )
        self._boundary = target
        self._rotations[:] = self._clamps[:, :3, :3]
        self._stand_still()
        return self.state

    def set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Put other obstacles around the rod, which settles among them from where it is, at rest.

        ``move`` is for obstacles that move: it goes with them.

        Raises:
            ValueError: if an entry is no obstacle, or a clamp is inside one.
            RodDiverged: if no equilibrium was found; rod and obstacles stay as they were.
        """
        obstacles = check_obstacles(obstacles)
        if self._boundary is None:
            self._contact.replace(obstacles)
            return
        check_clamps(self._boundary, obstacles, self._contact.radii)
        former = self.state
        self._contact.replace(obstacles)
        move_kernels.flow(self._held)
        problem, _ = self._go(np.zeros(12), descend=True)
        if problem:
            self.restore(former)
            raise RodDiverged(f"no equilibrium among the obstacles: {problem}", last_good=former)
        self._stand_still()

    def advance(
        self,
        displacement: BoundaryDisplacement,
        duration: float,
        *,
        dt: float = 0.025,
        order: Literal[1, 2] | None = None,
        tolerance: float | None = None,
        obstacles: Sequence[Obstacle] | None = None,
    ) -> RodState:
        """Let time pass while the clamps move along ``displacement`` with constant velocity.

        Args:
            displacement: of the clamps; zero to hold them still.
            duration: [s].
            dt: largest time step [s]; 10 to 100 ms are stable for any rod.
            order: 2 for TR-BDF2, 1 for the implicit Euler method, which damps much more. None
                takes 1 for a rod that can touch something, which has no other, else 2.
            tolerance: on the estimated error of a node's position in one step [m]; steps are
                chosen to keep it. None takes equal steps; a rod that can touch something must.
            obstacles: the rod's own obstacles at the poses to which they go meanwhile; None where
                they stay.

        Raises:
            ValueError: naming the argument; or if the rod has not settled, springs pull it, or the
                clamps would end further apart than the rod is long or inside an obstacle.
            RodDiverged: if no step was small enough; the rod keeps its state before.
        """
        self._settled("advance")
        touching = self._contact.possible
        if touching and (order == 2 or tolerance is not None):
            raise ValueError(
                "order, tolerance: expected order 1 and no tolerance for a rod that can touch"
                f" something, got {order} and {tolerance}"
            )
        plan = plan_of(duration, dt, order or (1 if touching else 2), tolerance)
        return self._advance(displacement, plan, obstacles)

    def advance_with_sensitivity(
        self,
        sensitivity: MotionSensitivity,
        displacement: BoundaryDisplacement,
        duration: float,
        *,
        dt: float = 0.025,
        order: Literal[1, 2] = 2,
        tolerance: float | None = None,
        by_displacement: bool = False,
    ) -> tuple[RodState, MotionSensitivity]:
        """``advance``, and what becomes of the present state's ``sensitivity`` meanwhile.

        It is exact for the steps as they are taken: their number and lengths count as given.

        Args:
            sensitivity: from ``motion_sensitivity`` or from the advance before.
            displacement, duration, dt, order, tolerance: as for ``advance``.
            by_displacement: whether to append columns for this ``displacement``, named
                ``sensitivity.DISPLACEMENT``.

        Raises:
            ValueError: as ``advance``; or if the rod yields, creeps or can touch something, or the
                sensitivity is of another number of elements.
            RodDiverged: as ``advance``.
        """
        self._settled("advance_with_sensitivity")
        self._check_smooth("advance_with_sensitivity")
        if len(sensitivity.turns) != self.n_elements:
            raise ValueError(
                f"sensitivity: expected that of {self.n_elements} elements,"
                f" got {len(sensitivity.turns)}"
            )
        plan = plan_of(duration, dt, order, tolerance)
        n_clamps = (1 + self._ends.right_held) if by_displacement else 0
        sensitivity = with_displacement(sensitivity, n_clamps)
        carried = carried_of(
            sensitivity, 6 * n_clamps, plan.duration, self._rotations,
            self.properties.internal_damping,
            node_weights(self.properties, self.n_elements, self.gravity),
        )  # fmt: skip
        state = self._advance(displacement, plan, None, carried)
        after = sensitivity_of(sensitivity.columns, carried, self._rotations, plan.duration)
        return state, after

    def motion_sensitivity(
        self,
        parameters: Sequence[str] = MOTION_PARAMETERS,
        *,
        equilibrium: bool = True,
        by_clamps: bool = False,
    ) -> MotionSensitivity:
        """The present state's derivatives by ``parameters``, for ``advance_with_sensitivity``.

        Args:
            parameters: of ``sensitivity.MOTION_PARAMETERS``.
            equilibrium: whether the rod is at rest, in a state that depends on the parameters; if
                not, the state is one given, whatever the parameters.
            by_clamps: whether to append columns for twists of the clamps that hold the equilibrium,
                named ``sensitivity.DISPLACEMENT``.

        Raises:
            ValueError: naming the argument; or if the rod has not settled, yields, creeps, can
                touch something, or is in motion though it is to be at rest.
        """
        self._settled("motion_sensitivity")
        self._check_smooth("motion_sensitivity")
        names = check_parameters(parameters)
        if not equilibrium and by_clamps:
            raise ValueError("by_clamps: expected False for what is no equilibrium, got True")
        if not equilibrium:
            return MotionSensitivity.zero(names, self.n_elements)
        if self._in_motion:
            raise ValueError("equilibrium: expected False for a rod in motion, got True")
        rest = at_rest(names, self._by_parameters())
        if not by_clamps:
            return rest
        columns = np.empty((len(self._work.gradient), 12))
        kernels.sensitivity(self._work, self._rotations, self._ends.right_held, columns)
        return with_clamps(rest, columns[:, : 6 * (1 + self._ends.right_held)])

    def _check_smooth(self, action: str) -> None:
        if self._contact.possible or self._motion.yields or self._motion.creep > 0.0:
            raise ValueError(
                f"{action}: expected a rod that neither yields nor creeps and can touch nothing"
            )

    def _by_parameters(self) -> Array:
        """(n_dofs, 7) of the unknowns by PARAMETERS, at an equilibrium."""
        weight = node_weights(self.properties, self.n_elements, self.gravity)
        gradients = parameter_gradient(self._arrays, weight, self._x, self._q, self._ends)
        if self._contact.possible:
            by_length = gradients[:, PARAMETERS.index("length")]
            self._contact.lengthen(self._x, self.properties.length, by_length)
        return parameter_sensitivity(gradients, self._ends, self._work, self._contact)

    def _advance(
        self,
        displacement: BoundaryDisplacement,
        plan: Plan,
        obstacles: Sequence[Obstacle] | None,
        carried: Carried | None = None,
    ) -> RodState:
        before = self._settled("advance")
        if len(self._system.inertia.weight):
            raise ValueError(
                "advance: expected a rod without springs; attract(targets, 0) ends them"
            )
        target = before.displaced(displacement)
        moved = None if obstacles is None else self._contact.check_same(obstacles)
        self._check_boundary(target, self._contact.obstacles if moved is None else moved)
        saved = self.state
        path = clamp_path(before, displacement, plan.duration)
        if self._contact.possible:
            status, reached = contact_dynamics.advance(
                self._contact, moved, self._system, self._motion, path, self._ends,
                (self._x, self._q, self._v, self._w, self._creep), plan, self._limits, self._work,
            )  # fmt: skip
        else:
            status, reached, self._energy = dynamics_kernels.advance(
                self._system, self._motion, path, self._ends,
                self._x, self._q, self._v, self._w, self._creep, plan, self._limits, self._work,
                carried,
            )  # fmt: skip
        problem = "" if status == kernels.CONVERGED else "no time step was small enough"
        problem = problem or self._implausible()
        if problem:
            self.restore(saved)
            raise RodDiverged(
                f"the motion was lost {reached:.4g} s into an advance of {plan.duration:.4g} s:"
                f" {problem}",
                last_good=saved,
            )
        self._time += plan.duration
        self._set_clamps(target)
        self._spins = path.velocity.reshape(2, 2, 3)[:, 1].copy()
        kernels.exact_stress(self._arrays, self._x, self._q, self._work.stress)
        self._linearise()
        return self.state

    @property
    def state(self) -> RodState:
        """The present equilibrium, as copies.

        Raises:
            ValueError: if the rod has not settled.
        """
        boundary = self._settled("state")
        strain, curvature = self._strains()
        plastic = np.zeros((self.n_nodes, 2))
        if self._motion.yields:
            energy_kernels.flow_plastically(self._arrays, curvature, plastic)
        wrenches = self._wrenches()
        if self._v.any() or self._spins.any():
            wrenches += self._damping_wrenches()
        return RodState(
            positions=self._x.copy(),
            quaternions=self._q.copy(),
            curvature=curvature[1:-1].copy(),
            strain=strain,
            boundary=boundary,
            wrench_left=wrenches[0],
            wrench_right=wrenches[1],
            energy=self._energy,
            stress=self._work.stress.copy(),
            velocities=self._v.copy(),
            angular_velocities=self._w.copy(),
            kinetic_energy=kinetic_energy(self._motion, self._v, self._w),
            plastic_curvature=plastic[1:-1].copy(),
            memory=RodMemory(self._arrays.plastic.copy(), self._creep.copy(), self._spins.copy()),
            time=self._time,
            contact=self._contact.state(self._x) if self._contact.possible else None,
        )

    @property
    def path_dependent(self) -> bool:
        """Whether its shape at rest depends on the way there: it yields, or can touch something."""
        return self._motion.yields or self._contact.possible

    def restore(self, state: RodState) -> None:
        """Return to ``state`` exactly: what follows is the same to the last bit.

        Raises:
            ValueError: if the state has another number of nodes.
        """
        if state.n_nodes != self.n_nodes:
            raise ValueError(f"state: expected {self.n_nodes} nodes, got {state.n_nodes}")
        self._set(state.positions.copy(), state.quaternions.copy(), state.boundary)
        self._v, self._w = state.velocities.copy(), state.angular_velocities.copy()
        self._time = state.time
        self._arrays.plastic[:], self._creep[:], self._spins[:] = state.memory
        self._set_rest()
        self._work.stress[:] = state.stress
        self._contact.restore(state.contact)
        self._linearise()

    def sensitivity(self) -> Array:
        """d(positions)/d(clamp twists), shape (n_nodes, 3, 12), exact at the equilibrium.

        Columns are translation [m] and rotation vector [rad] in world axes, of the left clamp, then
        of the right (zero where that end is free). From the factors of the last Newton step.

        Raises:
            ValueError: if the rod has not settled, or is in motion.
        """
        self._check_at_rest("sensitivity")
        columns = np.empty((len(self._work.gradient), 12))
        if self._contact.possible:
            self._contact.sensitivity(self._work, self._rotations, self._ends.right_held, columns)
        else:
            kernels.sensitivity(self._work, self._rotations, self._ends.right_held, columns)
        return self._of_nodes(columns)

    def parameter_sensitivity(self) -> Array:
        """d(positions)/d(parameters), shape (n_nodes, 3, 7), at an equilibrium.

        Columns follow ``sensitivity.PARAMETERS``: log EI, log GJ, log of the weight, the three
        components of a uniform rest curvature [1/m], and the length [m]. A rod that yields keeps
        the plastic curvature it had before its last solve, and friction holds it where it does.
        With contact the derivatives are those while the same points touch.

        Raises:
            ValueError: if the rod has not settled, or is in motion.
        """
        self._check_at_rest("parameter_sensitivity")
        return self._of_nodes(self._by_parameters())

    def _of_nodes(self, columns: Array) -> Array:
        """The rows of (n_dofs, m) that are positions, as (n_nodes, 3, m)."""
        return columns[np.arange(self.n_nodes)[:, None] * 6 + np.arange(3)]

    def _settled(self, action: str) -> BoundaryPoses:
        """The clamp poses, of a rod that has some."""
        if self._boundary is None:
            raise ValueError(f"{action}: the rod has no state yet; call settle(boundary) first")
        return self._boundary

    @property
    def _in_motion(self) -> bool:
        return bool(self._v.any() or self._w.any())

    def _check_at_rest(self, action: str) -> None:
        self._settled(action)
        if self._in_motion:
            raise ValueError(f"{action}: expected a rod at rest, got one in motion; move stops it")

    def _set_potential(self, system: System) -> None:
        """Exchange what acts on the rod; its shape stays until the next solve."""
        self._system = system
        if self.settled:
            self._linearise()

    def _stand_still(self) -> None:
        self._v, self._w = np.zeros((self.n_nodes, 3)), np.zeros((self.n_elements, 3))
        self._spins = np.zeros((2, 3))

    def _stop(self) -> None:
        self._stand_still()
        self._time = 0.0
        self._creep = np.zeros((self.n_nodes, 3))
        self._arrays.plastic[:] = 0.0
        self._set_rest()

    def _set_rest(self) -> None:
        """The relaxed share of the stiffness as a shift of the rest curvature."""
        if self._motion.creep > 0.0:
            relaxed = self._motion.creep * self._creep
            self._arrays.rest_curvature[:] = self._motion.rest_curvature + relaxed

    def _check_boundary(self, boundary: BoundaryPoses, obstacles: Sequence[Obstacle]) -> None:
        check_clamps(boundary, obstacles, self._contact.radii)
        if boundary.distance >= self.properties.length:
            raise ValueError(
                f"overstretched: the clamps would be {boundary.distance:.4f} m apart, the rod is"
                f" {self.properties.length:.4f} m long"
            )

    def _set(self, positions: Array, quaternions: Array, boundary: BoundaryPoses) -> None:
        self._x, self._q = positions, quaternions
        self._set_clamps(boundary)

    def _set_clamps(self, boundary: BoundaryPoses) -> None:
        self._boundary = boundary
        self._rotations, frames = np.empty((2, 3, 3)), np.empty((2, 4))
        right = boundary.left if boundary.right is None else boundary.right
        self._clamps = np.empty((2, 4, 4))
        self._clamps[0], self._clamps[1] = boundary.left, right
        for side in range(2):
            clamp_frame(self._clamps[side], self._rotations[side], frames[side])
        self._ends = energy_kernels.Ends(frames, boundary.right is not None)

    @property
    def _shape(self):
        return self._system, self._x, self._q, self._ends

    def _linearise(self) -> None:
        if self._contact.possible:
            potential, _ = self._contact.linearise(self._shape, self._work)
        else:
            potential, _ = kernels.linearise(*self._shape, self._work)
        self._energy = move_kernels.judge(self._held, potential)[2]

    @property
    def _held(self) -> move_kernels.Held:
        return move_kernels.Held(
            self._system, self._motion, self._x, self._q, self._creep, self._clamps, self._ends,
            self._limits, self._bounds, self._work,
        )  # fmt: skip

    def _go(
        self,
        twist: Array,
        *,
        descend: bool = False,
        obstacles: Sequence[Obstacle] | None = None,
    ) -> tuple[str, float]:
        """Move by ``twist`` (12,), or ``descend`` from any shape: what is wrong, and where."""
        if self._contact.possible:
            problem, reached, self._energy = contact_moves.move(
                self._contact, self._held, self._energy, twist, descend, obstacles
            )
            return problem, reached
        outcome = move_kernels.move(self._held, self._energy, twist, descend)
        self._energy = outcome.energy
        return problem_of(outcome.status, outcome.measure, self._bounds), outcome.reached

    def _implausible(self) -> str:
        """What is wrong with the present shape, or ""."""
        status, measure, _ = move_kernels.judge(self._held, 0.0)
        problem = problem_of(status, measure, self._bounds)
        if problem or not self._contact.possible:
            return problem
        return self._contact.problem(self._x)

    def _strains(self) -> tuple[Array, Array]:
        """Strain (n, 3) of the elements and curvature (n + 1, 3) at nodes, clamps' included."""
        strain, curvature = np.empty((self.n_elements, 3)), np.empty((self.n_nodes, 3))
        energy_kernels.strains(self._arrays, self._x, self._q, self._ends, strain, curvature)
        return strain, curvature

    def _wrenches(self) -> Array:
        """(2, 6) force and torque of the clamps on the rod, world axes."""
        wrenches = np.empty((2, 6))
        held = self._ends.right_held
        move_kernels.clamp_wrenches(self._work, self._clamps, held, wrenches.reshape(12))
        return wrenches

    def _damping_wrenches(self) -> Array:
        """(2, 6) what damping adds to them in motion."""
        wrenches = damping_wrenches(
            self._system, self._motion, self._shape[1:], (self._v, self._w), self._rotations,
            self._spins,
        )  # fmt: skip
        return wrenches if self._ends.right_held else wrenches * [[1.0], [0.0]]
