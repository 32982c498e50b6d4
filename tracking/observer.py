"""The tracker as an environment's observation model."""

from typing import TYPE_CHECKING, Literal

from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.rod.state import ShapeEstimate
from tracking.predictors import RodPredictor, check_predictor, make_predictor
from tracking.tracker import MultiViewTracker, TrackerConfig

if TYPE_CHECKING:
    from dlo_gym.envs.cell import SimulatedCell


class TrackerObserver:
    """Knows the rod only from the cell's images and clamp poses.

    Args:
        predictor: "network" (the shipped ``ShapePredictor``, as in the paper), which knows rods
            held at both ends, or "rod", which knows the cell's rod exactly, and what it touches;
            when omitted the network, but the rod where the right end is free.
        triangulation: see ``TrackerConfig``.
        lost_after: time unseen until ``TrackLost`` [s].
    """

    def __init__(
        self,
        predictor: Literal["network", "rod"] | None = None,
        triangulation: Literal["curve", "paper"] = "curve",
        lost_after: float = 3.0,
    ) -> None:
        self._predictor = predictor if predictor is None else check_predictor(predictor)
        self._config = TrackerConfig(triangulation=triangulation, lost_after=lost_after)
        self._tracker: MultiViewTracker | None = None

    def reset(self, cell: "SimulatedCell") -> ShapeEstimate:
        """Learns the rod's looks from the first images and tracks it in them.

        Raises:
            ValueError: if the network is asked for and the right end is free.
        """
        free = cell.boundary.right is None
        name = self._predictor or ("rod" if free else "network")
        if free and name == "network":
            raise ValueError(
                "predictor: expected rod where the right end is free, got network, which knows rods"
                " held at both ends"
            )
        views = cell.views()
        centerline = None
        if name == "rod" and cell.obstacles:
            predictor = RodPredictor(cell.properties, cell.n_nodes, rod=cell.copy_of_rod())
            # Between the same clamps a rod may lie on either side of an obstacle.
            centerline = cell.rod_state.positions
        else:
            predictor = make_predictor(name, cell.properties, cell.n_nodes)
        self._tracker = MultiViewTracker(
            predictor, [view.camera for view in views], config=self._config
        )
        self._tracker.initialise(
            cell.boundary, cell.properties, centerline=centerline, stamp=cell.stamp
        )
        at_rest = cell.boundary.displacement_to(cell.boundary)
        return self._tracker.update(views, at_rest, cell.stamp)

    def update(self, cell: "SimulatedCell", displacement: BoundaryDisplacement) -> ShapeEstimate:
        """Follows one motion.

        Raises:
            TrackLost: if the rod has not been seen for too long.
            ValueError: before the first ``reset``.
        """
        if self._tracker is None:
            raise ValueError("update: the observer has seen nothing yet; call reset first")
        return self._tracker.update(cell.views(), displacement, cell.stamp)

    def close(self) -> None:
        self._tracker = None
