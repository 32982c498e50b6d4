"""The same random dual-arm motions in the rod, PyElastica and MuJoCo, settled, node by node."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.mujoco_flex_peer import MujocoFlexRod
from benchmarks.pyelastica_peer import PyElasticaRod
from benchmarks.validation.case import Case
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import BoundaryDisplacement, CosseratRod, RodProperties, RodState
from dlo_gym.rod.initial_shapes import random_boundary

MOTION_SECONDS, SECONDS = 0.5, 3.0
LARGEST_MOVE = np.tile([0.05] * 3 + [0.4] * 3, 2)  # of a clamp, per axis [m], [rad]
PAPER = RodProperties(0.5, radius=0.003, youngs_modulus=1e6, density=1e3)
# The same EI, GJ and weight, but 36 times the axial stiffness: as good as inextensible.
THIN = RodProperties(0.5, radius=0.0005, youngs_modulus=1e6 * 6**4, density=1e3 * 6**2)


class Motion(NamedTuple):
    """A motion of both clamps and the equilibria of the rod before and after it."""

    start: RodState
    displacement: BoundaryDisplacement
    end: RodState


def random_motion(seed: int, properties: RodProperties = PAPER, n: int = 50) -> Motion:
    """From random clamps by up to 5 cm and 0.4 rad per axis at each end."""
    rng = np.random.default_rng(seed)
    rod = CosseratRod(properties, n)
    start = rod.settle(random_boundary(rng, properties.length))
    while True:
        displacement = BoundaryDisplacement.from_vector(LARGEST_MOVE * rng.uniform(-1.0, 1.0, 12))
        if start.boundary.displaced(displacement).distance < 0.96 * properties.length:
            return Motion(start, displacement, rod.move(displacement))


class Settled(NamedTuple):
    """A peer's shape after the motion: nodes (n + 1, 3) [m] and the fastest node's speed [m/s]."""

    positions: Array
    speed: float

    def distances(self, motion: Motion) -> Array:
        """(n + 1,) of the nodes from the rod's [m]."""
        return np.linalg.norm(self.positions - motion.end.positions, axis=1)


def settle_peer(
    peer: type[PyElasticaRod] | type[MujocoFlexRod], properties: RodProperties, motion: Motion
) -> Settled:
    rod = peer(properties, motion.start, motion.displacement, duration=MOTION_SECONDS)
    rod.advance(SECONDS)
    return Settled(rod.positions, rod.speed)


def engines_case(seeds: range = range(10)) -> Case:
    rows, all_distances = [], []
    shown = None
    for seed in seeds:
        motion, thin = random_motion(seed), random_motion(seed, THIN, 100)
        elastica = settle_peer(PyElasticaRod, PAPER, motion)
        flex = settle_peer(MujocoFlexRod, PAPER, motion)
        thin_flex = settle_peer(MujocoFlexRod, THIN, thin)
        moved = np.linalg.norm(motion.end.positions - motion.start.positions, axis=1).max()
        distances = [elastica.distances(motion), flex.distances(motion), thin_flex.distances(thin)]
        all_distances.append([[1e3 * d.mean(), 1e3 * d.max()] for d in distances])
        cells = [f"{mean:.2f} / {largest:.2f}" for mean, largest in all_distances[-1]]
        rows.append((f"{seed}", f"{1e3 * moved:.0f}", *cells))
        shown = shown or (motion, elastica, flex)
    mean, largest = np.mean(all_distances, axis=0)[:, 0], np.max(all_distances, axis=0)[:, 1]
    cells = [f"{a:.2f} / {b:.2f}" for a, b in zip(mean, largest, strict=True)]
    rows.append(("mean / largest", "", *cells))

    def draw(figure: Figure) -> None:
        assert shown is not None
        motion, elastica, flex = shown
        for column, (i, j) in enumerate(((0, 2), (1, 2))):
            axes = figure.add_subplot(1, 2, 1 + column, aspect="equal")
            axes.set(xlabel="xyz"[i] + " [m]", ylabel="xyz"[j] + " [m]")
            start, end = motion.start.positions, motion.end.positions
            axes.plot(start[:, i], start[:, j], color="0.7", lw=1.0, label="before")
            axes.plot(end[:, i], end[:, j], color="0.2", lw=1.0, label="rod")
            points = elastica.positions[::3]
            axes.plot(points[:, i], points[:, j], "o", ms=3, label="PyElastica")
            points = flex.positions[1::3]
            axes.plot(points[:, i], points[:, j], "x", ms=4, label="MuJoCo flex")
        axes.legend(fontsize=8)

    header = (
        "motion", "largest move [mm]", "PyElastica, mean / max [mm]",
        "MuJoCo flex, 50 edges", "MuJoCo flex, 100 edges, inextensible",
    )  # fmt: skip
    return Case(header, rows, draw, (7.0, 3.0))
