"""The same rod in PyElastica, with both ends clamped to moving poses: the independent engine."""

import elastica
import numpy as np
from numba import njit

from dlo_gym.geometry.se3 import Array, exp_so3
from dlo_gym.rod import BoundaryDisplacement, RodProperties, RodState

TIME_STEP = 1e-4


class _Simulator(
    elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping
):
    pass


@njit(cache=True)
def _clamp(position, directors, velocity, omega, targets, frames):
    position[:, 0], position[:, -1] = targets[0], targets[1]
    directors[:, :, 0], directors[:, :, -1] = frames[0], frames[1]
    velocity[:, 0] = velocity[:, -1] = 0.0
    omega[:, 0] = omega[:, -1] = 0.0


@njit(cache=True)
def _stop(velocity, omega):
    velocity[:, 0] = velocity[:, -1] = 0.0
    omega[:, 0] = omega[:, -1] = 0.0


class _MovingClamps(elastica.ConstraintBase):
    """Both ends' positions, directors and zero rates, along precomputed poses, one per step."""

    def __init__(self, targets: Array, frames: Array, **kwargs) -> None:
        super().__init__(**kwargs)
        self.targets, self.frames = targets, frames

    def constrain_values(self, system, time) -> None:
        step = min(int(time / TIME_STEP), len(self.targets) - 1)
        _clamp(
            system.position_collection, system.director_collection,
            system.velocity_collection, system.omega_collection,
            self.targets[step], self.frames[step],
        )  # fmt: skip

    def constrain_rates(self, system, time) -> None:
        _stop(system.velocity_collection, system.omega_collection)


class PyElasticaRod:
    """A PyElastica rod that starts at ``state`` and follows ``displacement`` of its clamps.

    Args:
        duration: of the motion [s]; afterwards the clamps hold still.
        damping: uniform damping constant [1/s].
    """

    def __init__(
        self,
        properties: RodProperties,
        state: RodState,
        displacement: BoundaryDisplacement,
        *,
        duration: float,
        damping: float = 5.0,
    ) -> None:
        n = state.n_nodes - 1
        assert state.boundary.right is not None
        assert displacement.right is not None
        self._simulator = _Simulator()
        self._rod = elastica.CosseratRod.straight_rod(
            n, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]),
            properties.length, properties.radius, properties.density,
            youngs_modulus=properties.youngs_modulus, shear_modulus=properties.shear_modulus,
        )  # fmt: skip
        self._rod.position_collection[:] = state.positions.T
        # PyElastica keeps directors as rows.
        self._rod.director_collection[:] = np.moveaxis(state.directors, 0, 2).transpose(1, 0, 2)
        self._simulator.append(self._rod)
        steps = max(1, round(duration / TIME_STEP))
        fractions = np.linspace(0.0, 1.0, steps + 1)[:, None]
        targets, frames = [], []
        for clamp, twist in (
            (state.boundary.left, displacement.left),
            (state.boundary.right, displacement.right),
        ):
            targets.append(clamp[:3, 3] + fractions * twist[:3])
            turned = exp_so3(fractions * twist[3:]) @ clamp[:3, :3]
            frames.append(np.swapaxes(turned, 1, 2))
        self._simulator.constrain(self._rod).using(
            _MovingClamps, targets=np.stack(targets, 1), frames=np.stack(frames, 1)
        )
        self._simulator.add_forcing_to(self._rod).using(
            elastica.GravityForces, acc_gravity=np.array([0.0, 0.0, -9.81])
        )
        self._simulator.dampen(self._rod).using(
            elastica.AnalyticalLinearDamper, uniform_damping_constant=damping, time_step=TIME_STEP
        )
        self._simulator.finalize()
        self._stepper = elastica.PositionVerlet()
        self._time = np.float64(0.0)

    def advance(self, seconds: float) -> None:
        for _ in range(round(seconds / TIME_STEP)):
            self._time = self._stepper.step(self._simulator, self._time, np.float64(TIME_STEP))

    @property
    def positions(self) -> Array:
        """(n_nodes, 3) centerline [m]."""
        return self._rod.position_collection.T.copy()

    @property
    def speed(self) -> float:
        """The fastest node's [m/s]."""
        return float(np.linalg.norm(self._rod.velocity_collection, axis=0).max())
