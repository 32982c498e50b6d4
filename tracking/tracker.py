"""The multi-view tracker (Caporali et al. 2025, Algorithm 1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Literal, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DloError, TrackLost
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.curves import arc_length
from dlo_gym.geometry.se3 import Array, transform_points
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import ShapeEstimate
from tracking.association import Association, associate, correct_occluded
from tracking.graph import EMPTY, CenterlineGraph, build_graph
from tracking.segmentation import ColourSegmenter, Segmenter
from tracking.triangulation import (
    SIGHT_NOISE,
    Sight,
    fit_curve,
    ray_projectors,
    sight_across,
    triangulate,
)

SETTLED = 2e-4  # of any coordinate between two passes [m]
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


class _Sighting(NamedTuple):
    """One view's graph, with where the prediction lies in it."""

    row: int  # of the camera among the tracker's
    camera: CameraModel
    graph: CenterlineGraph
    scale: Array  # (n,) pixels per metre at each predicted node
    reach: Array  # (n,) half-width of the occupancy mask [pixels]
    radius: float  # of the rod [pixels]


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

        clock = _Clock(timings)
        boundary = self._boundary.displaced(displacement)
        predicted = self._predict(previous, displacement, boundary, notes)
        motion = np.linalg.norm(predicted - previous, axis=1)
        uncertainty = np.hypot(
            self._uncertainty,
            self.config.prediction_uncertainty + self.config.motion_uncertainty * motion,
        )
        self._boundary = boundary
        clock.note("prediction")

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
            centerline, visible, deviation = self._triangulate(
                predicted, uncertainty, sightings, clock
            )
        else:
            centerline, visible, deviation = self._fit(predicted, uncertainty, sightings, clock)
        self._residuals = self._measure_residuals(centerline, visible, sightings)
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

    def _look(
        self,
        name: str,
        view: View | None,
        predicted: Array,
        uncertainty: Array,
        notes: list[str],
        clock: "_Clock",
    ) -> _Sighting | None:
        """Steps V-A1 and V-A2 in one view; None, with a note, if nothing usable is in it."""
        if view is None:
            notes.append(f"view {name!r} is missing")
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
            spread = float(band.max())
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
        return _Sighting(self._index[name], camera, graph, scale, reach, float(np.median(radii)))

    def _associate(
        self, sighting: _Sighting, curve: Array, gate: Array, smallest_cosine: float = 0.5
    ) -> tuple[Array, Association]:
        """The curve's pixels in one view and what they are associated with."""
        pixels = sighting.camera.project(curve)
        overshoot = 0.5 * self._element_length * sighting.scale
        association = associate(pixels, sighting.graph, gate, overshoot, smallest_cosine)
        in_image = sighting.camera.sees(pixels)
        return pixels, association._replace(visible=association.visible & in_image)

    def _fit(
        self, predicted: Array, uncertainty: Array, sightings: list[_Sighting], clock: "_Clock"
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """Association and curve fit in turns, with ever narrower gates.

        The first turns trust the images less, so that the smooth correction that most of the rod
        asks for is found before a stray piece can bend it.
        """
        visible = np.zeros((len(self.cameras), len(predicted)), dtype=bool)
        if not sightings:
            return predicted, visible, uncertainty
        curve, fit = predicted, None
        for turn in range(2 * self.config.passes):
            cosine = 0.5 if turn == 0 else 0.85
            caution = 2.0 ** max(self.config.passes - 1 - turn, 0)
            sights: list[Sight] = []
            for sighting in sightings:
                gate = np.maximum(sighting.reach * 0.5**turn, 2.0 * sighting.radius + 2.0)
                _, found = self._associate(sighting, curve, gate, cosine)
                distance = np.linalg.norm(found.offsets, axis=1)
                weights = found.visible / (1.0 + (2.0 * distance / gate) ** 2)
                sights.append(
                    sight_across(sighting.camera, found.points, found.directions, weights)
                )
            clock.note("association")
            fit = fit_curve(
                predicted,
                curve,
                sights,
                self._element_length,
                uncertainty,
                self._fixed,
                sight_noise=caution * SIGHT_NOISE,
            )
            if not np.isfinite(fit.centerline).all():
                return predicted, visible, uncertainty
            step = np.abs(fit.centerline - curve).max()
            curve = fit.centerline
            clock.note("triangulation")
            if turn >= self.config.passes - 1 and step < SETTLED:
                break
        assert fit is not None
        deviation = fit.deviation()
        clock.note("triangulation")
        for sighting in sightings:
            gate = np.full(len(curve), sighting.radius + 1.5)
            visible[sighting.row] = self._associate(sighting, curve, gate)[1].visible
        clock.note("association")
        return curve, visible, deviation

    def _measure_residuals(
        self, centerline: Array, visible: NDArray[np.bool_], sightings: list[_Sighting]
    ) -> Array:
        residuals = np.full(visible.shape, np.nan)
        for sighting in sightings:
            _, found = self._associate(sighting, centerline, sighting.reach)
            seen = visible[sighting.row]
            residuals[sighting.row, seen] = np.linalg.norm(found.offsets[seen], axis=1)
        return residuals

    def _triangulate(
        self, predicted: Array, uncertainty: Array, sightings: list[_Sighting], clock: "_Clock"
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """Steps V-A3 and V-B: offsets completed in each view, then Eq. (1) and (2).

        A node hidden in a view weighs less there than one that is seen.
        """
        n = len(predicted)
        visible = np.zeros((len(self.cameras), n), dtype=bool)
        fixed_ends = (True, self._boundary.right is not None)
        projectors, centres, weights = [], [], []
        for sighting in sightings:
            pixels, found = self._associate(sighting, predicted, sighting.reach)
            if not found.visible.any():
                continue
            visible[sighting.row] = found.visible
            corrected = pixels + correct_occluded(found, arc_length(predicted), fixed_ends)
            rays = sighting.camera.rays(np.nan_to_num(corrected))
            projectors.append(ray_projectors(rays))
            centres.append(sighting.camera.centre)
            weights.append(np.where(found.visible, 1.0, 0.05) * np.isfinite(pixels[:, 0]))
        clock.note("association")
        centerline = predicted.copy()
        if len(centres) >= 2:
            points = triangulate(np.array(projectors), np.array(centres), np.array(weights))
            good = np.isfinite(points).all(axis=1)
            centerline[good] = points[good]
        held = self._fixed
        centerline[held] = predicted[held]
        seen = visible.any(axis=0)
        deviation = np.where(seen, self.config.prediction_uncertainty, uncertainty)
        clock.note("triangulation")
        return centerline, visible, deviation


class _Clock:
    """Adds the time since the last note to a component's milliseconds."""

    def __init__(self, timings: dict[str, float]) -> None:
        self._timings = timings
        self._last = perf_counter()

    def note(self, component: str) -> None:
        now = perf_counter()
        self._timings[component] += 1e3 * (now - self._last)
        self._last = now


def pixels_per_metre(camera: CameraModel, points: Array) -> Array:
    """Image scale (n,) [pixels/m] at points (n, 3); of a point behind the camera as at 1 mm."""
    depth = transform_points(camera.T_camera_world, points)[:, 2]
    return np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.maximum(depth, 1e-3)


def occupancy_mask(
    pixels: Array, reach: Array, shape: tuple[int, int]
) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Where the rod may be (Section V-A1): a band around its projection, cut out of the image.

    Args:
        pixels: (n, 2) projected centerline; NaN where behind the camera.
        reach: (n,) half-width of the band at each node [pixels].
        shape: (height, width) of the image.

    Returns:
        The cut-out's first (column, row) and its mask (h, w), 1 inside the band.
    """
    height, width = shape
    good = np.isfinite(pixels).min(axis=1)
    limit = 4.0 * max(height, width)
    points = np.clip(np.where(good[:, None], pixels, 0.0), -limit, limit)
    low = np.floor((points - reach[:, None])[good].min(axis=0)).astype(int)
    high = np.ceil((points + reach[:, None])[good].max(axis=0)).astype(int) + 1
    first = np.clip(low, 0, [width - 1, height - 1])
    last = np.clip(high, first + 1, [width, height])
    mask = np.zeros((last[1] - first[1], last[0] - first[0]), np.uint8)
    local = np.round(points - first).astype(np.int32)
    thickness = np.clip(2.0 * reach, 1, limit).astype(int)
    for i in range(len(points) - 1):
        if good[i] and good[i + 1]:
            ends = (local[i].tolist(), local[i + 1].tolist())
            cv2.line(mask, *ends, 1, int(max(thickness[i], thickness[i + 1])))
    return (int(first[0]), int(first[1])), mask


def _carried(centerline: Array, displacement: BoundaryDisplacement) -> Array:
    """The centerline (n, 3) moved with its ends, linearly in between; the crudest prediction."""
    left = displacement.left[:3]
    right = left if displacement.right is None else displacement.right[:3]
    share = np.linspace(0.0, 1.0, len(centerline))[:, None]
    return centerline + (1.0 - share) * left + share * right
