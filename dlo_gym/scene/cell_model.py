"""The cell around the arms: room, table, lights, and the clutter of the paper's second scenario."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

from itertools import pairwise

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from dlo_gym.geometry.se3 import Array

BOX = mujoco.mjtGeom.mjGEOM_BOX
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE

TABLE_CENTRE = (0.0, 0.12)
TABLE_HALF_SIZE = (1.05, 0.62)
HOLE_PITCH = 0.05  # of the table's threaded holes [m]

CABLE_POINTS = 41  # of a cable that lies about

# Colours of cables that lie about: black, blue, yellow, green, white, brown.
CABLE_COLORS = (
    (0.06, 0.06, 0.07),
    (0.10, 0.24, 0.62),
    (0.85, 0.68, 0.12),
    (0.10, 0.42, 0.22),
    (0.80, 0.80, 0.78),
    (0.36, 0.20, 0.12),
)


def add_room(spec: mujoco.MjSpec) -> None:
    """Floor and walls, far enough to fill any camera's background."""
    world = spec.worldbody
    for name, pos, half_size, rgb in (
        ("floor", (0.0, 0.0, -0.87), (4.0, 4.0, 0.05), (0.40, 0.41, 0.42)),
        ("wall_back", (0.0, 2.6, 0.8), (4.0, 0.05, 2.2), (0.70, 0.72, 0.74)),
        ("wall_front", (0.0, -4.0, 0.8), (4.0, 0.05, 2.2), (0.70, 0.72, 0.74)),
        ("wall_left", (-4.0, 0.0, 0.8), (0.05, 4.0, 2.2), (0.66, 0.68, 0.70)),
        ("wall_right", (4.0, 0.0, 0.8), (0.05, 4.0, 2.2), (0.66, 0.68, 0.70)),
    ):
        _add(world, BOX, pos, half_size, rgb, name=name)
    # The cell's rear guard: panels between aluminium profiles.
    for x in (-1.05, -0.35, 0.35, 1.05):
        _add(world, BOX, (x, 0.76, 0.40), (0.02, 0.02, 0.44), (0.74, 0.76, 0.78), specular=0.6)
    for z in (0.02, 0.82):
        _add(world, BOX, (0.0, 0.76, z), (1.03, 0.018, 0.02), (0.74, 0.76, 0.78), specular=0.6)
    _add(world, BOX, (0.0, 0.775, 0.42), (1.03, 0.004, 0.38), (0.56, 0.61, 0.645), specular=0.2)


def add_table(spec: mujoco.MjSpec, plinths: Array) -> None:
    """The table, its top at z = 0, and a plinth under each base at ``plinths`` (2, 3) [m]."""
    world = spec.worldbody
    texture = spec.add_texture(
        name="breadboard",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=256,
        height=256,
        nchannel=3,
    )
    texture.data = _breadboard(256).tobytes()
    repeats = np.array(TABLE_HALF_SIZE) / HOLE_PITCH
    material = spec.add_material(
        name="breadboard", texrepeat=repeats, specular=0.25, shininess=0.3, texuniform=False
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "breadboard"
    (x, y), (half_x, half_y) = TABLE_CENTRE, TABLE_HALF_SIZE
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[x, y, 0.0],
        size=[half_x, half_y, 0.01],
        material="breadboard",
    )
    _add(world, BOX, (x, y, -0.0305), (half_x, half_y, 0.03), (0.20, 0.21, 0.22))
    for dx in (-0.9, 0.9):
        for dy in (-0.5, 0.5):
            leg = (x + dx * half_x, y + dy * half_y, -0.44)
            _add(world, BOX, leg, (0.04, 0.04, 0.38), (0.55, 0.56, 0.58))
    for base in plinths:
        if base[2] > 0.02:
            post, plate = (base[2] - 0.02) / 2, base[2] - 0.01
            _add(world, BOX, (base[0], base[1], 0.008), (0.12, 0.12, 0.008), (0.30, 0.31, 0.33))
            _add(world, CYLINDER, (base[0], base[1], post), (0.07, post, 0.0), (0.34, 0.35, 0.37))
            _add(world, BOX, (base[0], base[1], plate), (0.1, 0.1, 0.01), (0.30, 0.31, 0.33))


def _breadboard(size: int) -> np.ndarray:
    """One hole in a dark anodised plate (size, size, 3) uint8, twice per period."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:size, 0:size] / size - 0.5
    from_hole = np.hypot((2 * x) % 1.0 - 0.5, (2 * y) % 1.0 - 0.5)
    shade = np.full((size, size), 88.0) + rng.normal(0.0, 1.5, (size, size))
    rim = np.clip(1.0 - np.abs(from_hole - 0.105) / 0.03, 0.0, 1.0)
    shade = shade + 30.0 * rim
    shade = np.where(from_hole < 0.09, 24.0, shade)
    return np.clip(shade[..., None] + [0.0, 3.0, 7.0], 0, 255).astype(np.uint8)


def add_lights(spec: mujoco.MjSpec, *, shadows: bool) -> None:
    """A ceiling panel from the front left, a weaker fill from the right, ambient light."""
    headlight = spec.visual.headlight
    headlight.active = 1
    headlight.ambient = [0.42, 0.42, 0.43]
    headlight.diffuse = [0.16, 0.16, 0.16]
    headlight.specular = [0.0, 0.0, 0.0]
    for name, position, direction, diffuse, cast in (
        ("key", (-1.0, -1.2, 2.6), (0.30, 0.50, -0.81), 0.58, shadows),
        ("fill", (1.4, -0.6, 2.2), (-0.55, 0.35, -0.76), 0.26, False),
    ):
        spec.worldbody.add_light(
            name=name,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=position,
            dir=direction,
            diffuse=[diffuse, diffuse, 0.97 * diffuse],
            specular=[0.35 * diffuse] * 3,
            castshadow=cast,
        )


def add_clutter(spec: mujoco.MjSpec) -> None:
    """Industrial parts on the table: bins, an enclosure on a rail, terminals, blocks, ducts."""
    world = spec.worldbody
    _add_bin(world, (-0.30, 0.46), (0.15, 0.10, 0.075), (0.08, 0.25, 0.50))
    _add_bin(world, (0.05, 0.50), (0.13, 0.09, 0.06), (0.30, 0.32, 0.35))
    for x, height, rgb in (
        (0.27, 0.16, (0.62, 0.63, 0.60)),
        (0.345, 0.12, (0.16, 0.17, 0.18)),
        (0.41, 0.14, (0.56, 0.58, 0.55)),
    ):
        _add(world, BOX, (x, 0.50, height / 2), (0.034, 0.05, height / 2), rgb)
        _add(world, BOX, (x, 0.448, 0.7 * height), (0.022, 0.003, 0.012), (0.85, 0.55, 0.10))
    # terminal blocks on a rail
    _add(world, BOX, (-0.02, 0.30, 0.006), (0.26, 0.0175, 0.006), (0.66, 0.67, 0.68), specular=0.7)
    for i in range(14):
        rgb = ((0.58, 0.59, 0.60), (0.12, 0.35, 0.62), (0.50, 0.62, 0.16))[(i * 5 // 4) % 3]
        _add(world, BOX, (-0.17 + 0.0125 * i, 0.30, 0.034), (0.0055, 0.025, 0.022), rgb)
    # cable duct, steel blocks, a red emergency stop
    _add(world, BOX, (-0.02, -0.22, 0.018), (0.34, 0.025, 0.018), (0.46, 0.48, 0.50))
    for i in range(22):
        _add(world, BOX, (-0.335 + 0.03 * i, -0.2455, 0.02), (0.005, 0.001, 0.014), (0.2, 0.2, 0.2))
    _add(world, BOX, (-0.36, 0.18, 0.03), (0.045, 0.045, 0.03), (0.42, 0.43, 0.45), specular=0.7)
    _add(world, CYLINDER, (0.31, 0.2, 0.035), (0.032, 0.035, 0.0), (0.4, 0.41, 0.43), specular=0.8)
    _add(world, BOX, (0.47, -0.16, 0.03), (0.04, 0.04, 0.03), (0.80, 0.66, 0.10))
    _add(world, CYLINDER, (0.47, -0.16, 0.072), (0.02, 0.012, 0.0), (0.68, 0.06, 0.05))


def _add_bin(world: mujoco.MjsBody, centre, half_size, rgb) -> None:
    (x, y), (half_x, half_y, half_z), wall = centre, half_size, 0.004
    _add(world, BOX, (x, y, wall), (half_x, half_y, wall), rgb)
    for sign in (-1.0, 1.0):
        _add(world, BOX, (x + sign * half_x, y, half_z), (wall, half_y, half_z), rgb)
        _add(world, BOX, (x, y + sign * half_y, half_z), (half_x + wall, wall, half_z), rgb)
        rim = (x, y + sign * (half_y + wall), 2 * half_z - wall)
        _add(world, BOX, rim, (half_x + 2 * wall, 2 * wall, wall), rgb)


def lying_cable(rng: np.random.Generator, layer: int) -> tuple[Array, float]:
    """A cable that lies on the table in a random curve: (41, 3) points and its radius [m]."""
    radius = rng.uniform(0.0025, 0.005)
    x = np.linspace(-0.55, 0.55, 6) * rng.uniform(0.5, 1.0) + rng.uniform(-0.1, 0.1)
    knots = np.column_stack([x, rng.uniform(-0.3, 0.4) + rng.normal(0.0, 0.09, 6)])
    points = CubicSpline(np.arange(6), knots)(np.linspace(0.0, 5.0, CABLE_POINTS))
    # A little higher for each layer, so that crossing ones overlap instead of merging.
    return np.column_stack([points, np.full(CABLE_POINTS, radius + 0.004 * layer)]), radius


def add_distractor_cables(spec: mujoco.MjSpec, n_cables: int, rng: np.random.Generator) -> None:
    """Cables lying on the table in random curves, as chains of capsules."""
    for i in range(n_cables):
        points, radius = lying_cable(rng, i)
        for start, end in pairwise(points):
            spec.worldbody.add_geom(
                type=CAPSULE,
                fromto=[*start, *end],
                size=[radius, 0.0, 0.0],
                rgba=[*CABLE_COLORS[i % len(CABLE_COLORS)], 1.0],
            )


def _add(body: mujoco.MjsBody, kind, pos, size, rgb, *, name: str = "", specular: float = 0.1):
    geom = body.add_geom(type=kind, pos=pos, size=size, rgba=[*rgb, 1.0])
    if name:
        geom.name = name
    if specular > 0.3:
        geom.material = "metal"
