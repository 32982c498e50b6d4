"""From the prediction and what each view shows to the shape (Section V-A3 and V-B)."""

from collections.abc import Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.curves import arc_length
from dlo_gym.geometry.se3 import Array
from tracking.association import Association, associate, correct_occluded
from tracking.borders import centre_between_borders
from tracking.graph import CenterlineGraph
from tracking.triangulation import (
    SIGHT_NOISE,
    Sight,
    fit_curve,
    ray_projectors,
    sight_across,
    triangulate,
)

SETTLED = 2e-4  # of any coordinate between two passes [m]


class Sighting(NamedTuple):
    """One view's graph, with where the prediction lies in it.


    Attributes:
        row: of the camera among the tracker's.
        camera: of the view.
        image: (h, w, 3).
        graph: of the centerlines seen.
        spacing: (n,) distance between nodes seen across [pixels].
        reach: (n,) half-width of the occupancy mask [pixels].
        radius: of the rod [pixels].
    """

    row: int
    camera: CameraModel
    image: NDArray[np.uint8]
    graph: CenterlineGraph
    spacing: Array
    reach: Array
    radius: float


class Correction(NamedTuple):
    """A prediction corrected by the views.

    Attributes:
        centerline: (n, 3) [m].
        visible: (sightings, n) whether each node is seen in each of the views given.
        deviation: (n,) standard deviation of the nodes' places [m].
    """

    centerline: Array
    visible: NDArray[np.bool_]
    deviation: Array


class Clock:
    """Adds the time since the last note to a component's milliseconds."""

    def __init__(self, timings: dict[str, float]) -> None:
        self._timings = timings
        self._last = perf_counter()

    def note(self, component: str) -> None:
        now = perf_counter()
        self._timings[component] += 1e3 * (now - self._last)
        self._last = now


def fit_to_views(
    predicted: Array,
    uncertainty: Array,
    sightings: Sequence[Sighting],
    element_length: float,
    fixed: NDArray[np.bool_],
    passes: int,
    clock: Clock,
) -> Correction:
    """Association and curve fit in turns, with ever narrower gates.

    The first turns trust the images less, so that the smooth correction that most of the rod
    asks for is found before a stray piece can bend it; the last ones measure the centre between
    the cable's borders.

    Args:
        predicted: (n, 3) [m].
        uncertainty: (n,) standard deviation of the prediction [m].
        sightings: of the views that show something.
        element_length: of the rod [m].
        fixed: (n,) which nodes are held.
        passes: turns; as many again may follow until the shape settles.
        clock: for the components' times.
    """
    visible = np.zeros((len(sightings), len(predicted)), dtype=bool)
    unchanged = Correction(predicted, visible, uncertainty)
    if not sightings:
        return unchanged
    curve, fit = predicted, None
    for turn in range(2 * passes):
        cosine = 0.5 if turn == 0 else 0.85
        caution = 2.0 ** max(passes - 1 - turn, 0)
        sights: list[Sight] = []
        for sighting in sightings:
            gate = np.maximum(sighting.reach * 0.5**turn, 2.0 * sighting.radius + 2.0)
            _, found = _associate(sighting, curve, gate, cosine)
            points = _centred(sighting, found) if turn >= passes - 1 else found.points
            distance = np.linalg.norm(found.offsets, axis=1)
            weights = found.visible / (1.0 + (2.0 * distance / gate) ** 2)
            sights.append(sight_across(sighting.camera, points, found.directions, weights))
        clock.note("association")
        fit = fit_curve(
            predicted,
            curve,
            sights,
            element_length,
            uncertainty,
            fixed,
            sight_noise=caution * SIGHT_NOISE,
        )
        if not np.isfinite(fit.centerline).all():
            return unchanged
        step = np.abs(fit.centerline - curve).max()
        curve = fit.centerline
        clock.note("triangulation")
        if turn >= passes - 1 and step < SETTLED:
            break
    assert fit is not None
    deviation = fit.deviation()
    clock.note("triangulation")
    for seen, sighting in zip(visible, sightings, strict=True):
        gate = np.full(len(curve), sighting.radius + 1.5)
        seen[:] = _associate(sighting, curve, gate)[1].visible
    clock.note("association")
    return Correction(curve, visible, deviation)


def triangulate_nodes(
    predicted: Array,
    uncertainty: Array,
    sightings: Sequence[Sighting],
    fixed: NDArray[np.bool_],
    seen_deviation: float,
    clock: Clock,
) -> Correction:
    """Steps V-A3 and V-B as in the paper: offsets completed in each view, then Eq. (1) and (2).

    A node hidden in a view weighs less there than one that is seen. Arguments as in
    ``fit_to_views``; ``seen_deviation`` [m] is the result's where a node is seen.
    """
    visible = np.zeros((len(sightings), len(predicted)), dtype=bool)
    fixed_ends = (bool(fixed[0]), bool(fixed[-1]))
    projectors, centres, weights = [], [], []
    for seen, sighting in zip(visible, sightings, strict=True):
        pixels, found = _associate(sighting, predicted, sighting.reach)
        if not found.visible.any():
            continue
        seen[:] = found.visible
        corrected = pixels + correct_occluded(found, arc_length(predicted), fixed_ends)
        rays = sighting.camera.rays(np.nan_to_num(corrected))
        projectors.append(ray_projectors(rays))
        centres.append(sighting.camera.centre)
        weights.append(np.where(found.visible, 1.0, 0.05) * np.isfinite(pixels[:, 0]))
    clock.note("association")
    centerline = predicted.copy()
    if len(centres) >= 2:
        points = triangulate(np.array(projectors), np.array(centres), np.array(weights))
        good = np.isfinite(points).all(axis=1) & ~fixed
        centerline[good] = points[good]
    deviation = np.where(visible.any(axis=0), seen_deviation, uncertainty)
    clock.note("triangulation")
    return Correction(centerline, visible, deviation)


def residuals(sighting: Sighting, centerline: Array, visible: NDArray[np.bool_]) -> Array:
    """Distance (n,) [pixels] of nodes from the seen centerline; NaN where not ``visible``."""
    _, found = _associate(sighting, centerline, sighting.reach)
    return np.where(visible, np.linalg.norm(found.offsets, axis=1), np.nan)


def _associate(
    sighting: Sighting, curve: Array, gate: Array, smallest_cosine: float = 0.5
) -> tuple[Array, Association]:
    """The curve's pixels in one view and what they are associated with."""
    pixels = sighting.camera.project(curve)
    association = associate(pixels, sighting.graph, gate, 0.5 * sighting.spacing, smallest_cosine)
    in_image = sighting.camera.sees(pixels)
    return pixels, association._replace(visible=association.visible & in_image)


def _centred(sighting: Sighting, found: Association) -> Array:
    """The associated points (n, 2) [pixels], those that are visible between the borders."""
    points = found.points.copy()
    seen = found.visible
    if seen.any():
        points[seen] = centre_between_borders(
            sighting.image,
            points[seen],
            found.directions[seen],
            sighting.radius,
            float(np.median(sighting.spacing)),
        )
    return points
