"""Where the cable is before its looks are known: one smooth curve that all views show as a ridge.

The rod's equilibrium is only a first guess: the true stiffness and rest curvature may be other
than assumed, and the curve centimetres away, beside clutter that stands out more than the cable.
What is certain are the clamps and the length. So the search runs over the ways in which a clamped
curve of constant length can bend, in 3-D, for the one along which the most of its length is a
ridge (``tracking.ridge``) in the views taken together. Another cable or an edge that crosses the
neighbourhood explains only a part of such a curve, and only in one view.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array
from tracking.association import image_tangents
from tracking.projection import pixels_per_metre
from tracking.ridge import best_path, ridge_strength, straighten
from tracking.triangulation import CurveFit, Sight, bending_modes, fit_curve, sight_across

N_MODES = 8
CURVATURE_RANGE = 2.5  # standard deviation of each mode's root mean square curvature [1/m]
# Candidates and their step, in standard deviations of the modes.
SEARCH = ((16000, 1.0), (6000, 0.5), (4000, 0.25), (2000, 0.12))
REFINEMENT = ((4000, 0.3), (2000, 0.15), (2000, 0.07), (1000, 0.03))
ELITE = 60  # candidates that go on to the next step
CLEAR = 4.0  # times the median strength, a ridge that counts in full
QUIET = 2.0  # strength that no camera's noise exceeds much, in colour levels
UNLIKELY = 0.02  # support that is worth a curve's squared amplitude of one
BEND_COST = 0.1  # of a path, per column moved and row
SMALLEST_SUPPORT = 0.35  # share of the length that must be a ridge somewhere
CORRIDOR = 0.006  # half-width of the search around the best curve [m]
CORRIDOR_SIGHT = 1e-3  # standard deviation of the ridge's place [m]
CORRIDOR_PRIOR = 0.01  # standard deviation of the best curve's place [m]


class _Ridges(NamedTuple):
    """One view's ridges around a projected curve.

    Attributes:
        camera: of the view.
        offsets: (columns,) across the curve [pixels].
        strength: (rows, columns) from 0, no ridge, to 1, a clear one.
        rows: (n,) of the nodes.
        normals: (n, 2) across the curve, in the strip's sense.
        pixels: (n, 2) of the nodes.
    """

    camera: CameraModel
    offsets: Array
    strength: NDArray[np.float32]
    rows: Array
    normals: Array
    pixels: Array


def acquire(
    views: Sequence[View],
    predicted: Array,
    fixed: NDArray[np.bool_],
    element_length: float,
    radius: float,
    *,
    seed: int = 0,
) -> tuple[Array, Array] | None:
    """The curve (n, 3) [m] near ``predicted`` (n, 3) [m] that is a ridge in the views.

    Args:
        views: that show the cable, of unknown looks.
        predicted: where it would be if its properties were as assumed.
        fixed: (n,) which nodes are held.
        element_length: [m].
        radius: of the cable [m].
        seed: of the search.

    Returns:
        The curve and the standard deviation (n,) of its nodes' places [m]; None if no curve is
        supported by the images along enough of its length.
    """
    views = [view for view in views if _can_show(view, predicted)]
    if not views:
        return None
    rng = np.random.default_rng(seed)
    curve = predicted
    for steps in (SEARCH, REFINEMENT):
        modes = bending_modes(curve, element_length, fixed, N_MODES, CURVATURE_RANGE)
        reach = steps[0][1] * 2.0 * float(np.linalg.norm(modes[0], axis=1).max())
        fields = [_ridges(view, curve, radius, reach) for view in views]
        amplitudes, support = _search(fields, curve, modes, steps, rng)
        if support < SMALLEST_SUPPORT:
            return None
        bent = curve + np.tensordot(amplitudes, modes, axes=1)
        curve = _fitted(bent, [], fixed, element_length).centerline
    fit = _onto_ridges(views, curve, fixed, element_length, radius)
    fit = _onto_ridges(views, fit.centerline, fixed, element_length, radius)
    if not np.isfinite(fit.centerline).all():
        return None
    return fit.centerline, fit.deviation()


def _can_show(view: View, curve: Array) -> bool:
    """Whether enough of a curve (n, 3) [m] is in the image, and not seen end on."""
    pixels = view.camera.project(curve)
    if not np.isfinite(pixels).all() or np.ptp(pixels, axis=0).max() < len(curve):
        return False
    return bool(view.camera.sees(pixels).mean() >= SMALLEST_SUPPORT)


def _ridges(view: View, curve: Array, radius: float, reach: float) -> _Ridges:
    """The ridges within ``reach`` [m] of a curve (n, 3) [m]."""
    camera = view.camera
    pixels = camera.project(curve)
    scale = float(np.median(pixels_per_metre(camera, curve)))
    strip = straighten(view.image, pixels, radius * scale, reach * scale)
    strength = ridge_strength(strip)
    noise = float(np.median(strength)) + QUIET
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    rows = lengths / lengths[-1] * (len(strength) - 1)
    in_image = np.interp(np.arange(len(strength)), rows, camera.sees(pixels)) > 0.5
    strength[~in_image] = 0.0
    tangents = image_tangents(pixels)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    clear = np.minimum(strength / (CLEAR * noise), 1.0).astype(np.float32)
    return _Ridges(camera, strip.offsets, clear, rows, normals, pixels)


def _search(
    fields: Sequence[_Ridges],
    curve: Array,
    modes: Array,
    steps: Sequence[tuple[int, float]],
    rng: np.random.Generator,
) -> tuple[Array, float]:
    """Amplitudes (k,) of the modes (k, n, 3) best supported by all views, and the share of the
    length that is a ridge in the view that shows the most."""
    looks = []
    for field in fields:
        rows = max(round(len(field.strength) / len(curve)), 1)
        smooth = cv2.blur(field.strength, (1, rows))
        across = _across(field, curve, modes) / (field.offsets[1] - field.offsets[0])
        looks.append((smooth, np.round(field.rows).astype(np.int64), across))
    candidates = np.zeros((1, len(modes)))
    scores = np.zeros(1)
    for count, step in steps:
        parents = candidates[rng.integers(len(candidates), size=count)]
        candidates = np.vstack(
            [candidates, parents + step * rng.standard_normal((count, len(modes)))]
        )
        scores = -0.5 * UNLIKELY * (candidates**2).sum(axis=1)
        for smooth, rows, across in looks:
            scores += _support(smooth, rows, across, candidates)
        best = np.argsort(-scores)[:ELITE]
        candidates, scores = candidates[best], scores[best]
    support = max(
        float(_support(smooth, rows, across, candidates[:1])[0]) for smooth, rows, across in looks
    )
    return candidates[0], support


def _across(field: _Ridges, curve: Array, modes: Array) -> Array:
    """Displacement (k, n) [pixels] across the projected curve by each mode (k, n, 3)."""
    small = 1e-2
    moved = field.camera.project(curve + small * modes) - field.pixels
    return (moved * field.normals).sum(axis=2) / small


@numba.njit(cache=True)
def _support(strength, rows, across, candidates):  # pragma: no cover
    """Mean strength (c,) along each candidate's curve, amplitudes (c, k)."""
    middle = strength.shape[1] // 2
    n = len(rows)
    support = np.zeros(len(candidates))
    for c in range(len(candidates)):
        total = 0.0
        for i in range(n):
            offset = 0.0
            for k in range(across.shape[0]):
                offset += across[k, i] * candidates[c, k]
            column = middle + int(np.rint(offset))
            if 0 <= column < strength.shape[1]:
                total += strength[rows[i], column]
        support[c] = total / n
    return support


def _onto_ridges(
    views: Sequence[View],
    curve: Array,
    fixed: NDArray[np.bool_],
    element_length: float,
    radius: float,
) -> CurveFit:
    """The curve moved onto the strongest ridges beside it, at constant length."""
    sights = []
    for view in views:
        field = _ridges(view, curve, radius, CORRIDOR)
        path = best_path(field.strength, (bool(fixed[0]), bool(fixed[-1])), BEND_COST)
        along = np.arange(len(path))
        offsets = np.interp(field.rows, along, field.offsets[path])
        weights = np.interp(field.rows, along, field.strength[along, path])
        points = field.pixels + offsets[:, None] * field.normals
        sights.append(sight_across(field.camera, points, image_tangents(points), weights**2))
    return _fitted(curve, sights, fixed, element_length)


def _fitted(
    curve: Array, sights: Sequence[Sight], fixed: NDArray[np.bool_], element_length: float
) -> CurveFit:
    """The curve made to agree with the sights, and its elements as long as they are."""
    uncertainty = np.full(len(curve), CORRIDOR_PRIOR)
    return fit_curve(
        curve,
        curve,
        sights,
        element_length,
        uncertainty,
        fixed,
        sight_noise=CORRIDOR_SIGHT,
        iterations=3,
    )
