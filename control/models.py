"""What the MPC plans on: a model that predicts the rod's shape over a horizon."""

from typing import NamedTuple, Protocol

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array, exp_so3
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod


class Rollout(NamedTuple):
    """Shapes along a plan of N displacements, each a linear map of m decisions.

    Attributes:
        shapes: (N, n_nodes, 3) centerlines after each displacement, world [m].
        jacobians: (N, 3 n_nodes, N m) their derivatives with respect to all decisions.
    """

    shapes: Array
    jacobians: Array


class HorizonModel(Protocol):
    """A model of the rod, with derivatives.

    The same ``directions`` (6 k, m) map each step's decisions to its displacement (6 k,), world
    axes, left then right, of the k clamps that hold the rod.
    """

    @property
    def n_nodes(self) -> int: ...

    def reset(self, boundary: BoundaryPoses, properties: RodProperties) -> None:
        """Starts an episode with a rod held in ``boundary``."""
        ...

    def step(
        self, centerline: Array, boundary: BoundaryPoses, displacement: BoundaryDisplacement
    ) -> Array:
        """The centerline (n_nodes, 3) after one displacement from ``boundary`` [m]."""
        ...

    def linearise(
        self,
        centerline: Array,
        boundary: BoundaryPoses,
        plan: Array,
        directions: Array,
        disturbance: Array,
    ) -> Rollout:
        """Shapes and derivatives along ``plan`` (N, m), ``disturbance`` (n_nodes, 3) [m] added at
        every step."""
        ...


class Predictor(Protocol):
    """A one-step shape predictor with tangents; ``dlo_gym.surrogate.ShapePredictor`` is one."""

    @property
    def n_nodes(self) -> int: ...

    def for_rod(self, properties: RodProperties) -> "Predictor": ...

    def predict(
        self,
        centerline: Array,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses | None = None,
    ) -> Array: ...

    def predict_with_tangents(
        self,
        centerline: Array,
        displacement: BoundaryDisplacement,
        centerline_tangents: Array,
        displacement_tangents: Array,
    ) -> tuple[Array, Array]: ...


class SurrogateModel:
    """Chains a one-step predictor, and its tangents, over the horizon."""

    def __init__(self, predictor: Predictor) -> None:
        self.predictor = predictor

    @property
    def n_nodes(self) -> int:
        return self.predictor.n_nodes

    def reset(self, boundary: BoundaryPoses, properties: RodProperties) -> None:
        """Takes the predictor for this rod; the clamps it knows from the centerline.

        Raises:
            ValueError: if the right end is free.
        """
        if boundary.right is None:
            raise ValueError(
                "model: the surrogate knows rods held at both ends, got a free right end; plan on"
                " the rod"
            )
        self.predictor = self.predictor.for_rod(properties)

    def step(
        self, centerline: Array, boundary: BoundaryPoses, displacement: BoundaryDisplacement
    ) -> Array:
        return self.predictor.predict(centerline, displacement, boundary)

    def linearise(
        self,
        centerline: Array,
        boundary: BoundaryPoses,
        plan: Array,
        directions: Array,
        disturbance: Array,
    ) -> Rollout:
        N, m = plan.shape
        n = self.n_nodes
        shapes, jacobians = np.empty((N, n, 3)), np.zeros((N, 3 * n, N * m))
        tangents = np.zeros((n, 3, 0))
        for k, decisions in enumerate(plan):
            seen = m * (k + 1)
            displacement_tangents = np.zeros((12, seen))
            displacement_tangents[:, -m:] = directions
            centerline, tangents = self.predictor.predict_with_tangents(
                centerline,
                BoundaryDisplacement.from_vector(directions @ decisions),
                np.concatenate([tangents, np.zeros((n, 3, m))], axis=2),
                displacement_tangents,
            )
            centerline = centerline + disturbance
            shapes[k] = centerline
            jacobians[k, :, :seen] = tangents.reshape(3 * n, seen)
        return Rollout(shapes, jacobians)


class RodModel:
    """The Cosserat rod itself as the model: as exact as the rod's properties are known.

    The shape follows from the clamp poses; what the given centerline differs by from the rod's own
    shape there is carried along unchanged.
    """

    def __init__(self, n_elements: int = 50) -> None:
        self.n_elements = n_elements
        self._rod: CosseratRod | None = None

    @property
    def n_nodes(self) -> int:
        return self.n_elements + 1

    def reset(self, boundary: BoundaryPoses, properties: RodProperties) -> None:
        self._rod = CosseratRod(properties, self.n_elements)
        self._rod.settle(boundary)

    def step(
        self, centerline: Array, boundary: BoundaryPoses, displacement: BoundaryDisplacement
    ) -> Array:
        rod = self._at(boundary)
        start = rod.state
        moved = rod.move(displacement).positions
        rod.restore(start)
        return centerline + moved - start.positions

    def linearise(
        self,
        centerline: Array,
        boundary: BoundaryPoses,
        plan: Array,
        directions: Array,
        disturbance: Array,
    ) -> Rollout:
        rod = self._at(boundary)
        start = rod.state
        N, m = plan.shape
        n = self.n_nodes
        shapes, jacobians = np.empty((N, n, 3)), np.zeros((N, 3 * n, N * m))
        twists = np.zeros((len(directions), N * m))
        try:
            for k, decisions in enumerate(plan):
                vector = directions @ decisions
                moved = rod.move(BoundaryDisplacement.from_vector(vector)).positions
                twists = _carried(twists, vector)
                twists[:, k * m : (k + 1) * m] = _left_jacobian(vector) @ directions
                shapes[k] = centerline + moved - start.positions + (k + 1) * disturbance
                sensitivity = rod.sensitivity().reshape(3 * n, 12)[:, : len(directions)]
                jacobians[k] = sensitivity @ twists
        finally:
            rod.restore(start)
        return Rollout(shapes, jacobians)

    def _at(self, boundary: BoundaryPoses) -> CosseratRod:
        """The rod, moved along to the clamp poses ``boundary``."""
        if self._rod is None:
            raise ValueError("model: the rod is not known yet; call reset(boundary, properties)")
        displacement = self._rod.state.boundary.displacement_to(boundary)
        if np.abs(displacement.vector).max() > 1e-9:
            try:
                self._rod.move(displacement)
            except RodDiverged:  # it may have been left behind, and has too far to go
                self._rod.settle(boundary)
        return self._rod


def _carried(twists: Array, vector: Array) -> Array:
    """Small motions (6 k, m) of the clamps as they appear after the displacement ``vector``."""
    carried = twists.copy()
    for first in range(3, len(vector), 6):
        rows = slice(first, first + 3)
        carried[rows] = exp_so3(vector[rows]) @ twists[rows]
    return carried


def _left_jacobian(vector: Array) -> Array:
    """d(clamp motion)/d(displacement), (6 k, 6 k), at the displacement ``vector`` (6 k,).

    The rotation blocks are the left Jacobian of SO(3): exp(w + d) = exp(J d) exp(w).
    """
    jacobian = np.eye(len(vector))
    for i in range(3, len(vector), 6):
        w = vector[i : i + 3]
        angle = float(np.linalg.norm(w))
        skew = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        if angle < 1e-4:  # the series; the closed form cancels
            first, second = 0.5, 1.0 / 6.0
        else:
            first = (1.0 - np.cos(angle)) / angle**2
            second = (angle - np.sin(angle)) / angle**3
        jacobian[i : i + 3, i : i + 3] += first * skew + second * skew @ skew
    return jacobian
