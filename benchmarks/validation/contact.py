"""Contact: Coulomb's threshold on an incline, and the tension of a cable around a bar."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.validation.case import Case
from dlo_gym.geometry.se3 import Array, frame_along, pose
from dlo_gym.rod import (
    BoundaryDisplacement,
    BoundaryPoses,
    Capsule,
    CosseratRod,
    Plane,
    RodProperties,
)
from dlo_gym.rod.arrays import node_weights

ON_INCLINE = RodProperties(0.5, radius=0.003, youngs_modulus=1e5)
INCLINE_FRICTIONS = (0.1, 0.3, 0.6, 1.0)
BAR_RADIUS, CABLE_RADIUS, TAIL = 0.05, 0.001, 0.06
CAPSTAN_FRICTIONS = (0.1, 0.3, 0.5)
CAPSTAN_ANGLES = (90, 180, 270, 360, 450, 540)  # [deg]
ONE_STILL = BoundaryDisplacement(np.zeros(6))


def on_incline(friction: float) -> CosseratRod:
    """A soft rod on a level table, held at its left end."""
    rod = CosseratRod(ON_INCLINE, obstacles=[Plane()], friction=friction)
    along_x = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    rod.settle(BoundaryPoses(pose(along_x, [0.0, 0.0, ON_INCLINE.radius])))
    rod.move(ONE_STILL)  # now friction holds it
    return rod


def slid(rod: CosseratRod, slope: float) -> float:
    """How far the tip of a rod on a table slides, in radii, when the table is tilted about the
    rod's axis by ``slope`` [rad]: seen from the table, gravity turns."""
    level = rod.state
    tilted = 9.81 * np.array([0.0, np.sin(slope), -np.cos(slope)])
    rod.apply_forces(node_weights(ON_INCLINE, rod.n_elements, tilted - rod.gravity))
    tip = rod.move(ONE_STILL).positions[-1, 1]
    rod.apply_forces(np.zeros((rod.n_nodes, 3)))
    rod.restore(level)
    return float(tip - level.positions[-1, 1]) / ON_INCLINE.radius


def sliding_slope(friction: float) -> float:
    """The least slope [rad], to 0.005 degrees, at which the rod slides by a hundredth of its
    radius."""
    rod = on_incline(friction)
    low, high = 0.0, 1.5
    while high - low > np.deg2rad(0.005):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if slid(rod, middle) > 0.01 else (middle, high)
    return high


class Capstan(NamedTuple):
    """A cable drawn around a bar.

    Attributes:
        turned: (n,) angle [rad] around the bar at each element, from where it first touches it.
        tension: (n,) [N].
        deepest: largest overlap with the bar, in radii of the cable.
    """

    turned: Array
    tension: Array
    deepest: float

    @property
    def ratio(self) -> float:
        """Of the tension at the pulling end to that at the other."""
        return float(self.tension[-1] / self.tension[0])

    @property
    def exponent(self) -> float:
        """The slope of log tension over angle where the cable lies on the bar."""
        wrapped = self.turned.max()
        on_bar = (self.turned > 0.1 * wrapped) & (self.turned < 0.9 * wrapped)
        return float(np.polyfit(self.turned[on_bar], np.log(self.tension[on_bar]), 1)[0])


def capstan(friction: float, angle: float) -> Capstan:
    """Wrap a cable around a bar by ``angle`` [rad], pull both its ends, then draw it along."""
    turn_radius = BAR_RADIUS + CABLE_RADIUS
    pitch = 3.0 * CABLE_RADIUS if angle > 4.0 else 0.0
    length = turn_radius * angle + 2.0 * TAIL
    n = max(160, round(160 * angle / (3.0 * np.pi)))
    s = np.linspace(-TAIL, length - TAIL, n + 1)
    turned = np.clip(s / turn_radius, 0.0, angle)
    along = np.column_stack([-np.sin(turned), 0.0 * turned, np.cos(turned)])
    curve = (s - turn_radius * turned)[:, None] * along + np.column_stack(
        [turn_radius * np.cos(turned), pitch * turned / (2 * np.pi), turn_radius * np.sin(turned)]
    )
    bar = Capsule.between([0.0, -0.1, 0.0], [0.0, 0.1, 0.0], BAR_RADIUS)
    properties = RodProperties(length, CABLE_RADIUS, youngs_modulus=1e7)
    rod = CosseratRod(properties, n, gravity=(0.0, 0.0, 0.0), obstacles=[bar], friction=friction)
    ends = [
        pose(frame_along(t, [0.0, 1.0, 0.0]), p)
        for t, p in zip(along[[0, -1]], curve[[0, -1]], strict=True)
    ]
    rod.settle(BoundaryPoses(*ends), curve)
    stretch = 1e-3 * length
    for pull, count in (((-stretch, stretch), 8), ((2.0 * stretch, 2.0 * stretch), 12)):
        twist = np.concatenate([pull[0] * along[0], np.zeros(3), pull[1] * along[-1], np.zeros(3)])
        for _ in range(count):
            state = rod.move(BoundaryDisplacement.from_vector(twist))
    assert state.contact is not None
    middles = 0.5 * (state.positions[:-1] + state.positions[1:])
    around = np.unwrap(np.arctan2(middles[:, 2], middles[:, 0]))
    return Capstan(
        np.clip(around, 0.0, angle),
        state.stress[:, 2],
        float(-state.contact.gaps.min() / CABLE_RADIUS),
    )


def incline_case() -> Case:
    rods = {friction: on_incline(friction) for friction in INCLINE_FRICTIONS}
    slopes = {friction: sliding_slope(friction) for friction in INCLINE_FRICTIONS}
    rows = [
        (
            f"{friction:g}",
            f"{np.degrees(np.arctan(friction)):.2f}",
            f"{np.degrees(slope):.2f}",
            f"{np.tan(slope) / friction - 1.0:.2%}",
        )
        for friction, slope in slopes.items()
    ]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="slope [deg]", ylabel="tip has slid [radii]")
        for friction, rod in rods.items():
            threshold = np.arctan(friction)
            tilts = np.sort(
                np.append(np.linspace(0.0, 0.95, 25), slopes[friction] + np.array([-2e-3, 2e-3]))
            )
            line = axes.semilogy(
                np.degrees(tilts), [max(slid(rod, tilt), 1e-6) for tilt in tilts], ".-", lw=0.8,
                label=f"μ = {friction:g}",
            )[0]  # fmt: skip
            axes.axvline(np.degrees(threshold), color=line.get_color(), lw=0.8, ls=":")
        axes.set_ylim(1e-6, 100.0)
        axes.legend(fontsize=8)

    return Case(("μ", "arctan μ [deg]", "slides from [deg]", "tan(slope) / μ - 1"), rows, draw)


def capstan_case() -> Case:
    angles = np.deg2rad(CAPSTAN_ANGLES)
    results = {
        friction: [capstan(friction, angle) for angle in angles] for friction in CAPSTAN_FRICTIONS
    }
    rows = []
    for friction, drawn in results.items():
        for degrees, angle, result in zip(CAPSTAN_ANGLES, angles, drawn, strict=True):
            expected = np.exp(friction * angle)
            cells = f"{friction:g}", f"{degrees}", f"{expected:.3f}", f"{result.ratio:.3f}"
            errors = result.ratio / expected - 1.0, result.exponent / friction - 1.0
            rows.append((*cells, *(f"{error:.2%}" for error in errors)))

    def draw(figure: Figure) -> None:
        ratios = figure.add_subplot(1, 2, 1, xlabel="wrapped [deg]", ylabel="T2 / T1")
        fine = np.linspace(0.0, angles[-1], 200)
        for friction, drawn in results.items():
            ratios.semilogy(np.degrees(fine), np.exp(friction * fine), lw=0.8, color="0.3")
            values = [result.ratio for result in drawn]
            ratios.semilogy(CAPSTAN_ANGLES, values, "o", ms=4, label=f"μ = {friction:g}")
        ratios.legend(fontsize=8)
        along = figure.add_subplot(1, 2, 2, xlabel="around the bar [deg]", ylabel="T / T1")
        for friction, drawn in results.items():
            result = drawn[-1]
            along.semilogy(np.degrees(fine), np.exp(friction * fine), lw=0.8, color="0.3")
            tension = result.tension / result.tension[0]
            along.semilogy(np.degrees(result.turned)[::6], tension[::6], ".", ms=4)

    header = (
        "μ",
        "wrapped [deg]",
        "exp(μ angle)",
        "T2 / T1",
        "error",
        "exponent on the bar",
    )
    return Case(header, rows, draw, (7.0, 3.2))
