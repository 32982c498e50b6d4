"""Vibration, waves, energy and the order in time; moving clamps beside PyElastica and MuJoCo."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.special import j0

from benchmarks.mujoco_flex_peer import MujocoFlexRod
from benchmarks.pyelastica_peer import PyElasticaRod
from benchmarks.validation.case import COMPARISON, Case, compare, order
from benchmarks.validation.engines import PAPER, THIN, random_motion
from benchmarks.validation.statics import LENGTH, WEIGHTLESS
from dlo_gym.geometry.se3 import Array, exp_so3, frame_along, matrix_to_quaternion, pose
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, CosseratRod, RodProperties, RodState
from dlo_gym.rod.initial_shapes import random_boundary

LEVEL = BoundaryPoses(pose(frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), np.zeros(3)))
DOWN = BoundaryPoses(pose(frame_along([0.0, 0.0, -1.0], [0.0, 1.0, 0.0]), np.zeros(3)))
ONE_STILL, BOTH_STILL = BoundaryDisplacement(np.zeros(6)), BoundaryDisplacement.zero()
CANTILEVER_ROOTS = (1.8751040687, 4.6940911330)  # of 1 + cos(b) cosh(b)
CHAIN_ROOT = 2.4048255577  # of J0
MASS_DAMPING = 5.0  # [1/s] in all three engines


def period_of(signal: Array, dt: float) -> float:
    """Mean period [s] of a signal that oscillates about zero."""
    before = np.flatnonzero(signal[1:] * signal[:-1] < 0.0)
    crossings = before + signal[before] / (signal[before] - signal[before + 1])
    return 2.0 * dt * float(np.diff(crossings).mean())


def record(rod: CosseratRod, read: Callable[[RodState], float], dt: float, steps: int) -> Array:
    """(steps,) of what ``read`` finds after every ``dt`` [s], the clamp at rest."""
    return np.array([read(rod.advance(ONE_STILL, dt, dt=dt)) for _ in range(steps)])


def cantilever_mode(mode: int, s: Array) -> Array:
    """The cantilever's mode shape at s = 0 (clamp) to 1."""
    b = CANTILEVER_ROOTS[mode]
    ratio = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
    return np.cosh(b * s) - np.cos(b * s) - ratio * (np.sinh(b * s) - np.sin(b * s))


def bending_period(mode: int, n: int = 40) -> tuple[float, float]:
    """Euler and Bernoulli's period of a cantilever's mode and the rod's [s]."""
    properties = RodProperties(LENGTH, radius=0.001, youngs_modulus=1e8)
    root = CANTILEVER_ROOTS[mode]
    stiffness = properties.bending_stiffness / properties.linear_density
    exact = 2.0 * np.pi / (root**2 * np.sqrt(stiffness) / LENGTH**2)
    shape = cantilever_mode(mode, np.linspace(0.0, 1.0, n + 1))
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    state = rod.settle(LEVEL)
    # Set off from rest at the speed of a swing of 0.2 % of the length.
    speed = 2e-3 * LENGTH * 2.0 * np.pi / exact * shape / np.abs(shape).max()
    rod.restore(replace(state, velocities=speed[:, None] * [0.0, 0.0, 1.0]))
    signal = record(rod, lambda state: float(shape @ state.positions[:, 2]), exact / 100.0, 300)
    return exact, period_of(signal, exact / 100.0)


def twist_period(n: int = 40) -> tuple[float, float]:
    """A clamped-free rod's first torsional period, 4 L / sqrt(G / rho), and the rod's [s]."""
    properties = RodProperties(LENGTH, radius=0.005, youngs_modulus=1e7)
    spin = 0.5 * properties.linear_density * properties.radius**2
    exact = 4.0 * LENGTH / np.sqrt(properties.twisting_stiffness / spin)
    rod = CosseratRod(properties, n, gravity=WEIGHTLESS, clamp="node")
    state = rod.settle(LEVEL)
    angle = 0.05 * np.sin(0.5 * np.pi * (np.arange(n) + 0.5) / n)
    turned = state.directors @ exp_so3(angle[:, None] * [0.0, 0.0, 1.0])
    rod.restore(replace(state, quaternions=matrix_to_quaternion(turned)))
    signal = record(rod, lambda state: state.angular_velocities[-1, 2], exact / 100.0, 300)
    return exact, period_of(signal, exact / 100.0)


def chain_period(n: int = 40) -> tuple[float, float]:
    """The heavy chain's first period (Bernoulli) and that of a rod of hardly any stiffness [s]."""
    exact = 2.0 * np.pi / (0.5 * CHAIN_ROOT * np.sqrt(9.81 / LENGTH))
    rod = CosseratRod(RodProperties(LENGTH, radius=5e-5, youngs_modulus=1e7), n, clamp="node")
    mode = j0(CHAIN_ROOT * np.sqrt(1.0 - np.linspace(0.0, 1.0, n + 1)))
    state = rod.settle(DOWN)
    rod.restore(replace(state, velocities=1e-3 * mode[:, None] * [1.0, 0.0, 0.0]))
    signal = record(rod, lambda state: float(mode @ state.positions[:, 0]), 0.01, 600)
    return exact, period_of(signal, 0.01)


def swinging(seed: int = 0, properties: RodProperties = PAPER, n: int = 30) -> CosseratRod:
    """A rod between two still clamps, let go from an equilibrium under a sideways load."""
    rng = np.random.default_rng(seed)
    rod = CosseratRod(properties, n)
    forces = np.zeros((n + 1, 3))
    weight = 9.81 * properties.linear_density * properties.length
    forces[1:-1] = weight / n * rng.normal(size=3)
    rod.apply_forces(forces)
    rod.settle(random_boundary(rng, properties.length))
    rod.apply_forces(np.zeros_like(forces))
    rod.restore(rod.state)  # its energy without the loads
    return rod


def energies(dt: float, method: int, seconds: float = 2.0) -> Array:
    """(steps + 1,) of the swinging rod's energy, 1 at the start, 0 at rest."""
    rod = swinging()
    first = rod.state
    rest = CosseratRod(PAPER, rod.n_elements).settle(first.boundary, first.positions).energy
    found = [first.energy]
    for _ in range(round(seconds / dt)):
        state = rod.advance(BOTH_STILL, dt, dt=dt, order=method)  # type: ignore[arg-type]
        found.append(state.energy + state.kinetic_energy)
    return (np.array(found) - rest) / (first.energy - rest)


def errors_in_dt(counts: tuple[int, ...], method: int) -> list[float]:
    """Of node positions [m] after 0.2 s of swinging, in so many steps."""
    rod = swinging()
    start = rod.state

    def positions(steps: int, method: int) -> Array:
        rod.restore(start)
        after = rod.advance(BOTH_STILL, 0.2, dt=0.2 / steps, order=method)  # type: ignore[arg-type]
        return after.positions

    exact = positions(8 * counts[-1], 2)
    return [float(np.linalg.norm(positions(n, method) - exact, axis=1).max()) for n in counts]


def trajectories(
    seed: int, thin: bool, seconds: float = 0.8, moving: float = 0.25, every: float = 0.01
) -> tuple[Array, Array, Array]:
    """The rod and a peer through the same motion of the clamps, and on: (n_samples, n_nodes, 3)
    [m] each, and the rod's equilibria between the same clamps.

    The peer is MuJoCo's inextensible rod beside a ``thin`` one of 100 elements, else PyElastica's.
    """
    properties = replace(THIN if thin else PAPER, external_damping=MASS_DAMPING)
    motion = random_motion(seed, properties, 100 if thin else 50)
    peer = (MujocoFlexRod if thin else PyElasticaRod)(
        properties, motion.start, motion.displacement, duration=moving, damping=MASS_DAMPING,
        **({"time_step": 5e-4} if thin else {}),
    )  # fmt: skip
    rod = CosseratRod(properties, motion.start.n_nodes - 1)
    still = CosseratRod(properties, motion.start.n_nodes - 1)
    rod.restore(motion.start)
    still.restore(motion.start)
    ours, theirs, at_rest = [], [], []
    for sample in range(1, round(seconds / every) + 1):
        in_motion = sample <= round(moving / every)
        step = motion.displacement.scaled(every / moving) if in_motion else BOTH_STILL
        ours.append(rod.advance(step, every, dt=0.002).positions)
        at_rest.append(still.move(step).positions)
        peer.advance(every)
        theirs.append(peer.positions)
    return np.array(ours), np.array(theirs), np.array(at_rest)


def waves_case() -> Case:
    periods = (
        ("cantilever, first bending mode", bending_period(0)),
        ("cantilever, second bending mode", bending_period(1)),
        ("clamped and free, first torsional mode", twist_period()),
        ("hanging chain, first mode", chain_period()),
    )
    rows = [compare(name, 1e3 * exact, 1e3 * ours, "ms") for name, (exact, ours) in periods]
    return Case(("period, 40 elements", *COMPARISON[1:]), rows)


def time_steps_case() -> Case:
    counts = (20, 40, 80, 160)
    errors = {method: errors_in_dt(counts, method) for method in (1, 2)}
    rows = [
        (f"{200.0 / n:g}", f"{1e3 * errors[1][i]:.3f}", f"{1e3 * errors[2][i]:.4f}")
        for i, n in enumerate(counts)
    ]
    rows.append(("measured order", *(f"{order(counts[1:], errors[m][1:]):.2f}" for m in (1, 2))))
    curves = {
        f"order {method}, {1e3 * dt:g} ms": energies(dt, method)
        for method, dt in ((2, 0.002), (2, 0.005), (2, 0.02), (1, 0.005))
    }

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="time [s]", ylabel="energy above rest")
        for name, energy in curves.items():
            axes.plot(np.linspace(0.0, 2.0, len(energy)), energy, lw=1.2, label=name)
        axes.set_ylim(0.0, 1.05)
        axes.legend(fontsize=8)

    return Case(("time step [ms]", "Euler, error [mm]", "TR-BDF2, error [mm]"), rows, draw)


def moving_clamps_case(seeds: range = range(5)) -> Case:
    rows, shown = [], None
    figures: list[list[float]] = []
    for seed in seeds:
        line: list[float] = []
        for thin in (False, True):
            ours, theirs, at_rest = trajectories(seed, thin)
            distances = 1e3 * np.linalg.norm(ours - theirs, axis=2)
            line += [distances.mean(), distances.max()]
            if not thin:
                away = 1e3 * np.linalg.norm(theirs - at_rest, axis=2).max()
                shown = shown or (ours, theirs, at_rest)
        figures.append(line)
        cells = [f"{a:.2f} / {b:.2f}" for a, b in (line[:2], line[2:])]
        rows.append((f"{seed}", f"{away:.0f}", *cells))
    mean, largest = np.mean(figures, axis=0), np.max(figures, axis=0)
    cells = [f"{mean[i]:.2f} / {largest[i + 1]:.2f}" for i in (0, 2)]
    rows.append(("mean / largest", "", *cells))

    def draw(figure: Figure) -> None:
        assert shown is not None
        axes = figure.add_subplot(xlabel="time [s]", ylabel="middle node [m]")
        ours, theirs, at_rest = (each[:, each.shape[1] // 2] for each in shown)
        time = 0.01 * np.arange(1, len(ours) + 1)
        for k, colour in enumerate(("C0", "C1", "C2")):
            axes.plot(time, at_rest[:, k] - at_rest[0, k], ":", color=colour, lw=1.0)
            axes.plot(time, ours[:, k] - at_rest[0, k], color=colour, lw=1.2, label="xyz"[k])
            axes.plot(time[::2], theirs[::2, k] - at_rest[0, k], ".", color=colour)
        axes.legend(fontsize=8)

    header = (
        "motion", "farthest from equilibrium [mm]", "PyElastica, mean / max [mm]",
        "MuJoCo flex, 100 edges, inextensible",
    )  # fmt: skip
    return Case(header, rows, draw, (6.0, 2.8))
