"""Drawing primitives into an image with a depth buffer, by a ray through each pixel.

A primitive's rays are cast only inside the outline of its bounding box, row by row; within a row
the ray's direction is linear in the column.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene._kernels_rays import _FAST, CAPSULE, CYLINDER, PLANE, meet, normal

NEAREST = 0.02  # what comes closer to a camera has no outline: the whole image is searched [m]


class Pinhole(NamedTuple):
    """``K`` (3, 3) [pixels], ``R_world_camera`` (3, 3) and ``centre`` (3,) [m] of a camera."""

    K: Array
    R_world_camera: Array
    centre: Array


class Lights(NamedTuple):
    """Directional lights, by row.

    Attributes:
        towards: (m, 3) unit vectors to the lights, world.
        halfway: (m, 3) unit vectors between those and the viewer.
        diffuse, specular: (m, 3) RGB intensities.
        ambient: (3,) RGB intensity.
    """

    towards: Array
    halfway: Array
    diffuse: Array
    specular: Array
    ambient: Array


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def draw(image, nearness, pinhole, primitives, lights):
    """Update ``image`` (h, w, 3) and ``nearness`` (h, w) [1/m] where a primitive is nearer."""
    height = len(image)
    left, right = np.empty(height), np.empty(height)
    for i in range(len(primitives.kinds)):
        rotation, size = primitives.rotations[i], primitives.sizes[i]
        # p_body = origin + depth (directions @ (u, v, 1))
        origin = rotation.T @ (pinhole.centre - primitives.positions[i])
        R_body_camera = rotation.T @ pinhole.R_world_camera
        first, last = outline(
            left, right, primitives.kinds[i], size, R_body_camera, origin, pinhole.K, image.shape
        )
        if first <= last:
            _fill(
                image, nearness, first, last, left, right, primitives.kinds[i], size, origin,
                _pixel_directions(R_body_camera, pinhole.K), primitives.paints[i],
                lights, lights.towards @ rotation, lights.halfway @ rotation,
            )  # fmt: skip


@njit(cache=True)
def _pixel_directions(R_body_camera, K):
    """(3, 3) that takes a pixel (u, v, 1) to its ray in the body's frame, of depth 1."""
    directions = np.empty((3, 3))
    directions[:, 0] = R_body_camera[:, 0] / K[0, 0]
    directions[:, 1] = R_body_camera[:, 1] / K[1, 1]
    directions[:, 2] = (
        R_body_camera[:, 2] - K[0, 2] * directions[:, 0] - K[1, 2] * directions[:, 1]
    )
    return directions


@njit(cache=True, error_model="numpy")
def outline(left, right, kind, size, R_body_camera, origin, K, shape):
    """Update ``left`` and ``right`` (h,), per row the columns between which a primitive may lie.

    Returns the first and the last row.
    """
    height, width = shape[0], shape[1]
    hx, hy, hz = size
    if kind == CYLINDER:
        hx, hy, hz = size[0], size[0], size[1]
    elif kind == CAPSULE:
        hx, hy, hz = size[0], size[0], size[1] + size[0]
    elif kind == PLANE:
        hz = 0.0
    corners = np.empty((8, 2))
    clipped = False
    for i in range(8):
        x = (hx if i & 1 else -hx) - origin[0]
        y = (hy if i & 2 else -hy) - origin[1]
        z = (hz if i & 4 else -hz) - origin[2]
        depth = R_body_camera[0, 2] * x + R_body_camera[1, 2] * y + R_body_camera[2, 2] * z
        if depth < NEAREST:
            clipped = True
            break
        for k in range(2):
            across = R_body_camera[0, k] * x + R_body_camera[1, k] * y + R_body_camera[2, k] * z
            corners[i, k] = K[k, k] * across / depth + K[k, 2]
    if clipped:
        left[:], right[:] = 0.0, width - 1.0
        return 0, height - 1
    first = max(0, int(np.ceil(max(corners[:, 1].min(), 0.0))))
    last = min(height - 1, int(np.floor(min(corners[:, 1].max(), height - 1.0))))
    if first > last or corners[:, 0].max() < 0.0 or corners[:, 0].min() > width - 1.0:
        return 0, -1
    left[first : last + 1], right[first : last + 1] = np.inf, -np.inf
    for i in range(8):
        for bit in (1, 2, 4):
            if not i & bit:
                _widen(left, right, first, last, corners[i], corners[i | bit])
    for v in range(first, last + 1):
        left[v], right[v] = max(left[v], 0.0), min(right[v], width - 1.0)
    return first, last


@njit(cache=True, error_model="numpy")
def _widen(left, right, first, last, start, end):
    """Update ``left`` and ``right`` (h,) with the columns of an edge, in the rows it crosses."""
    if start[1] > end[1]:
        start, end = end, start
    slope = (end[0] - start[0]) / (end[1] - start[1])
    top = max(first, int(np.ceil(max(start[1], 0.0))))
    bottom = min(last, int(np.floor(min(end[1], last + 1.0))))
    for v in range(top, bottom + 1):
        u = start[0] + slope * (v - start[1])
        left[v], right[v] = min(left[v], u), max(right[v], u)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _fill(
    image, nearness, first, last, left, right, kind, size, origin, directions, paint, lights,
    towards, halfway,
):  # fmt: skip
    """Update ``image`` and ``nearness`` inside an outline with one primitive."""
    ox, oy, oz = origin
    gx, gy, gz = directions[:, 0]
    for v in range(first, last + 1):
        ex, ey, ez = directions[:, 1] * v + directions[:, 2]
        for u in range(int(np.ceil(left[v])), int(np.floor(right[v])) + 1):
            dx, dy, dz = ex + gx * u, ey + gy * u, ez + gz * u
            near = meet(kind, size, ox, oy, oz, dx, dy, dz)
            if near <= nearness[v, u]:
                continue
            nearness[v, u] = near
            depth = 1.0 / near
            x, y, z = ox + dx * depth, oy + dy * depth, oz + dz * depth
            nx, ny, nz = normal(kind, size, x, y, z)
            _shade(image[v, u], paint, nx, ny, nz, lights, towards, halfway)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _shade(pixel, paint, nx, ny, nz, lights, towards, halfway):
    """Update ``pixel`` (3,) to a surface's colour: Lambert's and Blinn's reflection."""
    r, g, b = lights.ambient
    shine_r = shine_g = shine_b = 0.0
    for i in range(len(towards)):
        facing = nx * towards[i, 0] + ny * towards[i, 1] + nz * towards[i, 2]
        if facing <= 0.0:
            continue
        r += facing * lights.diffuse[i, 0]
        g += facing * lights.diffuse[i, 1]
        b += facing * lights.diffuse[i, 2]
        mirrored = nx * halfway[i, 0] + ny * halfway[i, 1] + nz * halfway[i, 2]
        if mirrored > 0.8 and lights.specular[i, 0] > 0.0:
            glint = paint[3] * np.exp(paint[4] * np.log(mirrored))
            shine_r += glint * lights.specular[i, 0]
            shine_g += glint * lights.specular[i, 1]
            shine_b += glint * lights.specular[i, 2]
    pixel[0] = np.uint8(255.0 * min(r * paint[0] + shine_r, 1.0) + 0.5)
    pixel[1] = np.uint8(255.0 * min(g * paint[1] + shine_g, 1.0) + 0.5)
    pixel[2] = np.uint8(255.0 * min(b * paint[2] + shine_b, 1.0) + 0.5)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def paint_texture(image, nearness, before, pinhole, size, position, rotation, texture, repeats):
    """Update ``image`` where a plane just became nearest, multiplying by its ``texture`` (h, w, 3).

    ``before`` is the nearness without the plane. Each pixel averages SAMPLES x SAMPLES texels.
    """
    origin = rotation.T @ (pinhole.centre - position)
    directions = _pixel_directions(rotation.T @ pinhole.R_world_camera, pinhole.K)
    rows, columns = texture.shape[:2]
    for v in range(len(image)):
        for u in range(image.shape[1]):
            if nearness[v, u] == before[v, u]:
                continue
            total = np.zeros(3)
            for k in range(SAMPLES * SAMPLES):
                du = (k % SAMPLES + 0.5) / SAMPLES - 0.5
                dv = (k // SAMPLES + 0.5) / SAMPLES - 0.5
                d = directions[:, 0] * (u + du) + directions[:, 1] * (v + dv) + directions[:, 2]
                depth = -origin[2] / d[2]
                s = repeats[0] * (0.5 + 0.5 * (origin[0] + depth * d[0]) / size[0])
                t = repeats[1] * (0.5 - 0.5 * (origin[1] + depth * d[1]) / size[1])
                row, column = int((t - np.floor(t)) * rows), int((s - np.floor(s)) * columns)
                total += texture[min(row, rows - 1), min(column, columns - 1)]
            for k in range(3):
                image[v, u, k] = np.uint8(
                    image[v, u, k] * total[k] / (255.0 * SAMPLES * SAMPLES) + 0.5
                )


SAMPLES = 4
