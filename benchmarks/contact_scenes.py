"""A cable wrapped around a bar (the paper's Real Exp 4) and an overhand knot pulled tight.

``python -m benchmarks.contact_scenes`` draws both into docs/images/contact.png.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.interpolate import CubicSpline

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError
from dlo_gym.geometry import curves
from dlo_gym.geometry.se3 import Array, exp_so3, frame_along, pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    Capsule,
    CosseratRod,
    RodProperties,
)

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "contact.png"
CABLE = RodProperties(0.5, radius=0.003, external_damping=5.0, internal_damping=0.002)
BAR_RADIUS, ORBIT_STEPS = 0.015, 60
STRING = RodProperties(0.6, radius=0.003, youngs_modulus=1e7)


def hung_over_bar(friction: float) -> CosseratRod:
    """A cable that goes up, over a bar along y and down again, its clamps 24 mm apart along y."""
    turn = BAR_RADIUS + CABLE.radius
    tail = 0.5 * (CABLE.length - np.pi * turn)
    s = np.linspace(-tail, CABLE.length - tail, 51)
    turned = np.clip(s / turn, 0.0, np.pi)
    along = np.column_stack([np.sin(turned), 0.0 * turned, np.cos(turned)])
    curve = (s - turn * turned)[:, None] * along + np.column_stack(
        [-turn * np.cos(turned), 0.024 * turned / np.pi - 0.012, turn * np.sin(turned)]
    )
    bar = Capsule.between([0.0, -0.2, 0.0], [0.0, 0.2, 0.0], BAR_RADIUS)
    rod = CosseratRod(CABLE, obstacles=[bar], self_contact=True, friction=friction)
    rod.settle(_clamped(curve, [0.0, 1.0, 0.0]), curve)
    return rod


def once_around(rod: CosseratRod) -> Iterator[BoundaryDisplacement]:
    """The right clamp's way once around the bar, nearer by what the bar takes up of the cable."""
    step = 2.0 * np.pi / ORBIT_STEPS
    for _ in range(ORBIT_STEPS):
        before = rod.state.boundary
        assert before.right is not None
        after = pose(exp_so3([0.0, step, 0.0]), [0.0, 0.01 / ORBIT_STEPS, 0.0]) @ before.right
        from_axis = after[:3, 3] * [1.0, 0.0, 1.0]
        taken_up = (BAR_RADIUS + CABLE.radius) * step
        after[:3, 3] -= taken_up * from_axis / np.linalg.norm(from_axis)
        yield before.displacement_to(BoundaryPoses(before.left, after))


def winding(positions: Array) -> float:
    """Turns of a centerline (n, 3) around the y axis, as the right clamp goes."""
    angles = np.unwrap(np.arctan2(positions[:, 0], positions[:, 2]))
    return float((angles[-1] - angles[0]) / (2.0 * np.pi))


def loose_knot() -> CosseratRod:
    """An overhand knot, about as wide as a hand, in a weightless string."""
    t = np.linspace(-2.15, 2.15, 4000)
    knot = np.column_stack([t**3 - 3.0 * t, 4.0 * t**2 - t**4, 0.07 * t**5 - 0.7 * t])
    knot = curves.resample(knot * STRING.length / curves.arc_length(knot)[-1], 101)
    rod = CosseratRod(STRING, 100, gravity=(0.0, 0.0, 0.0), self_contact=True)
    rod.settle(_clamped(knot, [0.0, 0.0, 1.0]), knot)
    return rod


def into_line(rod: CosseratRod, steps: int = 40) -> list[BoundaryDisplacement]:
    """The way of the knot's clamps into one line, half the string's length apart."""
    line = frame_along([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    ends = [pose(line, [side * 0.25 * STRING.length, 0.0, 0.0]) for side in (-1.0, 1.0)]
    way = rod.state.boundary.displacement_to(BoundaryPoses(*ends))
    return [way.scaled(1.0 / steps)] * steps


def pulled_apart(distance: float) -> BoundaryDisplacement:
    """Both clamps outward along x, together by ``distance`` [m]."""
    left, right = np.zeros(6), np.zeros(6)
    left[0], right[0] = -0.5 * distance, 0.5 * distance
    return BoundaryDisplacement(left, right)


def writhe(positions: Array) -> float:
    """Of a polyline (n, 3), exactly (Klenin and Langowski 2000, method 1a).

    A strand that passes through another changes it by two."""
    a, b = positions[:-1], positions[1:]
    i, j = np.triu_indices(len(a), 2)
    sides = [a[j] - a[i], b[j] - a[i], b[j] - b[i], a[j] - b[i]]
    normals = [np.cross(sides[k], sides[(k + 1) % 4]) for k in range(4)]
    normals = [n / np.maximum(np.linalg.norm(n, axis=1)[:, None], 1e-300) for n in normals]
    angle = sum(
        np.arcsin(np.clip((normals[k] * normals[(k + 1) % 4]).sum(axis=1), -1.0, 1.0))
        for k in range(4)
    )
    sign = np.sign((np.cross(b[j] - a[j], b[i] - a[i]) * sides[0]).sum(axis=1))
    return float(angle @ sign) / (2.0 * np.pi)


def _clamped(curve: Array, reference: list[float]) -> BoundaryPoses:
    """Clamps that hold a curve (n, 3) at its ends along its own tangents."""
    steps = np.diff(curve, axis=0)
    return BoundaryPoses(
        pose(frame_along(steps[0], reference), curve[0]),
        pose(frame_along(steps[-1], reference), curve[-1]),
    )


def tube(positions: Array, radius: float, sides: int = 20) -> Array:
    """Quadrilaterals (m, 4, 3) of the surface around a centerline (n, 3)."""
    tangents = np.gradient(positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    first = frame_along(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    frames = curves.parallel_transport(tangents, first)
    angles = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    rings = positions[:, None] + np.einsum("nij,kj->nki", frames[:, :, :2], circle)
    corners = rings[:-1, :-1], rings[1:, :-1], rings[1:, 1:], rings[:-1, 1:]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def show(axes: Axes3D, tubes: list[tuple[Array, float, str]], view: tuple[float, float]) -> None:
    """Draw tubes (centerline, radius, colour), lit from above and sorted by depth together."""
    faces, colours = [], []
    light = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    for positions, radius, colour in tubes:
        quads = tube(positions, radius)
        normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        brightness = 0.55 + 0.45 * np.abs(normals @ light)
        faces.append(quads)
        colours.append(brightness[:, None] * to_rgb(colour))
    axes.add_collection3d(
        Poly3DCollection(np.concatenate(faces), facecolors=np.concatenate(colours), lw=0.0)
    )
    corners = np.concatenate([positions for positions, *_ in tubes])
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.35)
    axes.view_init(*view)
    axes.set_axis_off()


def main() -> None:
    rod = hung_over_bar(friction=0.3)
    for way in once_around(rod):
        state = rod.advance(way, 0.1)
    y = np.linspace(-0.05, 0.05, 60)[:, None]
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    left = figure.add_subplot(1, 3, 1, projection="3d", title="once around a bar")
    middle = np.linalg.norm(state.positions, axis=1) < 0.07
    bar = y * [0.0, 1.0, 0.0], BAR_RADIUS, "0.75"
    show(left, [(finer(state.positions[middle]), CABLE.radius, "tab:red"), bar], (25.0, -50.0))
    rod = loose_knot()
    for way in into_line(rod):
        rod.move(way)
    for column, distance in enumerate((0.31, 0.45)):
        while rod.state.boundary.distance < distance:
            rod.move(pulled_apart(0.005))
        axes = figure.add_subplot(
            1, 3, 2 + column, projection="3d", title=("a knot", "pulled tight")[column]
        )
        string = rod.state.positions
        near = string[np.linalg.norm(string, axis=1) < (0.16, 0.07)[column]]
        view = ((75.0, -85.0), (20.0, -85.0))[column]
        show(axes, [(finer(near), STRING.radius, "tab:blue")], view)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(PICTURE, DloError) as part:
        figure.savefig(part, format="png", dpi=100, metadata={"Software": None})


def finer(positions: Array) -> Array:
    """A smooth curve through the nodes, for the eye."""
    s = np.arange(len(positions))
    return CubicSpline(s, positions)(np.linspace(0.0, s[-1], 4 * len(s)))


if __name__ == "__main__":
    main()
