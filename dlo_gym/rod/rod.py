"""The Cosserat rod: equilibrium between clamps, moves, sensitivities."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.curves import parallel_transport
from dlo_gym.geometry.se3 import Array, exp_so3, log_so3, matrix_to_quaternion
from dlo_gym.rod import _kernels_dynamics as dynamics_kernels
from dlo_gym.rod import _kernels_energy as energy_kernels
from dlo_gym.rod import _kernels_solve as kernels
from dlo_gym.rod._kernels_assembly import System
from dlo_gym.rod._kernels_clamps import clamp_frame
from dlo_gym.rod._kernels_inertia import NO_INERTIA
from dlo_gym.rod._kernels_rates import kinetic_energy
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.dynamics import clamp_path, motion_of, plan_of
from dlo_gym.rod.initial_shapes import hanging
from dlo_gym.rod.properties import RodProperties, per_element
from dlo_gym.rod.state import RodState

GRAVITY = (0.0, 0.0, -9.81)
TOLERANCE = 1e-9  # residual relative to the rod's own weight and stiffness
RIGID_JOINT = 1e-3  # of an element: the piece between clamp and element when it holds the element
LARGEST_STRAIN = 0.25  # beside what a few times the rod's own weight stretches
LARGEST_BEND = 2.4  # between neighbouring elements [rad]
LARGEST_MOVE = (0.08, 0.3)  # of one sub-step: translation per rod length, rotation [rad]
SMALLEST_SUBSTEP = 1.0 / 64.0


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
        self._arrays = _arrays(properties, n_elements, self.gravity, clamp)
        self._system = System(self._arrays, NO_INERTIA)
        self._motion = motion_of(properties, n_elements)
        stiffness = float(self._arrays.bending[:, 0].mean())
        weight = float(np.abs(self._arrays.forces).sum())
        # Differences of coordinates of about 1 m carry this much of rounding error in force.
        element_stiffness = self._arrays.shear[:, 2].max() * n_elements / properties.length
        rounding = 8.0 * np.finfo(np.float64).eps * element_stiffness
        self._limits = kernels.Limits(
            residual=TOLERANCE,
            force=stiffness / properties.length**2 + weight + rounding / TOLERANCE,
            torque=stiffness / properties.length + weight * properties.length / n_elements,
        )
        softest = self._arrays.shear[:, 2].min()
        self._largest_strain = LARGEST_STRAIN + 3.0 * weight / softest
        n_dofs = 6 * n_elements + 3
        self._work = energy_kernels.Work(
            stress=np.zeros((n_elements, 3)),
            gradient=np.zeros(n_dofs),
            band=np.zeros((n_dofs, 9)),
            clamp_terms=np.zeros((2, 4, 3)),
        )
        self._boundary: BoundaryPoses | None = None
        self._stop()

    @property
    def n_nodes(self) -> int:
        return self.n_elements + 1

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
        weight = _weight(self.properties, self.n_elements, self.gravity)
        self._arrays = self._arrays._replace(forces=weight + forces)
        self._system = self._system._replace(rod=self._arrays)

    def settle(self, boundary: BoundaryPoses, start: ArrayLike | None = None) -> RodState:
        """Find the equilibrium between clamps from afar.

        Args:
            boundary: the clamp poses.
            start: (n_nodes, 3) centerline to start from [m]; a curve that hangs between the clamps
                when omitted. Of several equilibria the one downhill from the start is found.

        Raises:
            ValueError: if the clamps are further apart than the rod is long.
            RodDiverged: if no equilibrium was found; the rod keeps its former state.
        """
        self._check_reach(boundary)
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
        self._set(positions, _frames_along(positions, boundary), boundary)
        problem = self._minimise()
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

    def move(self, displacement: BoundaryDisplacement) -> RodState:
        """Move the clamps and follow the equilibrium; large moves are taken in sub-steps.

        Raises:
            ValueError: if the rod has not settled, or the clamps would end further apart than the
                rod is long.
            RodDiverged: if the equilibrium was lost; the rod keeps its state before the move.
        """
        before = self._settled("move")
        target = before.displaced(displacement)
        self._check_reach(target)
        saved = self.state
        self._v, self._w = np.zeros((self.n_nodes, 3)), np.zeros((self.n_elements, 3))
        vector = displacement.vector
        full_stride = 1.0 / max(1.0, np.ceil(self._move_size(vector)))
        done, stride = 0.0, full_stride
        while done < 1.0:
            reached = done + stride if done + stride < 1.0 - 1e-9 else 1.0
            end = target if reached == 1.0 else before.displaced(displacement.scaled(reached))
            if self._follow(end, (reached - done) * vector):
                done = reached
                continue
            stride *= 0.5
            if stride >= SMALLEST_SUBSTEP * full_stride:
                continue
            problem = self._jump(end)
            if problem:
                self.restore(saved)
                raise RodDiverged(
                    f"the equilibrium was lost at {100 * reached:.0f} % of a move by"
                    f" {np.array2string(vector, precision=4, max_line_width=200)} [m, rad]:"
                    f" {problem}",
                    last_good=saved,
                )
            done, stride = reached, full_stride
        return self.state

    def advance(
        self,
        displacement: BoundaryDisplacement,
        duration: float,
        *,
        dt: float = 0.025,
        order: Literal[1, 2] = 2,
        tolerance: float | None = None,
    ) -> RodState:
        """Let time pass while the clamps move along ``displacement`` with constant velocity.

        Args:
            displacement: of the clamps; zero to hold them still.
            duration: [s].
            dt: largest time step [s]; 10 to 100 ms are stable for any rod.
            order: 2 for TR-BDF2, 1 for the implicit Euler method, which damps much more.
            tolerance: on the estimated error of a node's position in one step [m]; steps are
                chosen to keep it. None takes equal steps.

        Raises:
            ValueError: naming the argument; or if the rod has not settled, or the clamps would end
                further apart than the rod is long.
            RodDiverged: if no step was small enough; the rod keeps its state before.
        """
        before = self._settled("advance")
        plan = plan_of(duration, dt, order, tolerance)
        target = before.displaced(displacement)
        self._check_reach(target)
        saved = self.state
        status, reached, self._energy = dynamics_kernels.advance(
            self._system, self._motion, clamp_path(before, displacement, duration), self._ends,
            self._x, self._q, self._v, self._w, plan, self._limits, self._work,
        )  # fmt: skip
        problem = "" if status == kernels.CONVERGED else "no time step was small enough"
        problem = problem or self._implausible()
        if problem:
            self.restore(saved)
            raise RodDiverged(
                f"the motion was lost {reached:.4g} s into an advance of {duration:.4g} s:"
                f" {problem}",
                last_good=saved,
            )
        self._time += duration
        self._set_clamps(target)
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
        wrenches = self._wrenches()
        return RodState(
            positions=self._x.copy(),
            quaternions=self._q.copy(),
            curvature=curvature,
            strain=strain,
            boundary=boundary,
            wrench_left=wrenches[0],
            wrench_right=wrenches[1],
            energy=self._energy,
            stress=self._work.stress.copy(),
            velocities=self._v.copy(),
            angular_velocities=self._w.copy(),
            kinetic_energy=kinetic_energy(self._motion, self._v, self._w),
            time=self._time,
        )

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
        self._work.stress[:] = state.stress
        self._linearise()

    def sensitivity(self) -> Array:
        """d(positions)/d(clamp twists), shape (n_nodes, 3, 12), exact at the equilibrium.

        Columns are translation [m] and rotation vector [rad] in world axes, of the left clamp, then
        of the right (zero where that end is free). From the factors of the last Newton step.
        """
        self._settled("sensitivity")
        columns = np.empty((len(self._work.gradient), 12))
        kernels.sensitivity(self._work, self._rotations, self._ends.right_held, columns)
        positions = np.arange(self.n_nodes)[:, None] * 6 + np.arange(3)
        return columns[positions]

    def _settled(self, action: str) -> BoundaryPoses:
        """The clamp poses, of a rod that has some."""
        if self._boundary is None:
            raise ValueError(f"{action}: the rod has no state yet; call settle(boundary) first")
        return self._boundary

    def _stop(self) -> None:
        self._v, self._w = np.zeros((self.n_nodes, 3)), np.zeros((self.n_elements, 3))
        self._time = 0.0

    def _check_reach(self, boundary: BoundaryPoses) -> None:
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
        clamp_frame(boundary.left, self._rotations[0], frames[0])
        clamp_frame(right, self._rotations[1], frames[1])
        self._ends = energy_kernels.Ends(frames, boundary.right is not None)

    def _linearise(self) -> int:
        self._energy, negative = kernels.linearise(
            self._system, self._x, self._q, self._ends, self._work
        )  # fmt: skip
        return negative

    def _minimise(self) -> str:
        """Settle from the present shape; returns what is wrong with the result, or ""."""
        status, steps = kernels.minimise(
            self._system, self._x, self._q, self._ends, self._limits, 2000, self._work
        )  # fmt: skip
        self._linearise()
        if status != kernels.CONVERGED:
            return f"no convergence in {steps} Newton steps"
        return self._implausible()

    def _follow(self, end: BoundaryPoses, twist: Array) -> bool:
        """One sub-step to ``end``; on failure the rod is as before."""
        x, q, stress = self._x.copy(), self._q.copy(), self._work.stress.copy()
        before, energy, wrenches = self._boundary, self._energy, self._wrenches()
        assert before is not None
        rotations = self._rotations
        self._set_clamps(end)
        full_twist = np.zeros(12)
        full_twist[: len(twist)] = twist
        status, energy_after = kernels.follow(
            self._system, self._x, self._q, self._ends, full_twist, rotations, self._limits,
            self._work,
        )  # fmt: skip
        if status == kernels.CONVERGED:
            # The clamps' work bounds the energy's rise; more means another branch was reached.
            work = 0.5 * full_twist @ (wrenches + self._wrenches()).ravel()
            slack = abs(work) + 1e-3 * self._limits.torque
            if energy_after - energy <= work + slack and not self._implausible():
                self._energy = energy_after
                return True
        self._set(x, q, before)
        self._work.stress[:] = stress
        self._linearise()
        return False

    def _move_size(self, vector: Array) -> float:
        """A move's size in sub-steps that Newton's method takes with ease."""
        ends = vector.reshape(-1, 2, 3)
        translation, rotation = np.linalg.norm(ends, axis=-1).max(axis=0)
        return max(
            translation / (LARGEST_MOVE[0] * self.properties.length), rotation / LARGEST_MOVE[1]
        )

    def _jump(self, end: BoundaryPoses) -> str:
        """Past a loss of stability: descend to the equilibrium that the rod snaps to."""
        self._set_clamps(end)
        self._x[0] = end.left[:3, 3]
        if end.right is not None:
            self._x[-1] = end.right[:3, 3]
        return self._minimise()

    def _implausible(self) -> str:
        strain, curvature = self._strains()
        largest = float(np.abs(strain).max())
        if not largest < self._largest_strain:
            return f"an element is strained by {largest:.2g}, beyond {self._largest_strain:.2g}"
        voronoi = self._arrays.voronoi_length[1:-1]
        bend = float((np.linalg.norm(curvature, axis=1) * voronoi).max())
        if not bend < LARGEST_BEND:
            return f"neighbouring elements bend by {bend:.2g} rad, beyond {LARGEST_BEND:.2g}"
        return ""

    def _strains(self) -> tuple[Array, Array]:
        """Strain (n, 3) of the elements and curvature (n - 1, 3) at the inner nodes."""
        strain, curvature = np.empty((self.n_elements, 3)), np.empty((self.n_nodes, 3))
        energy_kernels.strains(self._arrays, self._x, self._q, self._ends, strain, curvature)
        return strain, curvature[1:-1].copy()

    def _wrenches(self) -> Array:
        """(2, 6) force and torque of the clamps on the rod, world axes."""
        wrenches = np.zeros((2, 6))
        wrenches[0, :3] = self._work.gradient[:3]
        wrenches[0, 3:] = self._rotations[0] @ self._work.clamp_terms[0, 0]
        if self._ends.right_held:
            wrenches[1, :3] = self._work.gradient[-3:]
            wrenches[1, 3:] = self._rotations[1] @ self._work.clamp_terms[1, 0]
        return wrenches


def _arrays(
    properties: RodProperties, n: int, gravity: Array, clamp: str
) -> energy_kernels.RodArrays:
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
    return energy_kernels.RodArrays(
        rest_length,
        np.ascontiguousarray(shear),
        np.zeros((n, 3)),
        np.concatenate([elements[:1], between, elements[-1:]]),
        np.concatenate([rest[:1], rest, rest[-1:]]),
        voronoi,
        _weight(properties, n, gravity),
    )


def _weight(properties: RodProperties, n: int, gravity: Array) -> Array:
    """(n + 1, 3) weight of each node [N]: half of the elements beside it."""
    mass = per_element(properties.linear_density, n) * properties.length / n
    nodes = np.zeros(n + 1)
    nodes[:-1] += 0.5 * mass
    nodes[1:] += 0.5 * mass
    return nodes[:, None] * gravity


def _frames_along(positions: Array, boundary: BoundaryPoses) -> Array:
    """Quaternions (n, 4) along a centerline, with the twist between the clamps spread evenly."""
    tangents = np.diff(positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    if boundary.right is None:
        frames = parallel_transport(tangents, boundary.left[:3, :3])
    else:
        carried = parallel_transport(
            np.concatenate([tangents, boundary.right[None, :3, 2]]), boundary.left[:3, :3]
        )
        frames, last = carried[:-1], carried[-1]
        twist = log_so3(last.T @ boundary.right[:3, :3])[2]
        angles = twist * (np.arange(len(frames)) + 0.5) / len(frames)
        frames = frames @ exp_so3(angles[:, None] * np.array([0.0, 0.0, 1.0]))
    return matrix_to_quaternion(frames)
