"""Drawing primitives into an image with a depth buffer, by a ray through each pixel.

A primitive's rays are cast only inside the outline of its bounding box, row by row. The light is
directional, and so is the look for the highlights, so that a face has one colour and a cylinder one
per line along its axis.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dlo_gym.geometry.se3 import Array
from dlo_gym.scene._kernels_rays import BOX, CAPSULE, CYLINDER, FAST, PLANE, meet, normal

TINTS = 64  # colours from one rim of a cylinder to the other
SAMPLES = 4  # of a texture, across and down each pixel
LANES = 16  # pixels that a processor takes at once, at most
SINGLE = np.float32
NONE, HALF, LAST = SINGLE(0.0), SINGLE(TINTS // 2), SINGLE(TINTS - 1)
GLOSSY = 0.85  # cosine between normal and highlight from which it counts
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


@njit(cache=True, fastmath=FAST, error_model="numpy")
def draw(image, nearness, pinhole, primitives, lights):
    """Update ``image`` (h, w, 3) and ``nearness`` (h, w) [1/m] where a primitive is nearer."""
    height = len(image)
    left, right = np.empty(height), np.empty(height)
    R_body_camera, rays = np.empty((3, 3)), np.empty((3, 3))
    origin, offset = np.empty(3), np.empty(3)
    towards, halfway = np.empty_like(lights.towards), np.empty_like(lights.halfway)
    tints = np.empty((TINTS + 1, 3), np.uint8)
    for i in range(len(primitives.kinds)):
        kind, size = primitives.kinds[i], primitives.sizes[i]
        rotation, position = primitives.rotations[i], primitives.positions[i]
        for k in range(3):
            offset[k] = pinhole.centre[k] - position[k]
        _into_body(origin, rotation, offset)
        for k in range(3):
            _into_body(R_body_camera[:, k], rotation, pinhole.R_world_camera[:, k])
        first, last, clipped = outline(
            left, right, kind, size, R_body_camera, origin, pinhole.K, image.shape
        )
        if first > last:
            continue
        _pixel_rays(rays, R_body_camera, pinhole.K)
        for k in range(len(towards)):
            _into_body(towards[k], rotation, lights.towards[k])
            _into_body(halfway[k], rotation, lights.halfway[k])
        lit = Lights(towards, halfway, lights.diffuse, lights.specular, lights.ambient)
        spans = (first, last, left, right)
        paint = primitives.paints[i]
        beside_axis = origin[0] ** 2 + origin[1] ** 2 > size[0] ** 2
        if kind == BOX and not clipped:
            _tint_box(tints, paint, lit, origin)
            _fill_box(image, nearness, spans, size, origin, rays, tints)
        elif kind == CYLINDER and beside_axis:
            _tint_cylinder(tints, paint, lit, origin)
            _fill_cylinder(image, nearness, spans, size, origin, rays, tints)
        else:
            _fill(image, nearness, spans, kind, size, origin, rays, paint, lit)


@njit(cache=True)
def _into_body(out, rotation, vector):
    """Update ``out`` (3,) to a world vector in the frame of a body with ``R_world_body``."""
    for k in range(3):
        out[k] = (
            rotation[0, k] * vector[0] + rotation[1, k] * vector[1] + rotation[2, k] * vector[2]
        )


@njit(cache=True)
def _pixel_rays(rays, R_body_camera, K):
    """Update ``rays`` (3, 3): times a pixel (u, v, 1) they are its ray, of depth 1, in the body."""
    for k in range(3):
        rays[k, 0] = R_body_camera[k, 0] / K[0, 0]
        rays[k, 1] = R_body_camera[k, 1] / K[1, 1]
        rays[k, 2] = R_body_camera[k, 2] - K[0, 2] * rays[k, 0] - K[1, 2] * rays[k, 1]


@njit(cache=True, error_model="numpy")
def outline(left, right, kind, size, R_body_camera, origin, K, shape):
    """Update ``left`` and ``right`` (h,), per row the columns between which a primitive may lie.

    Returns the first and the last row, and whether it comes too close for an outline.
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
        return 0, height - 1, True
    first = max(0, int(np.ceil(max(corners[:, 1].min(), 0.0))))
    last = min(height - 1, int(np.floor(min(corners[:, 1].max(), height - 1.0))))
    if first > last or corners[:, 0].max() < 0.0 or corners[:, 0].min() > width - 1.0:
        return 0, -1, False
    left[first : last + 1], right[first : last + 1] = np.inf, -np.inf
    for i in range(8):
        for bit in (1, 2, 4):
            if not i & bit:
                _widen(left, right, first, last, corners[i], corners[i | bit])
    for v in range(first, last + 1):
        left[v], right[v] = max(left[v], 0.0), min(right[v], width - 1.0)
    return first, last, False


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


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _fill(image, nearness, spans, kind, size, origin, rays, paint, lights):
    """Update ``image`` and ``nearness`` inside an outline with one primitive of any kind."""
    first, last, left, right = spans
    ox, oy, oz = origin[0], origin[1], origin[2]
    gx, gy, gz = rays[0, 0], rays[1, 0], rays[2, 0]
    for v in range(first, last + 1):
        ex = rays[0, 1] * v + rays[0, 2]
        ey = rays[1, 1] * v + rays[1, 2]
        ez = rays[2, 1] * v + rays[2, 2]
        for u in range(int(np.ceil(left[v])), int(np.floor(right[v])) + 1):
            dx, dy, dz = ex + gx * u, ey + gy * u, ez + gz * u
            near = meet(kind, size, ox, oy, oz, dx, dy, dz)
            if near <= nearness[v, u]:
                continue
            nearness[v, u] = near
            depth = 1.0 / near
            nx, ny, nz = normal(kind, size, ox + dx * depth, oy + dy * depth, oz + dz * depth)
            _shade(image[v, u], paint, lights, nx, ny, nz)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _fill_box(image, nearness, spans, size, origin, rays, tints):
    """Update ``image`` and ``nearness`` inside the exact outline of a box, given ``_tint_box``."""
    first, last, left, right = spans
    begin, step = np.empty(3), np.empty(3)
    for v in range(first, last + 1):
        start, stop = int(np.ceil(left[v])), int(np.floor(right[v])) + 1
        # The nearness of a face's plane is linear in the pixel; the box begins at the farthest.
        for k in range(3):
            begin[k], step[k] = np.inf, 0.0
            if abs(origin[k]) > size[k]:
                apart = np.copysign(size[k], origin[k]) - origin[k]
                begin[k] = (rays[k, 0] * start + rays[k, 1] * v + rays[k, 2]) / apart
                step[k] = rays[k, 0] / apart
        begin_x, begin_y, begin_z = begin[0], begin[1], begin[2]
        step_x, step_y, step_z = step[0], step[1], step[2]
        nearest, pixel = nearness[v, start:stop], image[v, start:stop]
        for i in range(stop - start):
            near_x, near_y = begin_x + step_x * i, begin_y + step_y * i
            near = min(near_x, near_y, begin_z + step_z * i)
            if near > nearest[i]:
                nearest[i] = near
                face = 0 if near == near_x else (1 if near == near_y else 2)
                for k in range(3):
                    pixel[i, k] = tints[face, k]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _fill_cylinder(image, nearness, spans, size, origin, rays, tints):
    """Update ``image`` and ``nearness`` inside an outline with a cylinder seen from beside its
    axis, given ``_tint_cylinder``; the equations are ``meet``'s.

    From a row's first pixel on all is linear but for the discriminant, which is quadratic: single
    precision serves, and without a branch the compiler takes many pixels at a time.
    """
    first, last, left, right = spans
    ox, oy, oz = origin[0], origin[1], origin[2]
    gx, gy, gz = rays[0, 0], rays[1, 0], rays[2, 0]
    radius_2 = size[0] * size[0]
    per_c = 1.0 / (ox * ox + oy * oy - radius_2)
    tint_scale = 0.5 * TINTS / (size[0] * np.sqrt(ox * ox + oy * oy))
    above_cap, facing = abs(oz) > size[1], np.copysign(size[1], oz)
    per_cap, per_back = 1.0 / (facing - oz), 1.0 / (-facing - oz)
    b_step, beside_step = ox * gx + oy * gy, ox * gy - oy * gx
    b1, tint1 = SINGLE(b_step * per_c), SINGLE(beside_step * tint_scale)
    cap1, back1 = SINGLE(gz * per_cap), SINGLE(gz * per_back)
    square = radius_2 * (gx * gx + gy * gy) - beside_step * beside_step
    square = SINGLE(square * per_c * per_c)
    pixels = np.arange(image.shape[1] + LANES).astype(np.float32)
    near, tint = np.empty_like(pixels), np.empty(len(pixels), np.uint8)
    for v in range(first, last + 1):
        start, stop = int(np.ceil(left[v])), int(np.floor(right[v])) + 1
        dx = rays[0, 1] * v + rays[0, 2] + gx * start
        dy = rays[1, 1] * v + rays[1, 2] + gy * start
        dz = rays[2, 1] * v + rays[2, 2] + gz * start
        b, beside = ox * dx + oy * dy, ox * dy - oy * dx
        b0, tint0 = SINGLE(b * per_c), SINGLE(beside * tint_scale)
        cap0, back0 = SINGLE(dz * per_cap), SINGLE(dz * per_back)
        linear = 2.0 * (radius_2 * (dx * gx + dy * gy) - beside * beside_step)
        linear = SINGLE(linear * per_c * per_c)
        constant = radius_2 * (dx * dx + dy * dy) - beside * beside
        constant = SINGLE(constant * per_c * per_c)
        for i in range((stop - start + LANES - 1) // LANES * LANES):
            x = pixels[i]
            discriminant = constant + x * (linear + x * square)
            root, middle = np.sqrt(max(discriminant, NONE)), b0 + x * b1
            cap, back = cap0 + x * cap1, back0 + x * back1
            side = root - middle
            on_cap = above_cap and cap < side
            close = cap if on_cap else side
            far = max(-root - middle, back if above_cap else max(cap, back))
            near[i] = close if discriminant > NONE and close >= far else NONE
            across = HALF + (tint0 + x * tint1) / close
            tint[i] = TINTS if on_cap else np.uint8(min(max(across, NONE), LAST))
        nearest, pixel = nearness[v, start:stop], image[v, start:stop]
        for i in range(stop - start):
            if near[i] > nearest[i]:
                nearest[i] = near[i]
                for k in range(3):
                    pixel[i, k] = tints[tint[i], k]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tint_box(tints, paint, lights, origin):
    """Update ``tints[:3]`` to the colours of the faces across x, y and z that are seen."""
    _shade(tints[0], paint, lights, np.copysign(1.0, origin[0]), 0.0, 0.0)
    _shade(tints[1], paint, lights, 0.0, np.copysign(1.0, origin[1]), 0.0)
    _shade(tints[2], paint, lights, 0.0, 0.0, np.copysign(1.0, origin[2]))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tint_cylinder(tints, paint, lights, origin):
    """Update ``tints`` to the colours across the side that is seen, and of its cap."""
    distance = np.sqrt(origin[0] ** 2 + origin[1] ** 2)
    x, y = origin[0] / distance, origin[1] / distance  # towards the camera, across the axis
    for i in range(TINTS):
        across = (2 * i + 1) / TINTS - 1.0
        facing = np.sqrt(1.0 - across * across)
        _shade(tints[i], paint, lights, facing * x - across * y, facing * y + across * x, 0.0)
    _shade(tints[TINTS], paint, lights, 0.0, 0.0, np.copysign(1.0, origin[2]))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _shade(pixel, paint, lights, nx, ny, nz):
    """Update ``pixel`` (3,) to a surface's colour by Lambert's and Blinn's reflection."""
    r, g, b = lights.ambient[0], lights.ambient[1], lights.ambient[2]
    shine_r = shine_g = shine_b = 0.0
    for i in range(len(lights.towards)):
        towards, halfway = lights.towards[i], lights.halfway[i]
        facing = nx * towards[0] + ny * towards[1] + nz * towards[2]
        if facing <= 0.0:
            continue
        r += facing * lights.diffuse[i, 0]
        g += facing * lights.diffuse[i, 1]
        b += facing * lights.diffuse[i, 2]
        glint = nx * halfway[0] + ny * halfway[1] + nz * halfway[2]
        if glint > GLOSSY:
            for _ in range(int(paint[4])):
                glint *= glint
            shine_r += paint[3] * glint * lights.specular[i, 0]
            shine_g += paint[3] * glint * lights.specular[i, 1]
            shine_b += paint[3] * glint * lights.specular[i, 2]
    pixel[0] = np.uint8(255.0 * min(r * paint[0] + shine_r, 1.0) + 0.5)
    pixel[1] = np.uint8(255.0 * min(g * paint[1] + shine_g, 1.0) + 0.5)
    pixel[2] = np.uint8(255.0 * min(b * paint[2] + shine_b, 1.0) + 0.5)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def paint_texture(image, nearness, before, pinhole, size, position, rotation, texture, repeats):
    """Update ``image`` where a plane just became nearest, multiplying by its ``texture`` (h, w, 3).

    ``before`` is the nearness without the plane. Each pixel averages SAMPLES x SAMPLES texels.
    """
    origin = rotation.T @ (pinhole.centre - position)
    rays = np.empty((3, 3))
    _pixel_rays(rays, rotation.T @ pinhole.R_world_camera, pinhole.K)
    rows, columns = texture.shape[:2]
    for v in range(len(image)):
        for u in range(image.shape[1]):
            if nearness[v, u] == before[v, u]:
                continue
            total = np.zeros(3)
            for k in range(SAMPLES * SAMPLES):
                du = (k % SAMPLES + 0.5) / SAMPLES - 0.5
                dv = (k // SAMPLES + 0.5) / SAMPLES - 0.5
                d = rays[:, 0] * (u + du) + rays[:, 1] * (v + dv) + rays[:, 2]
                depth = -origin[2] / d[2]
                s = repeats[0] * (0.5 + 0.5 * (origin[0] + depth * d[0]) / size[0])
                t = repeats[1] * (0.5 - 0.5 * (origin[1] + depth * d[1]) / size[1])
                row, column = int((t - np.floor(t)) * rows), int((s - np.floor(s)) * columns)
                total += texture[min(row, rows - 1), min(column, columns - 1)]
            for k in range(3):
                image[v, u, k] = np.uint8(
                    image[v, u, k] * total[k] / (255.0 * SAMPLES * SAMPLES) + 0.5
                )
