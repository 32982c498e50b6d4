"""The tracker's predictors by name: the rod itself, or the network that learnt it."""

import numpy as np

from dlo_gym.exceptions import RodDiverged
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from tracking.tracker import Predictor

PREDICTORS = ("network", "rod")
# Clamps moved less far than this are followed [m], [rad]; farther, the rod settles from scratch.
NEAR = (0.05, 0.3)


class RodPredictor:
    """Predicts with a quasi-static Cosserat rod, also for a rod held by one gripper.

    The rod gives the change of equilibrium; what the tracker saw beside the old equilibrium (other
    stiffness, swing) is kept in part.

    Args:
        properties: of the rod.
        n_nodes: of the centerline.
        rod: a settled rod to go on with, among what it touches; else one that touches nothing.
        memory: share of the difference between the given shape and the old equilibrium that is
            carried over, from 0 (the new equilibrium) to 1.
    """

    def __init__(
        self,
        properties: RodProperties,
        n_nodes: int = 51,
        *,
        rod: CosseratRod | None = None,
        memory: float = 0.8,
    ) -> None:
        if not 0.0 <= memory <= 1.0:
            raise ValueError(f"memory: expected a share from 0 to 1, got {memory}")
        self.memory = memory
        self._rod = rod or CosseratRod(properties, n_elements=n_nodes - 1)
        self._boundary: BoundaryPoses | None = None if rod is None else rod.state.boundary

    @property
    def n_nodes(self) -> int:
        return self._rod.n_nodes

    def predict(
        self,
        centerline: Array,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses | None = None,
    ) -> Array:
        """The centerline (n, 3) [m] after ``displacement`` of the clamps from ``boundary``.

        Raises:
            ValueError: if the clamps are not given at the first prediction, or end up further
                apart than the rod is long.
            RodDiverged: if no equilibrium is found.
        """
        boundary = boundary or self._boundary
        if boundary is None:
            raise ValueError("boundary: expected the clamp poses at the first prediction, got None")
        before = self._at(boundary)
        # Diverged or refused, the rod stays where it was: the next prediction settles anew.
        self._boundary = None
        after = self._rod.move(displacement).positions
        self._boundary = boundary.displaced(displacement)
        return after + self.memory * (centerline - before)

    def _at(self, boundary: BoundaryPoses) -> Array:
        """The equilibrium (n, 3) [m] with the clamps at ``boundary``."""
        if self._boundary is not None and _same(self._boundary, boundary):
            return self._rod.state.positions
        if self._boundary is not None:
            displacement = self._boundary.displacement_to(boundary)
            steps = np.linalg.norm(displacement.vector.reshape(-1, 2, 3), axis=2)
            if (steps < NEAR).all():
                try:
                    return self._rod.move(displacement).positions
                except RodDiverged:
                    pass
        return self._rod.settle(boundary).positions


def _same(a: BoundaryPoses, b: BoundaryPoses) -> bool:
    if not np.allclose(a.left, b.left, rtol=0.0, atol=1e-7):
        return False
    if a.right is None or b.right is None:
        return a.right is b.right
    return np.allclose(a.right, b.right, rtol=0.0, atol=1e-7)


def check_predictor(name: str) -> str:
    if name not in PREDICTORS:
        raise ValueError(f"predictor: expected one of {PREDICTORS}, got {name!r}")
    return name


def make_predictor(name: str, properties: RodProperties, n_nodes: int = 51) -> Predictor:
    """The predictor called "network" or "rod" for a rod of ``n_nodes``.

    Raises:
        ValueError: for another name, or a number of nodes the network was not trained for.
        WeightsError: if the network's weights are missing or damaged.
    """
    if check_predictor(name) == "rod":
        return RodPredictor(properties, n_nodes)
    from dlo_gym.surrogate.predictor import ShapePredictor

    network = ShapePredictor.load(properties=properties)
    if network.n_nodes != n_nodes:
        raise ValueError(
            f"predictor: the network was trained for {network.n_nodes} nodes, got a rod of"
            f" {n_nodes}; take predictor='rod' for another number"
        )
    return network
