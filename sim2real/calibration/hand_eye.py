"""One camera and one arm: where the camera stands in the arm's base, eye to hand.

The closed forms start it (`sim2real.calibration.closed_form`), on poses that agree with each other;
`sim2real.calibration.adjustment` then refines all cameras and arms together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, exp_so3, inverse, log_so3, pose, transform_points
from sim2real.calibration.board import BoardSpec, Detection
from sim2real.calibration.closed_form import METHODS, eye_to_hand

FEWEST_POSES = 5
_SUBSET = 4
_SUBSETS = 60
_ZERO = np.zeros(3)
_COARSE_LIMIT_PX = 4.0  # what a start from few poses may be off
LEAST_ROTATION_DEG = 10.0


class Degenerate(ValueError):
    """Poses that cannot determine the calibration; says which to add."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Where a camera stands in an arm's base, by every closed form.

    Attributes:
        T_base_camera: (4, 4) of the method with the smallest residual.
        T_tcp_board: (4, 4) where the board sits in the gripper.
        inliers: (k,) poses that agree with each other.
        residuals_px: (k,) root mean square over each pose's corners; NaN where not seen.
        method: that was taken.
        by_method: T_base_camera of every method that had a solution.
    """

    T_base_camera: Array
    T_tcp_board: Array
    inliers: NDArray[np.bool_]
    residuals_px: Array
    method: str
    by_method: dict[str, Array]


def board_pose(camera: CameraModel, board: BoardSpec, detection: Detection) -> Array:
    """``T_camera_board`` (4, 4) of one view, by the smallest reprojection error.

    Raises:
        ValueError: if the corners are too few or on one line.
    """
    if not detection.spans_a_plane(board):
        raise ValueError(f"detection: {len(detection)} corners do not span a plane")
    points = board.corners[detection.ids]
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        points, detection.corners, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    best = int(np.argmin(np.ravel(errors)))
    rotation, translation = cv2.solvePnPRefineLM(
        points,
        detection.corners,
        camera.K,
        camera.distortion,
        rotations[best].copy(),
        translations[best].copy(),
    )
    return pose(exp_so3(np.ravel(rotation)), np.ravel(translation))


def solve_eye_to_hand(
    camera: CameraModel,
    board: BoardSpec,
    T_base_tcp: Array,
    detections: Sequence[Detection],
    rng: np.random.Generator,
) -> HandEye:
    """A camera's pose in an arm's base from poses of which some may be wrong.

    Random subsets of four poses vote (least median of squares); all methods then solve on the
    poses that agree.

    Args:
        camera: its intrinsics; ``T_world_camera`` is not used.
        board: that the arm carried.
        T_base_tcp: (k, 4, 4) reported tool poses.
        detections: (k) what the camera saw at each; empty where nothing.
        rng: draws the subsets.

    Raises:
        Degenerate: if the poses are too few, or turn about fewer than two axes.
    """
    seen = np.array([detection.spans_a_plane(board) for detection in detections], dtype=bool)
    index = np.flatnonzero(seen)
    if len(index) < FEWEST_POSES:
        raise Degenerate(
            f"camera {camera.name!r} saw the board in {len(index)} poses; at least"
            f" {FEWEST_POSES} are needed, 15 or more are good"
        )
    check_rotations(T_base_tcp[index])
    shown = [detection for detection, there in zip(detections, seen, strict=True) if there]
    T_camera_board = np.stack([board_pose(camera, board, detection) for detection in shown])
    views = _Views(camera, board, T_base_tcp[index], T_camera_board, shown)
    best, smallest = None, np.inf
    for _ in range(_SUBSETS):
        subset = rng.choice(len(index), size=_SUBSET, replace=False)
        if _rotation_spread(T_base_tcp[index[subset]])[0][1] < np.radians(LEAST_ROTATION_DEG) / 2:
            continue
        try:
            residuals = views.residuals(views.solve("PARK", subset), subset)
        except ValueError:
            continue
        # The median over a little more than half: as many poses may be wrong as right.
        score = float(np.quantile(residuals, 0.6))
        if score < smallest:
            best, smallest = residuals, score
    if best is None:
        raise Degenerate("no subset of the poses turns about two axes; add poses turned otherwise")
    agree = best <= max(3.0 * smallest, _COARSE_LIMIT_PX)
    return _by_all_methods(views, seen, agree)


def _by_all_methods(views: "_Views", seen: NDArray[np.bool_], agree: NDArray[np.bool_]) -> HandEye:
    by_method: dict[str, Array] = {}
    residuals: dict[str, Array] = {}
    method = ""
    for _ in range(2):  # the second time on what the better start lets in
        chosen = np.flatnonzero(agree)
        if len(chosen) < FEWEST_POSES:
            raise Degenerate(
                f"only {len(chosen)} of {len(agree)} poses agree with each other: check that the"
                " board is fixed in the gripper, its measures, and the arm's tool centre point"
            )
        check_rotations(views.T_base_tcp[chosen])
        for method in METHODS:
            try:
                by_method[method] = views.solve(method, chosen)
            except ValueError:
                continue
            residuals[method] = views.residuals(by_method[method], chosen)
        if not residuals:
            raise Degenerate("no method has a solution on these poses")
        method = min(residuals, key=lambda name: float(np.median(residuals[name][agree])))
        limit = 3.0 * float(np.median(residuals[method][agree]))
        agree = residuals[method] <= max(limit, _COARSE_LIMIT_PX / 2)
    index = np.flatnonzero(seen)
    inliers, all_residuals = np.zeros(len(seen), dtype=bool), np.full(len(seen), np.nan)
    inliers[index[agree]] = True
    all_residuals[index] = residuals[method]
    T_base_camera = by_method[method]
    return HandEye(
        T_base_camera,
        views.board_in_gripper(T_base_camera, np.flatnonzero(agree)),
        inliers,
        all_residuals,
        method,
        by_method,
    )


@dataclass(frozen=True, eq=False)
class _Views:
    """All views of one camera with one arm: (k) each."""

    camera: CameraModel
    board: BoardSpec
    T_base_tcp: Array
    T_camera_board: Array
    detections: list[Detection]

    def solve(self, method: str, chosen: NDArray[np.intp]) -> Array:
        return eye_to_hand(self.T_base_tcp[chosen], self.T_camera_board[chosen], method)

    def board_in_gripper(self, T_base_camera: Array, chosen: NDArray[np.intp]) -> Array:
        """T_tcp_board, mean over the chosen poses."""
        each = inverse(self.T_base_tcp[chosen]) @ T_base_camera @ self.T_camera_board[chosen]
        rotation = Rotation.from_matrix(each[:, :3, :3]).mean().as_matrix()
        # The board's middle is better known than its corner, the frame's origin.
        centre = np.append(self.board.centre, 1.0)
        middle = np.median((each @ centre)[:, :3], axis=0)
        return pose(rotation, middle - rotation @ self.board.centre)

    def residuals(self, T_base_camera: Array, chosen: NDArray[np.intp]) -> Array:
        """(k,) root mean square [pixels] of every view, the board placed by the chosen ones."""
        T_tcp_board = self.board_in_gripper(T_base_camera, chosen)
        T_camera_board = inverse(T_base_camera) @ self.T_base_tcp @ T_tcp_board
        # All views at once: this runs for every subset that votes.
        points = np.concatenate(
            [
                transform_points(T, self.board.corners[detection.ids])
                for T, detection in zip(T_camera_board, self.detections, strict=True)
            ]
        )
        seen = np.concatenate([detection.corners for detection in self.detections])
        squares = np.square(_project(self.camera, points) - seen).sum(axis=1)
        starts = np.cumsum([0, *(len(detection) for detection in self.detections[:-1])])
        lengths = [len(detection) for detection in self.detections]
        return np.sqrt(np.add.reduceat(squares, starts) / lengths)


def rms_px(
    camera: CameraModel, board: BoardSpec, T_camera_board: Array, detection: Detection
) -> float:
    """Root mean square distance [pixels] of seen corners from where a pose puts them."""
    off = project_board(camera, board, T_camera_board, detection) - detection.corners
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def project_board(
    camera: CameraModel, board: BoardSpec, T_camera_board: Array, detection: Detection
) -> Array:
    """Where a pose puts the corners that were seen (n, 2) [pixels]."""
    return _project(camera, transform_points(T_camera_board, board.corners[detection.ids]))


def _project(camera: CameraModel, in_camera: Array) -> Array:
    projected = cv2.projectPoints(in_camera, _ZERO, _ZERO, camera.K, camera.distortion)[0]
    return np.asarray(projected, dtype=np.float64).reshape(-1, 2)


def _rotation_spread(T_base_tcp: Array) -> tuple[Array, Array]:
    """How far poses (k, 4, 4) are turned against each other: (3,) root mean square angles [rad],
    largest first, and (3, 3) the axes in the base, as columns."""
    i, j = np.triu_indices(len(T_base_tcp), 1)
    rotations = T_base_tcp[:, :3, :3]
    vectors = log_so3(rotations[j] @ np.swapaxes(rotations[i], 1, 2))
    values, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes[:, ::-1]


def check_rotations(T_base_tcp: Array) -> None:
    """Refuses poses whose rotations are too small or about one axis only.

    Raises:
        Degenerate: naming the axis about which poses (k, 4, 4) must be turned further.
    """
    spread, axes = _rotation_spread(T_base_tcp)
    if spread[1] < np.radians(LEAST_ROTATION_DEG):
        axis = np.round(axes[:, 1], 2) + 0.0
        raise Degenerate(
            "the poses hardly turn about a second axis"
            f" ({np.degrees(spread[0]):.0f} and {np.degrees(spread[1]):.0f} degrees about the first"
            f" and second, at least {LEAST_ROTATION_DEG:.0f} needed): add poses turned by 25 to 35"
            f" degrees about {axis.tolist()} in the arm's base"
        )
