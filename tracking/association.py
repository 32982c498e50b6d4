"""Which point of the seen centerline belongs to each predicted node (Section V-A3).

The paper projects each node on its nearest edge and reads visibility from the mask at the
projected point. Clamped to the edge, as it must be, that point always lies on the mask, so every
hidden node would count as seen. Here visibility comes from the node's own place: its distance
across the cable must be within the gate, and where its projection falls on the end of a visible
piece it must not overshoot that end.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array
from tracking.graph import CenterlineGraph

SMALLEST_COSINE = 0.5


class Association(NamedTuple):
    """Where each of n predicted nodes lies on the graph of one view.

    Attributes:
        points: (n, 2) projection on the nearest suitable edge, clamped to it [pixels].
        directions: (n, 2) unit direction of the seen centerline there, along the prediction.
        offsets: (n, 2) ``points`` minus the predicted pixels [pixels].
        visible: (n,) whether the node is seen.
    """

    points: Array
    directions: Array
    offsets: Array
    visible: NDArray[np.bool_]


def associate(
    predicted: Array,
    graph: CenterlineGraph,
    gate: Array,
    overshoot: Array,
    smallest_cosine: float = SMALLEST_COSINE,
) -> Association:
    """Projects predicted pixels (n, 2) on the nearest edges of the graph.

    Args:
        predicted: (n, 2) pixels; NaN for nodes behind the camera.
        graph: of the same image.
        gate: (n,) largest distance at which a node is still taken as seen [pixels].
        overshoot: (n,) how far beyond the end of a visible piece a node may lie [pixels].
        smallest_cosine: between the predicted tangent and an edge that may be associated.

    Returns:
        Nothing is visible if the graph is empty; the points are then the predicted ones.
    """
    tangents = image_tangents(predicted)
    n = len(predicted)
    if not len(graph.edges):
        return Association(predicted.copy(), tangents, np.zeros((n, 2)), np.zeros(n, dtype=bool))
    points, directions, beyond, found = _project(
        predicted,
        tangents,
        graph.nodes,
        graph.directions,
        graph.edges,
        graph.degrees,
        smallest_cosine,
    )
    offsets = np.where(found[:, None], points - predicted, 0.0)
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(offsets, axis=1) <= gate
    visible = found & near & (beyond <= overshoot)
    return Association(points, directions, offsets, visible)


def correct_occluded(
    association: Association, arc_length: Array, fixed_ends: tuple[bool, bool] = (True, True)
) -> Array:
    """Offsets (n, 2) [pixels] with those of hidden nodes interpolated between seen ones.

    The paper interpolates the distance; here it is the offset vector, so a change of sign across
    a gap survives. An end held by a gripper has offset zero; beyond the last seen node before a
    free end the offset stays constant.

    Args:
        association: of one view.
        arc_length: (n,) of the nodes [any unit].
        fixed_ends: whether the first and the last node are held.
    """
    known = association.visible.copy()
    offsets = np.where(known[:, None], association.offsets, 0.0)
    for end, held in zip((0, -1), fixed_ends, strict=True):
        known[end] |= held
    if not known.any():
        return np.zeros_like(offsets)
    return np.column_stack(
        [np.interp(arc_length, arc_length[known], offsets[known, axis]) for axis in range(2)]
    )


def image_tangents(pixels: Array) -> Array:
    """Unit tangents (n, 2) of a projected centerline (n, 2); zero where it is seen end on."""
    tangents = np.empty_like(pixels)
    tangents[1:-1] = 0.5 * (pixels[2:] - pixels[:-2])
    tangents[0], tangents[-1] = pixels[1] - pixels[0], pixels[-1] - pixels[-2]
    norms = np.hypot(tangents[:, 0], tangents[:, 1])
    with np.errstate(invalid="ignore"):
        return np.where(norms[:, None] > 1e-9, tangents / np.maximum(norms, 1e-9)[:, None], 0.0)


@numba.njit(cache=True)
def _project(  # pragma: no cover
    predicted, tangents, nodes, directions, edges, degrees, smallest_cosine
):
    """Nearest clamped projection of each pixel, the direction there, and how far it overshoots."""
    n = len(predicted)
    points = predicted.copy()
    along = tangents.copy()
    beyond = np.zeros(n)
    found = np.zeros(n, np.bool_)
    for i in range(n):
        px, py = predicted[i, 0], predicted[i, 1]
        if not (np.isfinite(px) and np.isfinite(py)):
            continue
        tx, ty = tangents[i, 0], tangents[i, 1]
        # Seen end on, a tangent has no direction in the image and any edge may be the node's.
        directed = tx * tx + ty * ty > 0.5
        nearest = np.inf
        for e in range(len(edges)):
            a, b = edges[e, 0], edges[e, 1]
            ex, ey = nodes[b, 0] - nodes[a, 0], nodes[b, 1] - nodes[a, 1]
            squared = ex * ex + ey * ey
            if squared < 1e-18:
                continue
            cosine = (ex * tx + ey * ty) / np.sqrt(squared)
            if directed and abs(cosine) < smallest_cosine:
                continue
            dx, dy = px - nodes[a, 0], py - nodes[a, 1]
            fraction = (dx * ex + dy * ey) / squared
            clamped = min(max(fraction, 0.0), 1.0)
            rx, ry = dx - clamped * ex, dy - clamped * ey
            distance = rx * rx + ry * ry
            if distance >= nearest:
                continue
            nearest = distance
            found[i] = True
            points[i, 0], points[i, 1] = px - rx, py - ry
            end = a if fraction < 0.0 else b
            over = max(-fraction, fraction - 1.0, 0.0) * np.sqrt(squared)
            beyond[i] = over if degrees[end] == 1 else 0.0
            # The direction turns evenly along the edge, as the cable does.
            ux, uy = directions[a, 0], directions[a, 1]
            vx, vy = directions[b, 0], directions[b, 1]
            if ux * vx + uy * vy < 0.0:
                vx, vy = -vx, -vy
            ux += clamped * (vx - ux)
            uy += clamped * (vy - uy)
            norm = np.sqrt(ux * ux + uy * uy)
            if ux * tx + uy * ty < 0.0:
                norm = -norm
            along[i, 0], along[i, 1] = ux / norm, uy / norm
    return points, along, beyond, found
