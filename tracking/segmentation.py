"""Which pixels are the cable: the ``Segmenter`` protocol and a colour model fitted on the spot."""

from dataclasses import dataclass
from typing import Any, Protocol

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dlo_gym.geometry.camera import View
from dlo_gym.geometry.se3 import Array
from tracking.ridge import Strip, best_path, ridge_strength, straighten

Colours = NDArray[np.float32]

BITS = 5  # per channel of the colour table
LEVELS = 1 << BITS
CLEAR = 6.0  # times the median strength, a ridge that counts in full
RAREST = 0.08  # share of the cable's pixels below which a colour is not the cable's


class Segmenter(Protocol):
    """Tells the cable's pixels in one view from the rest."""

    def fit(
        self,
        view: View,
        pixels: Array,
        radius: float,
        *,
        uncertainty: float,
        held: tuple[bool, bool],
    ) -> bool:
        """Learns the cable's appearance in this view; whether it can now be told apart.

        Args:
            pixels: (n, 2) where the cable is expected [pixels].
            radius: of the cable [pixels].
            uncertainty: how far it may lie from there [pixels].
            held: whether the first and last node are held, so that their place is certain.
        """
        ...

    def segment(
        self, image: NDArray[np.uint8], camera_name: str, occupancy: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Mask (h, w), non-zero on cable pixels, of a cut-out (h, w, 3) of the camera's image.

        Pixels where ``occupancy`` (h, w) is zero need not be looked at.
        """
        ...


@dataclass(frozen=True)
class ColourConfig:
    """Settings of the colour model.

    Attributes:
        brightness_range: standard deviation of the log of the shading that the cable may meet
            elsewhere than where it was learnt.
        background_brightness_range: the same of the background.
        cable_share: share of the pixels near the cable expected to be the cable's.
        novelty: weight of "a colour never seen, therefore not the cable" against the background.
        smallest_separation: of the cable's and the background's pixels by the model, share of the
            first told right minus share of the second told wrong, below which the view is
            not usable.
    """

    brightness_range: float = 0.15
    background_brightness_range: float = 0.04
    cable_share: float = 0.3
    novelty: float = 0.5
    smallest_separation: float = 0.4


class ColourSegmenter:
    """A table from colour to "cable or not", per camera, from the first image of each.

    The cable's place in that image is found by its shape alone (``tracking.ridge``), so the model
    assumes no colour and needs no exact prediction. Its pixels and its surroundings' give two
    smoothed colour histograms; the table is their likelihood ratio.
    """

    def __init__(self, config: ColourConfig | None = None, *, seed: int = 0) -> None:
        self.config = config or ColourConfig()
        self._seed = seed
        self._tables: dict[str, NDArray[np.uint8]] = {}

    def fit(
        self,
        view: View,
        pixels: Array,
        radius: float,
        *,
        uncertainty: float,
        held: tuple[bool, bool],
    ) -> bool:
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if len(pixels) < 3 or view.camera.sees(pixels).mean() < 0.2:
            return False
        strip = straighten(view.image, pixels, radius, uncertainty + 8.0 * radius)
        strength = ridge_strength(strip)
        noise = float(np.median(strength)) + 1.0
        # A ridge is clear or not: one that stands out more is not the more likely the cable.
        strength = np.minimum(strength, CLEAR * noise)
        table = self._learn(strip, strength, held, noise)
        if table is None:
            return False
        # Second look: only along the first path's colours, so that a distractor that the path
        # strayed to for a while does not stay in the model.
        likely = table[tuple(_quantise(strip.colours).transpose(2, 0, 1))]
        table = self._learn(strip, (strength * likely).astype(np.float32), held, noise)
        if table is None:
            return False
        self._tables[view.camera.name] = (table >= 0.5).astype(np.uint8)
        return True

    def _learn(
        self, strip: Strip, strength: NDArray[np.float32], held: tuple[bool, bool], noise: float
    ) -> Array | None:
        """The likelihood table of the strongest ridge; None if it does not tell it apart."""
        path = best_path(strength, held, bend_cost=0.5 * noise)
        cable, background = _samples(strip, strength, path, noise)
        if len(cable) < 20 or len(background) < 20:
            return None
        table = self._likelihood_table(cable, background)
        separation = _share(table, cable) - _share(table, background)
        return table if separation >= self.config.smallest_separation else None

    def segment(
        self, image: NDArray[np.uint8], camera_name: str, occupancy: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        if camera_name not in self._tables:
            raise ValueError(
                f"camera_name: expected a camera the model was fitted to,"
                f" {sorted(self._tables)}, got {camera_name!r}"
            )
        return _apply(image, self._tables[camera_name], occupancy)

    def _likelihood_table(self, cable: Colours, background: Colours) -> Array:
        """P(cable | colour) over the quantised colours (levels, levels, levels)."""
        rng = np.random.default_rng(self._seed)
        cable_density = _density(cable, self.config.brightness_range, rng)
        other_density = _density(background, self.config.background_brightness_range, rng)
        share = self.config.cable_share
        evidence = share * cable_density
        against = (1.0 - share) * (other_density + self.config.novelty / cable_density.size)
        return evidence / (evidence + against)


def _samples(
    strip: Strip, strength: NDArray[np.float32], path: NDArray[np.int64], noise: float
) -> tuple[Colours, Colours]:
    """Colours (k, 3) on the path where it is a clear ridge, and (j, 3) away from it."""
    along = strength[np.arange(len(path)), path]
    clear = along > max(0.4 * float(np.quantile(along, 0.8)), 2.0 * noise)
    distance = np.abs(strip.offsets[None, :] - strip.offsets[path][:, None])
    inside = distance <= 0.7 * strip.radius
    counts = np.maximum(inside.sum(axis=1, keepdims=True), 1)
    mean_colours = (strip.colours * inside[..., None]).sum(axis=1) / counts
    clear &= _common(mean_colours, clear)
    outside = distance >= 1.0 + 1.6 * strip.radius
    # Beyond the held ends are the grippers, which may have the cable's colour.
    margin = max(len(path) // 25, 1)
    outside[:margin] = outside[-margin:] = False
    return strip.colours[inside & clear[:, None]], strip.colours[outside]


def _common(colours: Colours, considered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the colours (k, 3) are of no rare kind among those ``considered`` (k,): the edge
    of an occluder that the path strayed to is no stripe of the cable."""
    coarse = tuple((np.clip(colours, 0.0, 255.0).astype(np.int64) >> 5).T)
    count = np.zeros((8, 8, 8))
    np.add.at(count, coarse, considered.astype(np.float64))
    blurred = gaussian_filter(count, 0.7, mode="constant")
    alone = gaussian_filter(np.pad(np.ones((1, 1, 1)), 4), 0.7).max()
    return blurred[coarse] > RAREST * alone * considered.sum()


def _quantise(colours: NDArray[Any]) -> NDArray[np.int64]:
    return np.clip(colours, 0.0, 255.0).astype(np.int64) >> (8 - BITS)


def _density(colours: Colours, brightness_range: float, rng: np.random.Generator) -> Array:
    """Smoothed histogram (levels, levels, levels), sum 1, of colours under varied brightness."""
    repeats = max(1, 40_000 // len(colours))
    gains = np.exp(brightness_range * rng.standard_normal((repeats, len(colours), 1)))
    varied = _quantise(gains * colours).reshape(-1, 3)
    flat = (varied[:, 0] * LEVELS + varied[:, 1]) * LEVELS + varied[:, 2]
    histogram = np.bincount(flat, minlength=LEVELS**3).reshape(LEVELS, LEVELS, LEVELS)
    smooth = gaussian_filter(histogram.astype(np.float64), 0.8, mode="nearest")
    return smooth / smooth.sum()


def _share(table: Array, colours: Colours) -> float:
    return float((table[tuple(_quantise(colours).T)] >= 0.5).mean())


@numba.njit(cache=True)
def _apply(image, table, occupancy):  # pragma: no cover
    """Looks up each pixel (h, w, 3) in the table (levels, levels, levels)."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    shift = 8 - BITS
    for row in range(height):
        for column in range(width):
            if occupancy[row, column] != 0:
                mask[row, column] = table[
                    image[row, column, 0] >> shift,
                    image[row, column, 1] >> shift,
                    image[row, column, 2] >> shift,
                ]
    return mask
