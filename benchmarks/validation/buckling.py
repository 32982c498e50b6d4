"""Where straight, ring and twisted rods lose their stability, and what they become.

References: Euler's loads and the clamped elastica's post-buckling path (elliptic integrals); the
twisted ring of Michell (1889; Goriely 2006); the localised helix of a long twisted rod (Coyne 1990;
van der Heijden and Thompson 2000), which Gazzola et al. (2018) use too.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.interpolate import BarycentricInterpolator
from scipy.optimize import brentq, fsolve
from scipy.special import ellipe, ellipk

from benchmarks.validation.case import COMPARISON, Case, compare, order
from benchmarks.validation.hessian import linearise, relax
from benchmarks.validation.statics import LENGTH, WEIGHTLESS
from dlo_gym.geometry.se3 import Array, exp_so3, frame_along, matrix_to_quaternion, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties, RodState

AT_ORIGIN = pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), [0.0, 0.0, 0.0])


def euler_load(properties: RodProperties, length_factor: float) -> float:
    """The buckling load [N] of a rod that also shortens and shears.

    The straight rod under P is stable while P (1 + P / kGA - P / EA) < EI (pi / (K L))^2; without
    the bracket that is Euler's load. K, the ``length_factor``, is 1/2 for clamped ends, 2 where
    one is free.
    """
    euler = properties.bending_stiffness * (np.pi / (length_factor * properties.length)) ** 2
    softening = 1.0 / properties.shearing_stiffness - 1.0 / properties.stretching_stiffness
    return 2.0 * euler / (1.0 + np.sqrt(1.0 + 4.0 * euler * softening))


def buckling_load(properties: RodProperties, n: int, *, free_end: bool) -> float:
    """The load [N] at which the straight rod's lowest eigenvalue vanishes."""
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    expected = euler_load(properties, 2.0 if free_end else 0.5)

    def lowest(load: float) -> float:
        forces = np.zeros((n + 1, 3))
        forces[-1, 0] = -load
        rod.apply_forces(forces)
        length = properties.length * (1.0 - load / properties.stretching_stiffness)
        return linearise(rod, _straight(rod, length, free_end)).lowest()[0]

    return float(brentq(lowest, 0.5 * expected, 1.5 * expected, rtol=1e-10))


def _straight(rod: CosseratRod, length: float, free_end: bool) -> RodState:
    right = AT_ORIGIN.copy()
    right[0, 3] = length
    return _shape(
        rod,
        np.linspace(0.0, length, rod.n_nodes)[:, None] * [1.0, 0.0, 0.0],
        np.broadcast_to(AT_ORIGIN[:3, :3], (rod.n_elements, 3, 3)),
        BoundaryPoses(AT_ORIGIN, None if free_end else right),
    )


def _shape(
    rod: CosseratRod, positions: Array, directors: Array, boundary: BoundaryPoses
) -> RodState:
    """A shape to start from; only its positions, frames and clamps mean anything."""
    return replace(
        CosseratRod(rod.properties, rod.n_elements).settle(BoundaryPoses(AT_ORIGIN)),
        positions=positions, quaternions=matrix_to_quaternion(directors), boundary=boundary,
    )  # fmt: skip


class PostBuckling(NamedTuple):
    """A clamped-clamped rod after Euler buckling; all over L or over Euler's load."""

    shortening: float
    load: float
    deflection: float


def post_buckled_elastica(shortening: float) -> PostBuckling:
    """The inextensible rod's, by elliptic integrals of the modulus that shortens it so."""

    def excess(m: float) -> float:
        return 2.0 - 2.0 * ellipe(m) / ellipk(m) - shortening

    m = float(brentq(excess, 1e-9, 0.99, xtol=1e-14))
    K = float(ellipk(m))
    return PostBuckling(shortening, (4.0 * K) ** 2 / (4.0 * np.pi**2), float(np.sqrt(m)) / K)


def post_buckled_rod(properties: RodProperties, shortening: float, n: int = 100) -> PostBuckling:
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    right = AT_ORIGIN.copy()
    right[0, 3] = (1.0 - shortening) * properties.length
    state = rod.settle(BoundaryPoses(AT_ORIGIN, right))
    deflection = np.linalg.norm(state.positions[:, 1:], axis=1).max() / properties.length
    load = -state.wrench_right[0] / euler_load(properties, 0.5)
    return PostBuckling(shortening, float(load), float(deflection))


def michell_twist(properties: RodProperties) -> float:
    """The twist [rad] at which a ring leaves its plane: 2 pi sqrt(3) EI / GJ."""
    ratio = properties.bending_stiffness / properties.twisting_stiffness
    return 2.0 * np.pi * np.sqrt(3.0) * ratio


def ring(rod: CosseratRod, twist: float) -> RodState:
    """A regular polygon from a clamp back to it, evenly twisted, by ``twist`` [rad] in all."""
    n = rod.n_elements
    turned = (np.arange(n) + 0.5)[:, None] / n
    flat = exp_so3(2.0 * np.pi * turned * AT_ORIGIN[:3, 0]) @ AT_ORIGIN[:3, :3]
    edges = flat[:, :, 2] * rod.properties.length / n
    right = AT_ORIGIN.copy()
    right[:3, :3] = right[:3, :3] @ exp_so3([0.0, 0.0, twist])
    nodes = np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)])
    directors = flat @ exp_so3(turned * [0.0, 0.0, twist])
    return _shape(rod, nodes, directors, BoundaryPoses(AT_ORIGIN, right))


def ring_stiffness(properties: RodProperties, n: int, twist: float) -> Array:
    """(3,) the twisted ring's stiffnesses [N/m], nearest zero first, but the neutral one.

    They are eigenvalues of the Hessian about the flat ring.

    Joined to itself or clamped at one point, a ring has the same shapes up to a rigid motion. It
    can always turn about the clamp's tangent at no cost: one eigenvalue is zero."""
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    across_far_node = 6 * (n // 2) + 1
    values = linearise(rod, relax(rod, ring(rod, twist), across_far_node)).lowest()
    return values[np.argsort(np.abs(values))][1:]


def critical_ring_twist(properties: RodProperties, n: int) -> float:
    """The twist [rad] at which the eigenvalue nearest zero vanishes.

    Interpolated, for at the critical twist itself the ring is as soft as its neutral direction."""
    fractions = np.array([0.98, 0.99, 1.01, 1.02])
    expected = michell_twist(properties)
    nearest = [ring_stiffness(properties, n, fraction * expected)[0] for fraction in fractions]
    cubic = BarycentricInterpolator(fractions, nearest)
    return expected * float(brentq(cubic, fractions[0], fractions[-1]))


def ring_path(properties: RodProperties, n: int, twists: Array) -> Array:
    """(n_twists,) the twist [rad] left in a ring whose clamp turns to each of ``twists`` in turn.

    Past Michell's twist it leaves the plane, passes through itself (nothing here stops it) and lies
    flat again with two turns less. A breath of gravity takes away the neutral direction."""
    breath = 1e-4 * properties.bending_stiffness / properties.linear_density / properties.length**3
    rod = CosseratRod(properties, n, gravity=(0.0, 0.0, -breath), clamp="node")
    flat = ring(rod, 0.0)
    rod.settle(flat.boundary, flat.positions)
    left = []
    for turn in np.diff(twists, prepend=0.0):
        turned = np.concatenate([np.zeros(3), turn * AT_ORIGIN[:3, 2]])
        state = rod.move(BoundaryDisplacement(np.zeros(6), turned))
        left.append(state.curvature[:, 2].mean() * properties.length)
    return np.array(left)


class Helix(NamedTuple):
    """Localised buckling of a long rod: the closed form's, or ours.

    Attributes:
        tension: [N].
        torque: [N m].
        largest_angle: between tangent and axis [rad].
        envelope: (n_elements,) (cos(angle) - cos(largest)) / (1 - cos(largest)).
        centre: arc length of the largest angle [m].
        positions: (n + 1, 3) [m]; empty for the closed form.
    """

    tension: float
    torque: float
    largest_angle: float
    envelope: Array
    centre: float
    positions: Array


def localised_helix(
    properties: RodProperties, shortening: float, twist: float, arc_length: Array, centre: float
) -> Helix:
    """The infinite rod's homoclinic solution for an end shortening [m] and end rotation [rad].

    The tension also stretches the rod, which adds T L / EA to the shortening that shows. With
    m = M / sqrt(B T): D = 4 sqrt(B / T) sqrt(1 - m^2/4), R = M L / C + 4 arccos(m / 2), and
    cos(angle) = 1 - 2 (1 - m^2/4) sech^2(s sqrt(T/B) sqrt(1 - m^2/4)).
    """
    length, B, C = properties.length, properties.bending_stiffness, properties.twisting_stiffness

    def mismatch(unknowns: Array) -> list[float]:
        m, t = unknowns  # t = L sqrt(T / B)
        slack = shortening / length + B * (t / length) ** 2 / properties.stretching_stiffness
        spread = 4.0 * np.sqrt(1.0 - 0.25 * m * m) / t
        return [spread - slack, m * t * B / C + 4.0 * np.arccos(0.5 * m) - twist]

    m, t = fsolve(mismatch, [1.8, twist * C / (2.0 * B)], xtol=1e-12)
    s = np.sqrt(1.0 - 0.25 * m * m)
    envelope = np.tanh(s * t * (arc_length - centre) / length) ** 2
    return Helix(
        float(B * (t / length) ** 2), float(m * t * B / length),
        float(np.arccos(1.0 - 2.0 * s * s)), envelope, centre, np.empty((0, 3)),
    )  # fmt: skip


def buckled_helix(properties: RodProperties, shortening: float, twist: float, n: int) -> Helix:
    """The rod shortened and twisted step by step until it has found the helix by itself."""
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    first = shortening / 30.0
    right = AT_ORIGIN.copy()
    right[0, 3] = properties.length - first
    state = rod.settle(BoundaryPoses(AT_ORIGIN, right))
    steps = int(np.ceil(10.0 * twist / (2.0 * np.pi)))
    step = np.array([-(shortening - first) / steps, 0.0, 0.0, twist / steps, 0.0, 0.0])
    for _ in range(steps):
        state = rod.move(BoundaryDisplacement(np.zeros(6), step))
    cosine = state.directors[:, 0, 2]
    middle = int(np.argmin(cosine))
    a, b, c = cosine[middle - 1 : middle + 2]  # the lowest point of the parabola through three
    offset = 0.5 * (a - c) / (a - 2.0 * b + c)
    lowest = b - 0.25 * (a - c) * offset
    return Helix(
        float(state.wrench_right[0]), float(state.wrench_right[3]), float(np.arccos(lowest)),
        (cosine - lowest) / (1.0 - lowest), (middle + 0.5 + offset) * properties.length / n,
        state.positions,
    )  # fmt: skip


HELIX = RodProperties(1.0, radius=0.0005, youngs_modulus=1e9)
HELIX_SHORTENING, HELIX_TWIST = 0.03, 27.0 * 2.0 * np.pi


def helix_pair(n: int) -> tuple[Helix, Helix]:
    """The closed form and the rod of Gazzola et al. (2018), 3 % shorter and turned 27 times."""
    ours = buckled_helix(HELIX, HELIX_SHORTENING, HELIX_TWIST, n)
    arc_length = (np.arange(n) + 0.5) * HELIX.length / n
    exact = localised_helix(HELIX, HELIX_SHORTENING, HELIX_TWIST, arc_length, ours.centre)
    return exact, ours


def euler_case() -> Case:
    properties = RodProperties(LENGTH)
    rows, counts = [], (20, 40, 80)
    for free_end, name in ((False, "both ends clamped"), (True, "one end free")):
        expected = euler_load(properties, 2.0 if free_end else 0.5)
        loads = np.array([buckling_load(properties, n, free_end=free_end) for n in counts])
        rows.append(compare(f"{name}, 80 elements", 1e3 * expected, 1e3 * loads[-1], "mN"))
        measured = order(counts, np.abs(loads - expected))
        rows.append(("  order over 20, 40, 80 elements", "2", f"{measured:.3f}", ""))
    thin = RodProperties(LENGTH, radius=0.0005)
    shortenings = np.concatenate([[0.003, 0.01], np.linspace(0.03, 0.5, 9)])
    exact = [post_buckled_elastica(d) for d in shortenings]
    ours = [post_buckled_rod(thin, d) for d in shortenings]
    for i in (1, 4, 7):
        percent = f"{100 * shortenings[i]:.3g} % shorter"
        rows.append(compare(f"load / Euler's, {percent}", exact[i].load, ours[i].load))
        rows.append(compare(f"deflection / L, {percent}", exact[i].deflection, ours[i].deflection))

    def draw(figure: Figure) -> None:
        path = [post_buckled_elastica(d) for d in np.linspace(1e-4, 0.5, 100)]
        for column, field, label in ((1, 1, "load / Euler's"), (2, 2, "deflection / L")):
            axes = figure.add_subplot(1, 2, column, xlabel="end shortening / L", ylabel=label)
            axes.plot([p[0] for p in path], [p[field] for p in path], lw=1.0, color="0.3")
            axes.plot([p[0] for p in ours], [p[field] for p in ours], "o", ms=4)

    return Case(COMPARISON, rows, draw)


def ring_case() -> Case:
    properties, counts = RodProperties(LENGTH, radius=0.0005), (20, 40, 80)
    expected = michell_twist(properties)
    twists = np.array([critical_ring_twist(properties, n) for n in counts])
    rows = [
        compare(f"critical twist, {n} elements", expected, twist, "rad")
        for n, twist in zip(counts, twists, strict=True)
    ]
    rows.append(("order", "2", f"{order(counts, np.abs(twists - expected)):.3f}", ""))
    fractions = np.linspace(0.0, 1.2, 13)
    stiffness = [np.sort(ring_stiffness(properties, 40, f * expected)) for f in fractions]
    steps = np.concatenate([np.linspace(0.1, 0.9, 9), np.linspace(0.92, 1.1, 19)])
    left = ring_path(RodProperties(LENGTH), 40, steps * expected)
    lost = int(np.argmin(np.diff(left)))
    rows.append(
        (
            "the moved ring gives way at", f"{expected:.5g} rad",
            f"{steps[lost] * expected:.2f} to {steps[lost + 1] * expected:.2f} rad", "",
        )
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(
            1, 2, 1, xlabel="twist / (2π√3 EI/GJ)", ylabel="lowest eigenvalues [N/m]"
        )
        axes.plot(fractions, stiffness, ".-")
        axes.axhline(0.0, color="0.6", lw=0.8)
        path = figure.add_subplot(1, 2, 2, xlabel="imposed twist", ylabel="twist left in the ring")
        path.plot(steps, left / expected, ".-")
        for each in (axes, path):
            each.axvline(1.0, color="0.6", lw=0.8, ls="--")

    return Case(COMPARISON, rows, draw)


def helix_case() -> Case:
    counts = (100, 200, 400)
    rows = []
    for n in counts:
        exact, ours = helix_pair(n)
        rows.append(compare(f"tension, {n} elements", exact.tension, ours.tension, "N"))
    rows += [
        compare("torque", 1e3 * exact.torque, 1e3 * ours.torque, "mN m"),
        compare("largest angle", exact.largest_angle, ours.largest_angle, "rad"),
        (
            "envelope φ, largest difference", "0",
            f"{np.abs(ours.envelope - exact.envelope).max():.1e}", "",
        ),
    ]  # fmt: skip

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(1, 2, 1, xlabel="arc length / L", ylabel="φ")
        s = (np.arange(counts[-1]) + 0.5) / counts[-1]
        axes.plot(s, exact.envelope, lw=1.0, color="0.3", label="closed form")
        axes.plot(s[::3], ours.envelope[::3], ".", label="rod")
        axes.legend(fontsize=8)
        view = figure.add_subplot(1, 2, 2, projection="3d")
        view.plot(*ours.positions[3 * counts[-1] // 10 : 7 * counts[-1] // 10].T)
        view.set_aspect("equal")
        view.set_axis_off()

    return Case(COMPARISON, rows, draw, (8.0, 2.8))
