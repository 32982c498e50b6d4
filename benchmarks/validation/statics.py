"""Bending, stretch, torsion and the hanging chain; the order of convergence."""

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_bvp

from benchmarks.validation.case import COMPARISON, Case, compare, order
from dlo_gym.geometry.se3 import Array, frame_along, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties, RodState
from dlo_gym.rod.initial_shapes import catenary

LENGTH = 0.5
HORIZONTAL = pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), [0.1, 0.2, 0.3])
TIP_LOADS = (0.2, 2.0, 8.0)  # over EI / L^2
LINE_LOADS = (0.5, 5.0, 20.0)  # over EI / L^3
WEIGHTLESS = (0.0, 0.0, 0.0)


def elastica(tip_load: float, line_load: float, n_nodes: int = 101) -> Array:
    """Planar cantilever on a unit length: EI theta'' = (P + w (L - s)) cos(theta), loads over EI.

    Returns the deflected curve (n_nodes, 2) of an inextensible, unshearable rod."""

    def rates(s, y):
        return [y[1], (tip_load + line_load * (1.0 - s)) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

    def ends(a, b):
        return [a[0], b[1], a[2], a[3]]

    s = np.linspace(0.0, 1.0, n_nodes)
    solution = solve_bvp(rates, ends, s, np.zeros((4, n_nodes)), tol=1e-9, max_nodes=100_000)
    if not solution.success:
        raise RuntimeError(f"elastica: {solution.message}")
    return solution.sol(s)[2:].T


def cantilever(properties: RodProperties, n: int, tip_load: float, gravity: float) -> Array:
    """Curve (n + 1, 2) in the plane of x and z from the clamp, over the length."""
    rod = CosseratRod(properties, n, gravity=(0.0, 0.0, -gravity), clamp="node")
    forces = np.zeros((n + 1, 3))
    forces[-1, 2] = -tip_load
    rod.apply_forces(forces)
    state = rod.settle(BoundaryPoses(HORIZONTAL))
    return (state.positions - HORIZONTAL[:3, 3])[:, [0, 2]] / LENGTH


def loaded_cantilevers(n: int = 100) -> dict[str, tuple[Array, Array]]:
    """Per load the reference curve (n + 1, 2) and the rod's, over the length."""
    properties = RodProperties(LENGTH, radius=0.001, youngs_modulus=1e8)
    stiffness, density = properties.bending_stiffness, properties.linear_density
    curves = {}
    for load in TIP_LOADS:
        curves[f"tip load {load:g} EI/L²"] = (
            elastica(load, 0.0, n + 1),
            cantilever(properties, n, load * stiffness / LENGTH**2, 0.0),
        )
    for load in LINE_LOADS:
        curves[f"own weight {load:g} EI/L³"] = (
            elastica(0.0, load, n + 1),
            cantilever(properties, n, 0.0, load * stiffness / (LENGTH**3 * density)),
        )
    return curves


def hanging_chain(n: int = 200) -> tuple[Array, Array]:
    """The catenary (n + 1, 3) [m] and a rod of hardly any stiffness hung along it.

    The clamps hold the ends along the chain's own tangents, so nothing bends there."""
    start, end = np.array([-0.18, 0.03, 0.4]), np.array([0.17, -0.02, 0.46])
    chain = catenary(start, end, LENGTH, n + 1)
    tangents = np.diff(chain, axis=0)[[0, -1]]
    clamps = [
        pose(frame_along(tangent, [0.0, 1.0, 0.0]), point)
        for tangent, point in zip(tangents, (start, end), strict=True)
    ]
    properties = RodProperties(LENGTH, radius=5e-5, youngs_modulus=1e11, density=4e6)
    rod = CosseratRod(properties, n, clamp="node")
    return chain, rod.settle(BoundaryPoses(*clamps)).positions


def pulled(properties: RodProperties, strain: float, n: int = 20) -> RodState:
    """A rod pulled at its free end by ``strain`` times EA."""
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS)
    forces = np.zeros((n + 1, 3))
    forces[-1, 0] = strain * properties.stretching_stiffness
    rod.apply_forces(forces)
    return rod.settle(BoundaryPoses(HORIZONTAL))


def hung(properties: RodProperties, n: int = 50) -> RodState:
    """A rod that hangs straight down from its left clamp."""
    down = pose(frame_along([0.0, 0.0, -1.0], [0.0, 1.0, 0.0]), [0.0, 0.0, 1.0])
    return CosseratRod(properties, n).settle(BoundaryPoses(down))


def twisted(properties: RodProperties, angle: float, n: int = 40) -> RodState:
    """A straight rod with its far end turned by ``angle`` [rad]."""
    straight_end = HORIZONTAL.copy()
    straight_end[:3, 3] += [LENGTH * (1 - 1e-9), 0.0, 0.0]
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    rod.settle(BoundaryPoses(HORIZONTAL, straight_end))
    return rod.move(BoundaryDisplacement(np.zeros(6), np.array([0, 0, 0, angle, 0, 0])))


def tip_errors(counts: tuple[int, ...]) -> list[float]:
    """Distance of a cantilever's tip from the elastica's, over the length, per element count."""
    properties = RodProperties(LENGTH, radius=0.0002, youngs_modulus=1e10)
    exact = elastica(4.0, 0.0)[-1]
    tip_load = 4.0 * properties.bending_stiffness / LENGTH**2
    return [
        float(np.linalg.norm(cantilever(properties, n, tip_load, 0.0)[-1] - exact)) for n in counts
    ]


def cantilever_case() -> Case:
    curves = loaded_cantilevers()
    rows = [
        (
            name,
            f"{-reference[-1, 1]:.5f}",
            f"{-ours[-1, 1]:.5f}",
            f"{np.linalg.norm(ours - reference, axis=1).max():.1e}",
        )
        for name, (reference, ours) in curves.items()
    ]

    def draw(figure: Figure) -> None:
        for column, kind in enumerate(("tip load", "own weight")):
            axes = figure.add_subplot(1, 2, 1 + column, aspect="equal", title=kind)
            for name, (reference, ours) in curves.items():
                if name.startswith(kind):
                    axes.plot(*reference.T, lw=1.0, color="0.3")
                    axes.plot(*ours[::5].T, ".", label=name.removeprefix(kind))
            axes.legend(fontsize=8)

    header = ("load", "tip deflection / L, elastica", "rod", "largest distance / L")
    return Case(header, rows, draw, (7.0, 3.4))


def catenary_case() -> Case:
    chain, positions = hanging_chain()
    distance = np.linalg.norm(positions - chain, axis=1).max()
    rows = [
        compare("lowest point", chain[:, 2].min(), positions[:, 2].min(), "m"),
        ("largest distance", "0", f"{1e3 * distance:.3f} mm", f"{distance / LENGTH:.1e} L"),
    ]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="z [m]")
        axes.plot(chain[:, 0], chain[:, 2], lw=1.0, color="0.3", label="catenary")
        axes.plot(positions[::8, 0], positions[::8, 2], ".", label="rod")
        axes.legend()

    return Case(COMPARISON, rows, draw, (5.0, 2.6))


def stretch_and_torsion_case() -> Case:
    properties = RodProperties(LENGTH)
    weight = properties.linear_density * 9.81 * LENGTH
    drop = 1.0 - LENGTH - hung(properties).positions[-1, 2]
    strain = pulled(properties, 0.05).strain[:, 2].mean()
    stiff = RodProperties(LENGTH, youngs_modulus=1e8)
    torque = twisted(stiff, 0.3).wrench_right[3]
    rows = [
        compare("stretch under F = 0.05 EA, F/(EA)", 0.05, float(strain)),
        compare(
            "stretch under own weight, WL/(2EA)",
            1e3 * weight * LENGTH / (2.0 * properties.stretching_stiffness), 1e3 * drop, "mm",
        ),
        compare(
            "torque at 0.3 rad, GJ 0.3/L", 1e3 * stiff.twisting_stiffness * 0.3 / LENGTH,
            1e3 * torque, "mN m",
        ),
    ]  # fmt: skip
    return Case(COMPARISON, rows)


def convergence_case() -> Case:
    counts = (10, 20, 40, 80, 160)
    errors = tip_errors(counts)
    rows = [(f"{n}", f"{error:.2e}") for n, error in zip(counts, errors, strict=True)]
    rows.append(("measured order", f"{order(counts, errors):.3f}"))
    return Case(("elements", "distance of the tip / L"), rows)
