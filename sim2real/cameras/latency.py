"""A camera's latency against the arms' clock, from a gripper that moves in its view."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.geometry.se3 import Array

STEP = 0.002  # of the search [s]; far below the width of any arm motion's optimum
MIN_IMAGES = 20
MIN_EXPLAINED = 0.8  # share of the pixels' variance that the arm's motion must explain
AMBIGUITY = 2.0  # a second optimum must leave this many times more unexplained than the first


@dataclass(frozen=True)
class LatencyEstimate:
    """How much older than its stamp a camera's image is.

    Attributes:
        latency: to subtract from the stamps that were given [s].
        standard_error: of ``latency``, from the noise left and the sharpness of the optimum [s].
        explained: share of the pixels' variance that the shifted motion explains, at most 1.
        residual: root mean square of what is left [pixels].
        motion: root mean square of the pixels about their mean [pixels].
        n_images: that took part.
    """

    latency: float
    standard_error: float
    explained: float
    residual: float
    motion: float
    n_images: int


def estimate_latency(
    image_stamps: ArrayLike,
    pixels: ArrayLike,
    pose_stamps: ArrayLike,
    positions: ArrayLike,
    *,
    search: tuple[float, float] = (-0.05, 0.5),
    min_motion: float = 5.0,
) -> LatencyEstimate:
    """The time shift under which an arm's reported motion best explains the seen one.

    The pixels are taken as an affine function of the position, fitted anew for each shift, so
    that no calibration is needed; for large motions give the positions as projected by the
    calibrated camera. Move irregularly: a periodic motion fits at many shifts and is refused.

    Args:
        image_stamps: (n,) of the images, by arrival or as claimed, monotonic [s].
        pixels: (n, k) where something rigid with the gripper was seen; a row with NaN is an
            image in which it was not found.
        pose_stamps: (m,) increasing, monotonic [s].
        positions: (m, d) of that thing [m], or its predicted pixels; d at most 3.
        search: smallest and largest latency considered [s].
        min_motion: root mean square about the mean below which the motion says nothing [pixels].

    Raises:
        ValueError: on wrong shapes, too few images within the poses' time, too small a motion,
            one that the positions do not explain, an ambiguous one, or an optimum at the end of
            the search.
    """
    image_stamps, pixels = _check_samples(image_stamps, pixels, "pixels")
    pose_stamps, positions = _check_samples(pose_stamps, positions, "positions")
    if not np.isfinite(positions).all() or not (np.diff(pose_stamps) > 0).all():
        raise ValueError("pose_stamps, positions: expected finite values at increasing times")
    first, last = search
    if not last - first >= 5 * STEP:
        raise ValueError(f"search: expected a range of at least {5 * STEP:g} s, got {search}")
    # The same images at every shift: errors over different images would not compare.
    usable = np.isfinite(pixels).all(axis=1)
    usable &= image_stamps - last >= pose_stamps[0]
    usable &= image_stamps - first <= pose_stamps[-1]
    image_stamps, pixels = image_stamps[usable], pixels[usable]
    if len(pixels) < MIN_IMAGES:
        raise ValueError(
            f"pixels: expected at least {MIN_IMAGES} images with poses from {last:g} s before to"
            f" {-first:g} s after, got {len(pixels)}"
        )
    centred = pixels - pixels.mean(axis=0)
    motion = float(np.sqrt((centred**2).sum(axis=1).mean()))
    if not motion >= min_motion:
        raise ValueError(
            f"pixels: expected a motion of at least {min_motion:g} pixels root mean square,"
            f" got {motion:.2g}; move the gripper further"
        )
    shifts = np.arange(first, last + STEP / 2, STEP)
    errors = np.array(
        [
            _unexplained(centred, _positions_at(image_stamps - shift, pose_stamps, positions))
            for shift in shifts
        ]
    )
    return _at_optimum(shifts, errors, centred, positions.shape[1])


def _at_optimum(shifts: Array, errors: Array, centred: Array, d: int) -> LatencyEstimate:
    """The estimate from squared errors (n_shifts,) over the search."""
    n, k = centred.shape
    total = float((centred**2).sum())
    best = int(np.argmin(errors))
    explained = 1.0 - float(errors[best]) / total
    if explained < MIN_EXPLAINED:
        raise ValueError(
            "pixels: expected the motion that the poses report, but at the best shift"
            f" ({shifts[best]:.3f} s) they explain only {max(explained, 0.0):.0%} of it"
        )
    if best in (0, len(shifts) - 1):
        raise ValueError(
            f"search: expected the latency inside {shifts[0]:g} to {shifts[-1]:g} s, got its best"
            " fit at the end; widen the search"
        )
    _check_unique(shifts, errors / total, best)
    before, at, after = errors[best - 1 : best + 2]
    curvature = max((before - 2.0 * at + after) / STEP**2, np.finfo(float).tiny)
    offset = 0.5 * (before - after) / (before - 2.0 * at + after) if before + after > 2 * at else 0
    variance = float(at) / max(n * k - k * (d + 1) - 1, 1)
    return LatencyEstimate(
        latency=float(shifts[best] + STEP * offset),
        standard_error=float(np.sqrt(2.0 * variance / curvature)),
        explained=explained,
        residual=float(np.sqrt(at / n)),
        motion=float(np.sqrt(total / n)),
        n_images=n,
    )


def _check_unique(shifts: Array, unexplained: Array, best: int) -> None:
    inner = unexplained[1:-1]
    dips = 1 + np.flatnonzero((inner <= unexplained[:-2]) & (inner <= unexplained[2:]))
    # Noise ripples the optimum itself; another one lies beyond a rise out of it.
    limit = AMBIGUITY * unexplained[best] + 0.02
    for dip in dips:
        low, high = sorted((best, int(dip)))
        if unexplained[dip] < limit <= unexplained[low : high + 1].max():
            raise ValueError(
                f"pixels: the motion fits at {shifts[best]:.3f} s and at {shifts[dip]:.3f} s"
                " alike; move less regularly"
            )


def _unexplained(centred: Array, positions: Array) -> float:
    """Squared error of the best affine map from positions (n, d) to centred pixels (n, k)."""
    basis = positions - positions.mean(axis=0)
    coefficients = np.linalg.lstsq(basis, centred, rcond=1e-9)[0]
    return float(((centred - basis @ coefficients) ** 2).sum())


def _positions_at(times: Array, stamps: Array, positions: Array) -> Array:
    return np.column_stack([np.interp(times, stamps, column) for column in positions.T])


def _check_samples(stamps: ArrayLike, values: ArrayLike, name: str) -> tuple[Array, Array]:
    stamps = np.asarray(stamps, dtype=np.float64)
    values = np.asarray(values, dtype=np.float64)
    if stamps.ndim != 1 or values.ndim != 2 or len(stamps) != len(values) or not len(stamps):
        raise ValueError(
            f"{name}: expected shape (n, d) with n stamps, got {values.shape} with stamps of shape"
            f" {stamps.shape}"
        )
    if not np.isfinite(stamps).all():
        raise ValueError(f"{name}: expected finite stamps, got NaN or infinity")
    return stamps, values
