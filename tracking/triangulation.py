"""Points from rays of several views (Section V-B), and curves from planes of several views.

``triangulate`` is the paper's: each node is the point nearest to its rays, Eq. (1) and (2). It
needs the same node's pixel in every view. Across the cable a pixel is certain; along it, it is
wherever the prediction put it, and slides differently in each view, which bends the depth.

``fit_curve`` therefore measures only across: a seen node lies in the plane through the camera and
the seen centerline's tangent, a rank-one version of Eq. (1). Where along the cable each node lies
follows from its length, and what no view sees from the prediction, corrected smoothly: the same
translation of hidden nodes by interpolation that the paper makes in each image, made once in 3-D.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, eigh, get_lapack_funcs

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array

# Standard deviations [m] of the fit's terms.
SIGHT_NOISE = 3e-4  # of a seen centerline, across
BEND_NOISE = 1.2e-4  # second difference of the correction, per squared 10 mm of element length
LENGTH_NOISE = 3e-5  # of an element's length, beside the others'
STRETCH = 0.01  # standard deviation of the whole curve's stretch [-]

_POSV, _POTRF, _POTRI = get_lapack_funcs(("posv", "potrf", "potri"), dtype=np.float64)


def ray_projectors(directions: Array) -> Array:
    """V = I - v v^T (..., 3, 3) of unit rays (..., 3), Eq. (1)."""
    return np.eye(3) - directions[..., :, None] * directions[..., None, :]


def triangulate(projectors: Array, centres: Array, weights: Array | None = None) -> Array:
    """The points (n, 3) [m] nearest to the rays of m views, Eq. (2), all at once.

    Args:
        projectors: (m, n, 3, 3) of each view and point, Eq. (1).
        centres: (m, 3) optical centres [m].
        weights: (m, n) of each ray; equal if omitted. A zero weight takes the ray out.

    Returns:
        NaN for points that fewer than two rays, or only parallel ones, determine.
    """
    projectors = np.asarray(projectors, dtype=np.float64)
    if weights is not None:
        projectors = projectors * np.asarray(weights, dtype=np.float64)[..., None, None]
    matrix = projectors.sum(axis=0)
    right = np.einsum("mnij,mj->ni", projectors, centres)
    eigenvalues = np.linalg.eigvalsh(matrix)
    determined = eigenvalues[:, 0] > 1e-6 * np.maximum(eigenvalues[:, 2], 1e-300)
    matrix[~determined] = np.eye(3)
    points = np.linalg.solve(matrix, right[..., None])[..., 0]
    points[~determined] = np.nan
    return points


class Sight(NamedTuple):
    """What one view says about n nodes: each lies in a plane.

    Attributes:
        normals: (n, 3) unit normals of the planes through the camera and the seen centerline.
        centre: (3,) optical centre [m].
        weights: (n,) inverse variance over that of a clearly seen node; 0 where not seen.
    """

    normals: Array
    centre: Array
    weights: Array

    def residuals(self, points: Array) -> Array:
        """Signed distances (n,) [m] of points (n, 3) to their planes."""
        return ((points - self.centre) * self.normals).sum(axis=1)


def sight_across(camera: CameraModel, pixels: Array, directions: Array, weights: Array) -> Sight:
    """The planes of pixels (n, 2) on a centerline with unit directions (n, 2) in the image."""
    seen = weights > 0
    normals = np.zeros((len(pixels), 3))
    if seen.any():
        rays = camera.rays(
            np.stack([pixels[seen] - directions[seen], pixels[seen] + directions[seen]])
        )
        (ax, ay, az), (bx, by, bz) = rays[0].T, rays[1].T
        # What np.cross does, in a quarter of its time.
        across = np.column_stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
        normals[seen] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return Sight(normals, camera.centre, np.where(seen, weights, 0.0))


def fit_curve(
    predicted: Array,
    start: Array,
    sights: Sequence[Sight],
    element_length: float,
    uncertainty: Array,
    fixed: NDArray[np.bool_],
    *,
    sight_noise: float = SIGHT_NOISE,
    iterations: int = 1,
) -> "CurveFit":
    """The curve of given element length that agrees with what was seen and bends the prediction
    least; a Gaussian posterior mode, by Gauss-Newton.

    Args:
        predicted: (n, 3) [m].
        start: (n, 3) where to linearise first [m].
        sights: one per view that saw something.
        element_length: [m].
        uncertainty: (n,) standard deviation of the prediction [m].
        fixed: (n,) bool, nodes whose position is known: they stay where ``predicted`` has them.
        sight_noise: standard deviation of a sight of weight 1 [m].
    """
    n = len(predicted)
    free = np.flatnonzero(~np.asarray(fixed, dtype=bool))
    curve = np.where(np.asarray(fixed)[:, None], predicted, start)
    unknown = (3 * free[:, None] + np.arange(3)).ravel()
    smooth = _bending(n, element_length) + np.diag(uncertainty**-2.0)
    nodes = np.arange(n)
    matrix = np.empty((n, 3, n, 3))
    for _ in range(iterations):
        matrix[:] = 0.0
        for axis in range(3):
            matrix[:, axis, :, axis] = smooth
        gradient = smooth @ (curve - predicted)
        for sight in sights:
            across = (sight.weights / sight_noise**2)[:, None] * sight.normals
            matrix[nodes, :, nodes, :] += across[:, :, None] * sight.normals[:, None, :]
            gradient += across * sight.residuals(curve)[:, None]
        _add_lengths(matrix, gradient, curve, element_length)
        if not len(free):
            break
        reduced = matrix.reshape(3 * n, 3 * n)[np.ix_(unknown, unknown)]
        _, step, info = _POSV(reduced, gradient.ravel()[unknown], lower=True)
        _check_definite(info)
        curve = curve.copy()
        curve[free] -= step.reshape(-1, 3)
    return CurveFit(curve, matrix.reshape(3 * n, 3 * n), free)


class CurveFit(NamedTuple):
    """A fitted curve.

    Attributes:
        centerline: (n, 3) [m].
        information: (3n, 3n) inverse covariance before the last step [1/m^2].
        free: the nodes that could move.
    """

    centerline: Array
    information: Array
    free: NDArray[np.int64]

    def deviation(self) -> Array:
        """Standard deviation (n,) [m] of each node's place; 0 where it is fixed."""
        unknown = (3 * self.free[:, None] + np.arange(3)).ravel()
        deviation = np.zeros(len(self.centerline))
        if len(unknown):
            factor, info = _POTRF(self.information[np.ix_(unknown, unknown)], lower=True)
            _check_definite(info)
            covariance, _ = _POTRI(factor, lower=True)
            deviation[self.free] = np.sqrt(np.diag(covariance).reshape(-1, 3).sum(axis=1))
        return deviation


def _check_definite(info: int) -> None:
    """Raises LinAlgError on LAPACK's word that a matrix is not positive definite."""
    if info != 0:
        raise LinAlgError("the fit's information matrix is not positive definite")


def bending_modes(
    curve: Array, element_length: float, fixed: NDArray[np.bool_], count: int, curvature: float
) -> Array:
    """Displacements (count, n, 3) [m] in which a curve of given element length bends most easily.

    Each changes the curvature by a root mean square of ``curvature`` [1/m]. To first order they
    keep the length.

    Args:
        curve: (n, 3) [m].
        element_length: [m].
        fixed: (n,) bool, nodes that stay.
    """
    n = len(curve)
    free = np.flatnonzero(~np.asarray(fixed, dtype=bool))
    unknown = (3 * free[:, None] + np.arange(3)).ravel()
    second = np.diff(np.eye(n), n=2, axis=0) / element_length**2
    matrix = np.zeros((n, 3, n, 3))
    for axis in range(3):
        matrix[:, axis, :, axis] = second.T @ second / n
    _add_lengths(matrix, np.zeros((n, 3)), curve, element_length)
    reduced = matrix.reshape(3 * n, 3 * n)[np.ix_(unknown, unknown)]
    stiffness, shapes = eigh(reduced, subset_by_index=(0, min(count, len(unknown)) - 1))
    modes = np.zeros((len(stiffness), n, 3))
    modes[:, free] = (curvature / np.sqrt(stiffness) * shapes).T.reshape(-1, len(free), 3)
    return modes


def _bending(n: int, element_length: float) -> Array:
    """D2^T D2 / variance (n, n) of the second difference D2 of a correction."""
    second = np.diff(np.eye(n), n=2, axis=0)
    noise = BEND_NOISE * (element_length / 0.01) ** 2
    return second.T @ second / noise**2


def _add_lengths(matrix: Array, gradient: Array, curve: Array, element_length: float) -> None:
    """Adds the elements' length terms to matrix (n, 3, n, 3) and gradient (n, 3).

    Their errors are independent but for a common stretch, which a soft rod's weight and a length
    measured along another path give it.
    """
    edges = np.diff(curve, axis=0)
    lengths = np.linalg.norm(edges, axis=1)
    tangents = edges / np.maximum(lengths, 1e-9)[:, None]
    variance, common = LENGTH_NOISE**2, (STRETCH * element_length) ** 2
    share = common / (variance + len(edges) * common)
    excess = lengths - element_length
    pull = ((excess - share * excess.sum()) / variance)[:, None] * tangents
    gradient[1:] += pull
    gradient[:-1] -= pull
    block = tangents[:, :, None] * tangents[:, None, :] / variance
    first, second = np.arange(len(edges)), np.arange(1, len(edges) + 1)
    matrix[first, :, first, :] += block
    matrix[second, :, second, :] += block
    matrix[first, :, second, :] -= block
    matrix[second, :, first, :] -= block
    total = np.zeros_like(curve)
    total[1:] += tangents
    total[:-1] -= tangents
    matrix -= (share / variance) * total[:, :, None, None] * total
