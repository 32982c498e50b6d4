"""Where rays first meet boxes, cylinders, capsules and planes.

All in the primitive's own frame, along z: the ray is ``o + t d`` with t > 0, and what is returned
is its nearness 1 / t at the first hit, 0 for none. In nearness, planes and quadrics need no
division by anything of the ray's. Numbers of kinds and meanings of sizes are MuJoCo's.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array

PLANE, CAPSULE, CYLINDER, BOX = 0, 3, 5, 6
FAST = {"arcp", "contract", "nsz"}  # keeps NaN and infinity


class Primitives(NamedTuple):
    """Bodies, by row.

    Attributes:
        kinds: (n,) ``PLANE``, ``CAPSULE``, ``CYLINDER`` or ``BOX``.
        sizes: (n, 3) half extents, or radius and half length [m].
        positions: (n, 3) centres in world [m].
        rotations: (n, 3, 3) ``R_world_body``.
        paints: (n, 5) RGB in [0, 1], specular reflectance, log2 of its exponent.
    """

    kinds: NDArray[np.int32]
    sizes: Array
    positions: Array
    rotations: Array
    paints: Array


@njit(cache=True, fastmath=FAST, error_model="numpy")
def meet(kind, size, ox, oy, oz, dx, dy, dz):
    """Nearness of a primitive's first hit."""
    if kind == BOX:
        return _meet_box(size[0], size[1], size[2], ox, oy, oz, dx, dy, dz)
    if kind == CYLINDER:
        return _meet_cylinder(size[0], size[1], ox, oy, oz, dx, dy, dz)
    if kind == CAPSULE:
        return _meet_capsule(size[0], size[1], ox, oy, oz, dx, dy, dz)
    return _meet_plane(size[0], size[1], ox, oy, oz, dx, dy, dz)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _slab(half, o, d, near, far):
    """``near`` and ``far``, the nearness of entry and of exit, cut by -half <= o + t d <= half."""
    if abs(o) > half:
        front = np.copysign(half, o)
        return min(near, d / (front - o)), max(far, d / (-front - o))
    return near, max(far, max(d / (half - o), d / (-half - o)))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _meet_box(hx, hy, hz, ox, oy, oz, dx, dy, dz):
    near, far = _slab(hx, ox, dx, np.inf, 0.0)
    near, far = _slab(hy, oy, dy, near, far)
    near, far = _slab(hz, oz, dz, near, far)
    return near if far <= near < np.inf else 0.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _meet_cylinder(radius, half, ox, oy, oz, dx, dy, dz):
    a, b, c = dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - radius * radius
    discriminant = b * b - a * c
    if discriminant <= 0.0:
        return 0.0
    root = np.sqrt(discriminant)
    near = (root - b) / c if c > 0.0 else np.inf
    near, far = _slab(half, oz, dz, near, max(0.0, (-b - root) / c))
    return near if far <= near < np.inf else 0.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _meet_capsule(radius, half, ox, oy, oz, dx, dy, dz):
    a, b, c = dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - radius * radius
    z = oz
    if c > 0.0:
        discriminant = b * b - a * c
        if discriminant <= 0.0 or b >= 0.0:
            return 0.0
        near = (np.sqrt(discriminant) - b) / c
        z = oz + dz / near
        if abs(z) <= half:
            return near
    beyond = oz - np.copysign(half, z)
    a, b, c = a + dz * dz, b + beyond * dz, c + beyond * beyond
    discriminant = b * b - a * c
    if discriminant <= 0.0 or c <= 0.0 or b >= 0.0:
        return 0.0
    return (np.sqrt(discriminant) - b) / c


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _meet_plane(hx, hy, ox, oy, oz, dx, dy, dz):
    near = -dz / oz
    if oz <= 0.0 or near <= 0.0:
        return 0.0
    return near if abs(ox * near + dx) <= hx * near and abs(oy * near + dy) <= hy * near else 0.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def normal(kind, size, x, y, z):
    """Outward unit normal of a primitive at a point of its surface."""
    if kind == BOX:
        rx, ry, rz = abs(x) / size[0], abs(y) / size[1], abs(z) / size[2]
        if rx >= ry and rx >= rz:
            return np.copysign(1.0, x), 0.0, 0.0
        if ry >= rz:
            return 0.0, np.copysign(1.0, y), 0.0
        return 0.0, 0.0, np.copysign(1.0, z)
    if kind == CYLINDER:
        radial = np.sqrt(x * x + y * y)
        if radial * size[1] >= abs(z) * size[0]:
            return x / radial, y / radial, 0.0
        return 0.0, 0.0, np.copysign(1.0, z)
    if kind == CAPSULE:
        beyond = z - min(max(z, -size[1]), size[1])
        return x / size[0], y / size[0], beyond / size[0]
    return 0.0, 0.0, 1.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def first_hits(origin, directions, primitives):
    """Distances (n,) to the first hit along unit ``directions`` (n, 3); infinite for none."""
    nearness = np.zeros(len(directions))
    o, d = np.empty(3), np.empty(3)
    for i in range(len(primitives.kinds)):
        kind, size = primitives.kinds[i], primitives.sizes[i]
        rotation, offset = primitives.rotations[i], origin - primitives.positions[i]
        reach = _bounding_radius(kind, size) ** 2
        apart = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2
        for k in range(3):
            o[k] = 0.0
            for m in range(3):
                o[k] += rotation[m, k] * offset[m]
        for j in range(len(directions)):
            direction = directions[j]
            along = -(
                direction[0] * offset[0] + direction[1] * offset[1] + direction[2] * offset[2]
            )
            if apart > reach and (along < 0.0 or apart - along * along > reach):
                continue
            for k in range(3):
                d[k] = 0.0
                for m in range(3):
                    d[k] += rotation[m, k] * direction[m]
            hit = meet(kind, size, o[0], o[1], o[2], d[0], d[1], d[2])
            nearness[j] = max(nearness[j], hit)
    return 1.0 / nearness


@njit(cache=True)
def _bounding_radius(kind, size):
    if kind == BOX:
        return np.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2)
    if kind in (CYLINDER, PLANE):
        return np.sqrt(size[0] ** 2 + size[1] ** 2)
    return size[0] + size[1]
