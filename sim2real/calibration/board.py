"""The ChArUco board: drawn true to scale for printing, and found in images."""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError
from dlo_gym.geometry.se3 import Array

DICTIONARIES = ("4X4_50", "4X4_100", "4X4_250", "5X5_100", "5X5_250", "6X6_250", "APRILTAG_36h11")
_METRES_PER_INCH = 0.0254
_SMALLEST_VIEW = 6  # corners; fewer leave a board's pose to chance


@dataclass(frozen=True)
class BoardSpec:
    """A ChArUco board: a chessboard with a marker in each white square.

    The board's frame has its origin at the top left corner of the printed pattern, x to the
    right, y down and z into the board. The default fits on A4 with a margin to hold it by.

    Attributes:
        squares_x, squares_y: squares along each side.
        square_length_m, marker_length_m: sides of a square and of a marker, as measured on the
            print [m].
        dictionary: of the markers, one of ``DICTIONARIES``.

    Raises:
        ValueError: naming the field.
    """

    squares_x: int = 8
    squares_y: int = 6
    square_length_m: float = 0.030
    marker_length_m: float = 0.022
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        for name in ("squares_x", "squares_y"):
            if not 3 <= getattr(self, name) <= 40:
                raise ValueError(f"{name}: expected 3 to 40, got {getattr(self, name)}")
        if not 0.001 <= self.square_length_m <= 1.0:
            raise ValueError(
                f"square_length_m: expected 0.001 to 1 m, got {self.square_length_m}; 30 mm is 0.03"
            )
        if not 0.3 * self.square_length_m <= self.marker_length_m < self.square_length_m:
            raise ValueError(
                "marker_length_m: expected 0.3 to 1 times square_length_m"
                f" {self.square_length_m}, got {self.marker_length_m}"
            )
        if self.dictionary not in DICTIONARIES:
            raise ValueError(
                f"dictionary: expected one of {', '.join(DICTIONARIES)}, got {self.dictionary!r}"
            )
        needed = self.squares_x * self.squares_y // 2
        available = len(self._dictionary.bytesList)
        if needed > available:
            raise ValueError(
                f"dictionary: {self.squares_x}x{self.squares_y} squares need {needed} markers,"
                f" {self.dictionary} has {available}"
            )

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the pattern [m]."""
        return self.squares_x * self.square_length_m, self.squares_y * self.square_length_m

    @property
    def n_corners(self) -> int:
        return (self.squares_x - 1) * (self.squares_y - 1)

    @cached_property
    def corners(self) -> Array:
        """(n_corners, 3) the inner corners in the board's frame [m], by id."""
        return np.array(self._board.getChessboardCorners(), dtype=np.float64)

    @property
    def centre(self) -> Array:
        """(3,) middle of the pattern in the board's frame [m]."""
        return np.array([*self.size_m, 0.0]) / 2

    @cached_property
    def _dictionary(self) -> cv2.aruco.Dictionary:
        name = f"DICT_{self.dictionary}"
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        size = (self.squares_x, self.squares_y)
        return cv2.aruco.CharucoBoard(
            size, self.square_length_m, self.marker_length_m, self._dictionary
        )

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMax = 43  # small markers of a board across the cell
        return cv2.aruco.CharucoDetector(self._board, cv2.aruco.CharucoParameters(), parameters)

    def __getstate__(self) -> dict:
        return asdict(self)  # OpenCV's objects cannot be pickled; they are made again

    def image(self, pixels_per_square: int) -> NDArray[np.uint8]:
        """The pattern (h, w) in grey, without margin."""
        size = (self.squares_x * pixels_per_square, self.squares_y * pixels_per_square)
        return np.asarray(self._board.generateImage(size), dtype=np.uint8)

    def detect(self, image: NDArray[np.uint8]) -> "Detection":
        """The corners of the board in an image, empty where there is no board.

        Args:
            image: (h, w, 3) RGB or (h, w) grey, uint8.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < _SMALLEST_VIEW:
            return Detection.nothing()
        ids = np.ravel(ids).astype(np.int64)
        corners = np.reshape(corners, (-1, 2)).astype(np.float64)
        half_window = _refinement_window(self, ids, corners)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        refined = cv2.cornerSubPix(
            grey,
            np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2),
            (half_window, half_window),
            (-1, -1),
            criteria,
        ).reshape(-1, 2)
        # A corner that the refinement carries off had no clear cross beneath it.
        kept = np.linalg.norm(refined - corners, axis=1) <= half_window
        detection = Detection(ids[kept], refined[kept].astype(np.float64))
        return detection if detection.spans_a_plane(self) else Detection.nothing()


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners of a board seen in one image.

    Attributes:
        ids: (n,) of the corners, ascending; rows of ``BoardSpec.corners``.
        corners: (n, 2) where they are in the image [pixels].
    """

    ids: NDArray[np.int64]
    corners: Array

    @classmethod
    def nothing(cls) -> "Detection":
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.ids)

    def spans_a_plane(self, board: BoardSpec) -> bool:
        """Whether the corners are enough, and not on one line, to tell the board's pose."""
        if len(self) < _SMALLEST_VIEW:
            return False
        points = board.corners[self.ids, :2]
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        return bool(spread[1] > 0.5 * board.square_length_m)


def _refinement_window(board: BoardSpec, ids: NDArray[np.int64], corners: Array) -> int:
    """Half the window [pixels] in which a corner's cross is all there is.

    It ends before the marker, which stands (square - marker) / 2 off, in the narrowest square.
    """
    row = board.squares_x - 1
    where = {int(i): corner for i, corner in zip(ids, corners, strict=True)}
    sides = [
        np.linalg.norm(corner - where[i + step])
        for i, corner in where.items()
        for step in (1, row)
        if i + step in where and (step == row or (i + 1) % row)
    ]
    gap = (1.0 - board.marker_length_m / board.square_length_m) / 2
    shortest = float(np.min(sides)) if sides else 16.0
    return int(np.clip(round(shortest * (gap + 0.12)), 2, 12))


def board(
    *,
    out: Path = Path("board.pdf"),
    squares_x: int = 8,
    squares_y: int = 6,
    square_length_m: float = 0.030,
    marker_length_m: float = 0.022,
    dictionary: str = "4X4_50",
) -> None:
    """Draw a ChArUco calibration board true to scale, to print at 100 % (no "fit to page").

    Args:
        out: file to write, .pdf or .png (with its resolution in it); an existing one is kept.
        squares_x: squares across.
        squares_y: squares down.
        square_length_m: side of a square [m].
        marker_length_m: side of a marker [m].
        dictionary: of the markers.
    """
    spec = BoardSpec(squares_x, squares_y, square_length_m, marker_length_m, dictionary)
    if out.exists():
        raise FileExistsError(f"{out} exists; name another file")
    save_board(spec, out)
    width, height = (1e3 * side for side in spec.size_m)
    Console().print(
        f"{out}: {width:.1f} x {height:.1f} mm; print at 100 %, glue it onto a stiff flat plate and"
        f" measure it: {squares_x} squares must be {width:.1f} mm long",
        highlight=False,
        soft_wrap=True,
    )


def save_board(spec: BoardSpec, path: Path) -> None:
    """Writes the board as .pdf or .png true to scale, with a half-square white margin.

    Raises:
        ValueError: on another kind of file.
    """
    margin = spec.square_length_m / 2
    width, height = (side + 2 * margin for side in spec.size_m)
    if path.suffix.lower() not in (".pdf", ".png"):
        raise ValueError(f"out: expected a file .pdf or .png, got {path}")
    with written_aside(path, DloError) as part:
        if path.suffix.lower() == ".png":
            pixels_per_square = max(40, 2 * round(spec.square_length_m / _METRES_PER_INCH * 150))
            picture = np.pad(
                spec.image(pixels_per_square), pixels_per_square // 2, constant_values=255
            )
            dpi = pixels_per_square / spec.square_length_m * _METRES_PER_INCH
            Image.fromarray(picture).save(part, "PNG", dpi=(dpi, dpi))
            return
        # Takes long to import, and who only looks for a board draws none.
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width / _METRES_PER_INCH, height / _METRES_PER_INCH))
        axes = figure.add_axes(
            (margin / width, margin / height, 1 - 2 * margin / width, 1 - 2 * margin / height)
        )
        axes.imshow(
            spec.image(240), cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto"
        )
        axes.set_axis_off()
        figure.text(
            margin / width,
            0.25 * margin / height,
            f"{spec.squares_x} x {spec.squares_y} squares of {1e3 * spec.square_length_m:g} mm,"
            f" markers {1e3 * spec.marker_length_m:g} mm {spec.dictionary}",
            fontsize=6,
        )
        figure.savefig(part, format="pdf", dpi=600)
