"""The multi-view tracker (Caporali et al. 2025, Algorithm 1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from dlo_gym.exceptions import DloError, TrackLost
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array, transform_points
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import ShapeEstimate
from tracking.acquisition import acquire
from tracking.correction import Clock, Sighting, fit_to_views, residuals, triangulate_nodes
from tracking.graph import EMPTY, build_graph
from tracking.projection import occupancy_mask, pixels_per_metre
from tracking.segmentation import ColourSegmenter, Segmenter

ACQUIRED = 2e-3  # standard deviation of what a search gives beside the fit's own [m]
COMPONENTS = ("prediction", "segmentation", "graph", "association", "triangulation")


class Predictor(Protocol):
    """DloPredictiveModel: how the shape follows the grippers."""

    @property
    def n_nodes(self) -> int: ...

    def predict(
        self,
        centerline: Array,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses | None = None,
    ) -> Array:
        """The centerline (n, 3) after ``displacement`` of the clamps from ``boundary``, at which
        it was ``centerline`` (n, 3) [m]."""
        ...


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of the tracker.

    Attributes:
        triangulation: "curve" fits the centerline to what is seen across it in all views;
            "paper" triangulates node by node from offsets interpolated in each view.
        passes: associations with ever narrower gates in one update; as many again may follow until
            the shape settles.
        initial_uncertainty: of the equilibrium shape the track starts from [m].
        prediction_uncertainty: of one prediction without motion [m].
        motion_uncertainty: of one prediction, added per metre that the node moves [-].
        unseen_growth: factor of the uncertainty in an update that saw nothing.
        band: half-width of the occupancy mask in standard deviations.
        smallest_band: the same at least [m].
        lost_after: time without any view of the rod until ``TrackLost`` [s].

    Raises:
        ValueError: naming the field, if a value makes no sense.
    """

    triangulation: Literal["curve", "paper"] = "curve"
    passes: int = 4
    initial_uncertainty: float = 0.02
    prediction_uncertainty: float = 0.004
    motion_uncertainty: float = 0.3
    unseen_growth: float = 1.5
    band: float = 3.0
    smallest_band: float = 0.015
    lost_after: float = 3.0

    def __post_init__(self) -> None:
        if self.triangulation not in ("curve", "paper"):
            raise ValueError(
                f"triangulation: expected 'curve' or 'paper', got {self.triangulation!r}"
            )
        if self.passes < 1:
            raise ValueError(f"passes: expected at least 1, got {self.passes}")
        if not self.unseen_growth >= 1.0:
            raise ValueError(f"unseen_growth: expected at least 1, got {self.unseen_growth}")
        for name in ("initial_uncertainty", "prediction_uncertainty", "band", "lost_after"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")


class MultiViewTracker:
    """Tracks a rod held by one or two grippers in the images of two or more fixed cameras.

    Each update predicts the shape from the grippers' motion, looks for the rod near it in every
    view, associates, corrects and triangulates. The estimate is the next update's start. No
    smoothing over time: an average inside the loop would feed its lag back.

    Args:
        predictor: how the shape follows the grippers.
        cameras: the views that may come.
        segmenter: tells the rod's pixels; a ``ColourSegmenter`` if omitted.
        config: settings.
    """

    def __init__(
        self,
        predictor: Predictor,
        cameras: Sequence[CameraModel],
        segmenter: Segmenter | None = None,
        config: TrackerConfig | None = None,
    ) -> None:
        self.predictor = predictor
        self.cameras = tuple(cameras)
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"cameras: expected one or more with distinct names, got {names}")
        self.segmenter = segmenter or ColourSegmenter()
        self.config = config or TrackerConfig()
        self._index = {name: i for i, name in enumerate(names)}
        self._estimate: ShapeEstimate | None = None
        self._residuals = np.zeros((len(self.cameras), 0))

    @property
    def residuals(self) -> Array:
        """Distance (n_views, n) [pixels] of each node from the centerline seen in each view, at
        the latest update; NaN where the node is hidden."""
        return self._residuals

    @property
    def estimate(self) -> ShapeEstimate:
        """The latest estimate."""
        if self._estimate is None:
            raise ValueError("estimate: the tracker has none yet; call initialise first")
        return self._estimate

    def initialise(
        self,
        boundary: BoundaryPoses,
        properties: RodProperties,
        *,
        centerline: Array | None = None,
        stamp: float = 0.0,
    ) -> ShapeEstimate:
        """Starts from the rod's equilibrium between the grippers, or from a given shape.

        Args:
            boundary: clamp poses now.
            properties: of the rod; stiffness and density need not be exact.
            centerline: (n, 3) shape now [m], if known better than by equilibrium.
            stamp: time [s].

        Raises:
            ValueError: if no camera has any part of the rod in its image, or the shape does not
                fit the predictor.
        """
        n = self.predictor.n_nodes
        if centerline is None:
            centerline = CosseratRod(properties, n_elements=n - 1).settle(boundary).positions
        centerline = np.array(centerline, dtype=np.float64)
        if centerline.shape != (n, 3) or not np.isfinite(centerline).all():
            raise ValueError(f"centerline: expected finite ({n}, 3), got shape {centerline.shape}")
        if not any(c.sees(c.project(centerline)).any() for c in self.cameras):
            raise ValueError(
                "cameras: expected at least one that sees the rod between the given clamps, none of"
                f" {[c.name for c in self.cameras]} does"
            )
        self._properties = properties
        self._radius = float(np.max(properties.radius))
        self._element_length = properties.length / (n - 1)
        self._boundary = boundary
        self._uncertainty = np.full(n, self.config.initial_uncertainty)
        self._fitted: set[str] = set()
        self._last_seen = self._stamp = float(stamp)
        self._fixed = np.zeros(n, dtype=bool)
        self._fixed[:2] = True
        self._fixed[n - 2 :] = boundary.right is not None
        self._estimate = ShapeEstimate(
            self._with_ends(centerline),
            np.zeros((len(self.cameras), n), dtype=bool),
            np.zeros(n),
            self._stamp,
            seen=False,
            message="no image yet",
        )
        return self._estimate

    def update(
        self,
        views: Sequence[View | None],
        displacement: BoundaryDisplacement,
        stamp: float | None = None,
    ) -> ShapeEstimate:
        """Follows one motion of the grippers and one set of images.

        Args:
            views: of the cameras that delivered one; missing views are left out or None.
            displacement: of the clamps since the last update.
            stamp: time [s]; that of the latest view if omitted.

        Returns:
            The estimate; ``message`` says what fell back to the prediction and why.

        Raises:
            TrackLost: if the rod has not been seen in any view for ``lost_after``.
            ValueError: if a view's camera is unknown or the displacement does not fit the clamps.
        """
        previous = self.estimate.centerline
        notes: list[str] = []
        timings: dict[str, float] = dict.fromkeys(COMPONENTS, 0.0)
        present = self._present(views)
        if stamp is None:
            stamp = max((view.stamp for view in present.values()), default=self._stamp)
        self._stamp = max(self._stamp, float(stamp))
        notes += [f"view {name!r} is missing" for name in self._index if name not in present]

        clock = Clock(timings)
        boundary = self._boundary.displaced(displacement)
        predicted = self._predict(previous, displacement, boundary, notes)
        motion = np.linalg.norm(predicted - previous, axis=1)
        uncertainty = np.hypot(
            self._uncertainty,
            self.config.prediction_uncertainty + self.config.motion_uncertainty * motion,
        )
        self._boundary = boundary
        clock.note("prediction")

        predicted, uncertainty = self._acquire(present, predicted, uncertainty, notes)
        clock.note("segmentation")
        sightings = [
            sighting
            for name in self._index
            if (
                sighting := self._look(
                    name, present.get(name), predicted, uncertainty, notes, clock
                )
            )
        ]
        if self.config.triangulation == "paper":
            correction = triangulate_nodes(
                predicted,
                uncertainty,
                sightings,
                self._fixed,
                self.config.prediction_uncertainty,
                clock,
            )
        else:
            correction = fit_to_views(
                predicted,
                uncertainty,
                sightings,
                self._element_length,
                self._fixed,
                self.config.passes,
                clock,
            )
        centerline, deviation = correction.centerline, correction.deviation
        visible = np.zeros((len(self.cameras), len(centerline)), dtype=bool)
        self._residuals = np.full(visible.shape, np.nan)
        for sighting, nodes in zip(sightings, correction.visible, strict=True):
            visible[sighting.row] = nodes
            self._residuals[sighting.row] = residuals(sighting, centerline, nodes)
        seen = bool(visible.any())
        if not seen:
            deviation = np.maximum(deviation, self.config.unseen_growth * self._uncertainty)
            notes.append("the rod was seen in no view: the shape is the prediction")
        self._uncertainty = np.minimum(deviation, self._properties.length)
        timings["total"] = sum(timings.values())
        self._estimate = ShapeEstimate(
            centerline,
            visible,
            np.minimum(visible.sum(axis=0), 2) / 2.0,
            self._stamp,
            seen,
            "; ".join(notes),
            timings,
        )
        if seen:
            self._last_seen = self._stamp
        elif self._stamp - self._last_seen > self.config.lost_after:
            raise TrackLost(
                f"the rod was last seen {self._stamp - self._last_seen:.2f} s ago, more than the"
                f" {self.config.lost_after:.2f} s allowed: {self._estimate.message}"
            )
        return self._estimate

    def _present(self, views: Sequence[View | None]) -> dict[str, View]:
        present = {view.camera.name: view for view in views if view is not None}
        unknown = sorted(set(present) - set(self._index))
        if unknown:
            raise ValueError(f"views: expected cameras among {list(self._index)}, got {unknown}")
        return present

    def _predict(
        self,
        previous: Array,
        displacement: BoundaryDisplacement,
        boundary: BoundaryPoses,
        notes: list[str],
    ) -> Array:
        """The predictor's shape with the held nodes where the grippers have them."""
        try:
            predicted = self.predictor.predict(previous, displacement, self._boundary)
            usable = np.shape(predicted) == previous.shape and np.isfinite(predicted).all()
            reason = "it gave no finite shape"
        except (DloError, ValueError) as error:
            predicted, usable, reason = previous, False, str(error)
        if not usable:
            notes.append(f"the predictor failed ({reason}): the shape was carried along")
            predicted = _carried(previous, displacement)
        return self._with_ends(predicted, boundary)

    def _with_ends(self, centerline: Array, boundary: BoundaryPoses | None = None) -> Array:
        """The centerline with its first and last element where the clamps hold them.

        What the ends were off by is carried into the shape, fading towards the other end, so that
        no kink remains.
        """
        boundary = boundary or self._boundary
        h = self._element_length
        left = transform_points(boundary.left, [[0.0, 0.0, 0.0], [0.0, 0.0, h]])
        share = np.linspace(0.0, 1.0, len(centerline))[:, None]
        if boundary.right is None:
            held = centerline + left[0] - centerline[0]
        else:
            right = transform_points(boundary.right, [[0.0, 0.0, -h], [0.0, 0.0, 0.0]])
            first, last = left[0] - centerline[0], right[1] - centerline[-1]
            held = centerline + (1.0 - share) * first + share * last
            held[-2:] = right
        held[:2] = left
        return held

    def _acquire(
        self,
        present: dict[str, View],
        predicted: Array,
        uncertainty: Array,
        notes: list[str],
    ) -> tuple[Array, Array]:
        """Prediction and uncertainty after a search for the rod in views that do not know its
        looks yet, if the prediction is too vague to learn them there.

        Views in which they could only be guessed are taken out of ``present``, with a note.
        """
        unknown = sorted(set(present) - self._fitted)
        if not unknown or self.config.band * uncertainty.max() <= self.config.smallest_band:
            return predicted, uncertainty
        found = acquire(
            tuple(present.values()), predicted, self._fixed, self._element_length, self._radius
        )
        if found is not None:
            curve, deviation = found
            return curve, np.hypot(deviation, ACQUIRED)
        for name in unknown:
            del present[name]
            notes.append(f"view {name!r}: nothing in it looks like the rod")
        return predicted, uncertainty

    def _look(
        self,
        name: str,
        view: View | None,
        predicted: Array,
        uncertainty: Array,
        notes: list[str],
        clock: Clock,
    ) -> Sighting | None:
        """Steps V-A1 and V-A2 in one view; None, with a note, if nothing usable is in it."""
        if view is None:
            return None
        camera = view.camera
        pixels = camera.project(predicted)
        if not camera.sees(pixels).any():
            notes.append(f"view {name!r}: the predicted rod is outside the image")
            return None
        scale = pixels_per_metre(camera, predicted)
        radii = self._radius * scale
        band = np.maximum(self.config.band * uncertainty, self.config.smallest_band) * scale
        reach = band + 2.0 * radii
        if name not in self._fitted:
            held = (True, self._boundary.right is not None)
            spread = float((self.config.band * uncertainty * scale).max())
            if not self.segmenter.fit(
                view, pixels, float(np.median(radii)), uncertainty=spread, held=held
            ):
                notes.append(f"view {name!r}: the rod cannot be told from what surrounds it")
                return None
            self._fitted.add(name)
        corner, occupancy = occupancy_mask(pixels, reach, (camera.height, camera.width))
        rows = slice(corner[1], corner[1] + occupancy.shape[0])
        columns = slice(corner[0], corner[0] + occupancy.shape[1])
        mask = self.segmenter.segment(view.image[rows, columns], name, occupancy)
        clock.note("segmentation")
        limits = (float(radii.min()), float(radii.max()))
        graph = build_graph(mask, occupancy, limits, corner) if mask.any() else EMPTY
        clock.note("graph")
        if not len(graph.edges):
            notes.append(f"view {name!r}: the rod is not in sight")
            return None
        return Sighting(
            self._index[name],
            camera,
            view.image,
            graph,
            self._element_length * scale,
            reach,
            float(np.median(radii)),
        )


def _carried(centerline: Array, displacement: BoundaryDisplacement) -> Array:
    """The centerline (n, 3) moved with its ends, linearly in between; the crudest prediction."""
    left = displacement.left[:3]
    right = left if displacement.right is None else displacement.right[:3]
    share = np.linspace(0.0, 1.0, len(centerline))[:, None]
    return centerline + (1.0 - share) * left + share * right
