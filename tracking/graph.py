"""The cable's centerline as a graph in one image (Caporali et al. 2025, Section V-A2).

Distance transform, local maxima by 3x3 dilation, farthest-point sampling, edges by a distance and
a direction score.
"""

from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dlo_gym.geometry.se3 import Array

# A maximum's distance to the border, over the cable's radius in pixels: thinner is noise or a
# half-hidden cable, thicker is a gripper, a box or a shadow of the cable's colour.
NARROWEST, WIDEST = 0.6, 1.7
# Half a pixel lies between a border pixel's centre and the border.
PIXEL = 0.5
SHORTEST = 3  # nodes of a piece that counts
REACH = 2.6  # of the sampling distance, the longest edge
SMALLEST_COSINE = 0.7  # between an edge and the centerline's direction at either of its nodes


class CenterlineGraph(NamedTuple):
    """Nodes on the centerlines seen in one image, and the edges between them.

    Attributes:
        nodes: (m, 2) pixels.
        directions: (m, 2) unit direction of the centerline at each node, of either sign.
        edges: (e, 2) int, pairs of nodes.
        degrees: (m,) int, edges at each node; 1 at the end of a visible piece.
    """

    nodes: Array
    directions: Array
    edges: NDArray[np.int64]
    degrees: NDArray[np.int64]


EMPTY = CenterlineGraph(
    np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
)


def build_graph(
    mask: NDArray[np.uint8],
    occupancy: NDArray[np.uint8],
    radius: tuple[float, float],
    origin: tuple[int, int] = (0, 0),
) -> CenterlineGraph:
    """The graph of a segmentation mask inside an occupancy mask.

    Args:
        mask: (h, w) non-zero on cables.
        occupancy: (h, w) non-zero where the tracked cable may be.
        radius: smallest and largest radius of the tracked cable in this image [pixels].
        origin: (column, row) of the masks' first pixel in the full image.

    Returns:
        Nodes in the full image's pixels; ``EMPTY`` if nothing is seen.
    """
    maxima = local_maxima(mask, radius, occupancy)
    if len(maxima) < 2:
        return EMPTY
    spacing = max(2.0 * radius[0], 3.0)
    samples = _farthest_points(maxima, spacing)
    nodes, directions, elongated = _centre(maxima, samples, 1.5 * spacing)
    nodes, directions = nodes[elongated], directions[elongated]
    edges = _connect(nodes, directions, REACH * spacing, spacing)
    if not len(edges):
        return EMPTY
    edges = edges[_in_long_pieces(edges, len(nodes))]
    if not len(edges):
        return EMPTY
    degrees = np.bincount(edges.ravel(), minlength=len(nodes))
    return CenterlineGraph(nodes + np.asarray(origin, dtype=np.float64), directions, edges, degrees)


def local_maxima(
    mask: NDArray[np.uint8], radius: tuple[float, float], occupancy: NDArray[np.uint8]
) -> Array:
    """Pixels (k, 2) where the mask's distance transform is maximal and as wide as the cable."""
    if not mask.any():
        return np.zeros((0, 2))
    distance = cv2.distanceTransform((mask > 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    dilated = cv2.dilate(distance, np.ones((3, 3), np.uint8))
    # A thin cable's border pixels may be lost to the background that they are mixed with.
    narrowest = max(NARROWEST * radius[0] - 0.4, 0.4)
    widest = WIDEST * radius[1] + 1.0
    found = _maxima(distance, dilated, occupancy, narrowest + PIXEL, widest + PIXEL)
    return found.astype(np.float64)


@numba.njit(cache=True)
def _maxima(distance, dilated, occupancy, narrowest, widest):  # pragma: no cover
    """Pixels (k, 2) where both transforms agree, inside the occupancy and the width limits."""
    count = 0
    found = np.empty((distance.size // 4 + 1, 2), np.int32)
    for row in range(distance.shape[0]):
        for column in range(distance.shape[1]):
            value = distance[row, column]
            if value < narrowest or value > widest or occupancy[row, column] == 0:
                continue
            if value >= dilated[row, column] and count < len(found):
                found[count, 0] = column
                found[count, 1] = row
                count += 1
    return found[:count].copy()


@numba.njit(cache=True)
def _farthest_points(points, spacing):  # pragma: no cover
    """Indices of points (k, 2), each the farthest from those before, until all are covered."""
    k = len(points)
    chosen = np.empty(k, np.int64)
    nearest = np.full(k, np.inf)
    index = 0
    count = 0
    while True:
        chosen[count] = index
        count += 1
        farthest, best = 0, -1.0
        for j in range(k):
            dx = points[j, 0] - points[index, 0]
            dy = points[j, 1] - points[index, 1]
            squared = dx * dx + dy * dy
            if squared < nearest[j]:
                nearest[j] = squared
            if nearest[j] > best:
                best = nearest[j]
                farthest = j
        if best < spacing * spacing or count == k:
            break
        index = farthest
    return chosen[:count].copy()


@numba.njit(cache=True)
def _centre(points, samples, reach):  # pragma: no cover
    """Nodes moved across the centerline to the mean of the maxima around, with its direction.

    The maxima sit on whole pixels; their mean does not. Also tells which neighbourhoods are
    elongated, as a piece of a cable is.
    """
    m = len(samples)
    nodes = np.empty((m, 2))
    directions = np.empty((m, 2))
    elongated = np.zeros(m, np.bool_)
    for i in range(m):
        x, y = points[samples[i], 0], points[samples[i], 1]
        count, sx, sy, sxx, syy, sxy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(len(points)):
            dx, dy = points[j, 0] - x, points[j, 1] - y
            if dx * dx + dy * dy <= reach * reach:
                count += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                syy += dy * dy
                sxy += dx * dy
        mx, my = sx / count, sy / count
        cxx, cyy, cxy = sxx / count - mx * mx, syy / count - my * my, sxy / count - mx * my
        angle = 0.5 * np.arctan2(2.0 * cxy, cxx - cyy)
        ux, uy = np.cos(angle), np.sin(angle)
        along = cxx * ux * ux + 2.0 * cxy * ux * uy + cyy * uy * uy
        across = cxx + cyy - along
        across_shift = -mx * uy + my * ux
        nodes[i, 0] = x - across_shift * uy
        nodes[i, 1] = y + across_shift * ux
        directions[i, 0], directions[i, 1] = ux, uy
        elongated[i] = count >= 3 and along > 4.0 * across
    return nodes, directions, elongated


@numba.njit(cache=True)
def _connect(nodes, directions, reach, spacing):  # pragma: no cover
    """Edges (e, 2): from each node to its best neighbour ahead and behind.

    The score is exp(-(distance / spacing)^2 / 2) times the smaller cosine between the edge and
    the two directions, after the edge sampling of RT-DLO.
    """
    m = len(nodes)
    edges = np.empty((2 * m, 2), np.int64)
    count = 0
    for i in range(m):
        best = np.zeros(2)
        partner = np.full(2, -1)
        for j in range(m):
            dx, dy = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            if j == i or distance > reach or distance < 1e-9:
                continue
            ahead = (dx * directions[i, 0] + dy * directions[i, 1]) / distance
            other = abs(dx * directions[j, 0] + dy * directions[j, 1]) / distance
            cosine = min(abs(ahead), other)
            if cosine < SMALLEST_COSINE:
                continue
            score = np.exp(-0.5 * (distance / spacing) ** 2) * cosine
            side = 0 if ahead > 0.0 else 1
            if score > best[side]:
                best[side] = score
                partner[side] = j
        for side in range(2):
            j = partner[side]
            if j < 0:
                continue
            known = False
            for e in range(count):
                if edges[e, 0] == j and edges[e, 1] == i:
                    known = True
                    break
            if not known:
                edges[count, 0] = i
                edges[count, 1] = j
                count += 1
    return edges[:count].copy()


def _in_long_pieces(edges: NDArray[np.int64], m: int) -> NDArray[np.bool_]:
    """Which edges belong to a connected piece of at least ``SHORTEST`` of the m nodes."""
    links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(m, m))
    _, piece = connected_components(links, directed=False)
    return np.bincount(piece)[piece[edges[:, 0]]] >= SHORTEST
