"""Random rollouts of a rod: a random settled state and random actions (Section VI-A1)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DatasetError, RodDiverged
from dlo_gym.geometry.se3 import Array, matrix_to_quaternion
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod

CLAMP_DISTANCE = (0.2, 0.98)  # of the rod's length, at the end of every action
LARGEST_SLOPE = np.deg2rad(60.0)  # of the chord between the clamps
LARGEST_TILT = np.deg2rad(100.0)  # between a clamp's d3 and the chord
LARGEST_JUMP = 0.08  # of a node in one step, per rod length: more means that the rod snapped over
# RodProperties, one row per rod, in SI units.
ROD_COLUMNS = (
    "length", "radius", "youngs_modulus", "density", "poisson_ratio",
    "rest_curvature_1", "rest_curvature_2", "rest_twist",
)  # fmt: skip
ATTEMPTS = 100  # at an action before its rollout starts anew; at a rollout before giving up

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class RolloutSettings:
    """What is simulated.

    Attributes:
        n_rollouts: number of rollouts.
        seed: of all random choices.
        length_min: shortest rod [m].
        length_max: longest rod [m].
        n_actions: random actions per rollout, one after the other.
        n_steps: steps that each action is divided into.
        translation: largest component of an action's translation of each clamp [m].
        rotation: largest rotation about each of a clamp's two transverse axes per action [rad].
        radius_min, radius_max: of the rods, log-uniform [m].
        youngs_modulus_min, youngs_modulus_max: log-uniform [Pa].
        poisson_ratio_min, poisson_ratio_max: uniform.
        rest_curvature_max: of the unloaded rods, about d1 and d2 together, uniform in every second
            rod; the others are straight [1/m].
        density: [kg/m^3].
        n_elements: of the rods; the states have one node more.
        shard_size: rollouts per file.

    Raises:
        ValueError: naming the field.
    """

    n_rollouts: int = 2500
    seed: int = 0
    length_min: float = 0.45
    length_max: float = 0.6
    n_actions: int = 5
    n_steps: int = 10
    translation: float = 0.05
    rotation: float = np.pi / 8
    radius_min: float = 0.003
    radius_max: float = 0.003
    youngs_modulus_min: float = 1e6
    youngs_modulus_max: float = 1e6
    poisson_ratio_min: float = 0.5
    poisson_ratio_max: float = 0.5
    rest_curvature_max: float = 0.0
    density: float = 1e3
    n_elements: int = 50
    shard_size: int = 50

    def __post_init__(self) -> None:
        for name, least in (
            ("n_rollouts", 1), ("n_actions", 1), ("n_steps", 1), ("shard_size", 1), ("seed", 0),
            ("n_elements", 4),
        ):  # fmt: skip
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name}: expected an integer of at least {least}, got {value!r}")
        for name, above in (
            ("length", 0.0), ("radius", 0.0), ("youngs_modulus", 0.0), ("poisson_ratio", -1.0),
        ):  # fmt: skip
            low, high = getattr(self, f"{name}_min"), getattr(self, f"{name}_max")
            if not above < low <= high < np.inf:
                raise ValueError(
                    f"{name}_min, {name}_max: expected {above:g} < {name}_min <= {name}_max,"
                    f" got {low} and {high}"
                )
        if not 0.0 <= self.rest_curvature_max < np.inf:
            raise ValueError(
                f"rest_curvature_max: expected 0 or more, got {self.rest_curvature_max}"
            )
        shortest = self.length_min / self.n_elements
        if self.radius_max > shortest:
            raise ValueError(
                f"radius_max: expected at most the length of the shortest rod's elements,"
                f" length_min / n_elements = {shortest:.4g} m, got {self.radius_max:.4g} m"
            )
        for name in ("translation", "rotation"):
            if not 0.0 <= getattr(self, name) < np.pi:
                raise ValueError(f"{name}: expected 0 to pi, got {getattr(self, name)}")
        RodProperties(1.0, density=self.density, poisson_ratio=self.poisson_ratio_max)

    def draw_rod(self, length: float, rng: np.random.Generator) -> RodProperties:
        """A random rod of ``length`` [m]; always the same number of draws."""
        radius, youngs_modulus = (
            float(np.exp(rng.uniform(np.log(low), np.log(high))))
            for low, high in (
                (self.radius_min, self.radius_max),
                (self.youngs_modulus_min, self.youngs_modulus_max),
            )
        )
        poisson_ratio = rng.uniform(self.poisson_ratio_min, self.poisson_ratio_max)
        curved, share, direction = rng.uniform(size=3)
        bend = self.rest_curvature_max * share if curved < 0.5 else 0.0
        angle = 2.0 * np.pi * direction
        return RodProperties(
            length,
            radius,
            youngs_modulus,
            self.density,
            poisson_ratio,
            (bend * np.cos(angle), bend * np.sin(angle), 0.0),
        )

    @property
    def n_states(self) -> int:
        return self.n_actions * self.n_steps + 1

    @property
    def n_shards(self) -> int:
        return -(-self.n_rollouts // self.shard_size)

    def shard_indices(self, shard: int) -> range:
        """The rollouts in a shard."""
        start = shard * self.shard_size
        return range(start, min(start + self.shard_size, self.n_rollouts))


class Rollouts(NamedTuple):
    """R rollouts of S states of rods with n nodes.

    Attributes:
        positions: (R, S, n, 3) centerlines in world [m].
        clamps: (R, S, 2, 4) wxyz of R_world_clamp, left and right; the clamps' origins are the
            first and last node.
        rods: (R, 8) what each is made of, in the order of ``ROD_COLUMNS``.
    """

    positions: Array32
    clamps: Array32
    rods: Array

    @classmethod
    def joined(cls, parts: Iterable["Rollouts"]) -> "Rollouts":
        positions, clamps, rods = zip(*parts, strict=True)
        return cls(np.concatenate(positions), np.concatenate(clamps), np.concatenate(rods))

    def some(self, which: slice) -> "Rollouts":
        """The rollouts ``which``."""
        return Rollouts(self.positions[which], self.clamps[which], self.rods[which])

    @property
    def lengths(self) -> Array:
        """(R,) of the rods [m]."""
        return self.rods[:, 0]

    def properties(self, index: int) -> RodProperties:
        """Of the rod of rollout ``index``."""
        *scalars, k1, k2, twist = (float(value) for value in self.rods[index])
        return RodProperties(*scalars, rest_curvature=(k1, k2, twist))


def simulate_rollout(settings: RolloutSettings, index: int) -> Rollouts:
    """Rollout ``index``, with a leading axis of 1.

    The rod's material is drawn from a stream of its own, so that with the same seed rods of other
    materials start alike and are asked to make the same moves.

    Raises:
        DatasetError: if the settings leave no rollout that can be simulated.
    """
    rng, material = (
        np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=key))
        for key in ((index,), (index, 0))
    )
    for _ in range(ATTEMPTS):
        length = rng.uniform(settings.length_min, settings.length_max)
        properties = settings.draw_rod(length, material)
        rod = CosseratRod(properties, settings.n_elements)
        positions = np.empty((1, settings.n_states, rod.n_nodes, 3), np.float32)
        clamps = np.empty((1, settings.n_states, 2, 4), np.float32)
        try:
            _record(rod, rod.settle(random_boundary(rng, length)).boundary, 0, positions, clamps)
            for action in range(settings.n_actions):
                first = 1 + action * settings.n_steps
                _act(rod, settings, rng, first, positions, clamps)
        except RodDiverged:
            continue
        return Rollouts(positions, clamps, _row(properties)[None])
    raise DatasetError(
        f"rollout {index}: no rollout with these settings could be simulated in {ATTEMPTS} attempts"
    )


def _row(properties: RodProperties) -> Array:
    """A uniform rod as (8,), in the order of ``ROD_COLUMNS``."""
    p = properties
    scalars = [p.length, p.radius, p.youngs_modulus, p.density, p.poisson_ratio]
    return np.array([*scalars, *np.asarray(p.rest_curvature)], dtype=np.float64)


def _act(
    rod: CosseratRod,
    settings: RolloutSettings,
    rng: np.random.Generator,
    first: int,
    positions: Array32,
    clamps: Array32,
) -> None:
    """Applies one random action that the rod can follow and records its states from ``first``."""
    start = rod.state
    for _ in range(ATTEMPTS):
        action = random_action(rng, start.boundary, settings.translation, settings.rotation)
        if not plausible(start.boundary.displaced(action), rod.properties.length):
            continue
        step = action.scaled(1.0 / settings.n_steps)
        try:
            before = start.positions
            for i in range(first, first + settings.n_steps):
                state = rod.move(step)
                if np.abs(state.positions - before).max() > LARGEST_JUMP * rod.properties.length:
                    raise RodDiverged("the rod snapped over", last_good=start)
                before = state.positions
                _record(rod, state.boundary, i, positions, clamps)
        except (ValueError, RodDiverged):
            rod.restore(start)
            continue
        return
    raise RodDiverged(f"no action that the rod can follow in {ATTEMPTS} attempts", last_good=start)


def _record(
    rod: CosseratRod, boundary: BoundaryPoses, i: int, positions: Array32, clamps: Array32
) -> None:
    assert boundary.right is not None
    positions[0, i] = rod.state.positions
    clamps[0, i] = matrix_to_quaternion([boundary.left[:3, :3], boundary.right[:3, :3]])


def random_action(
    rng: np.random.Generator, boundary: BoundaryPoses, translation: float, rotation: float
) -> BoundaryDisplacement:
    """A displacement with uniform components: translation [m] along the world's axes, rotation
    [rad] about d1 and d2 of each clamp and none about the rod's own axis."""
    assert boundary.right is not None
    parts = []
    for clamp in (boundary.left, boundary.right):
        shift = rng.uniform(-translation, translation, 3)
        parts += [shift, clamp[:3, :2] @ rng.uniform(-rotation, rotation, 2)]
    return BoundaryDisplacement.from_vector(np.concatenate(parts))


def plausible(boundary: BoundaryPoses, length: float) -> bool:
    """Whether two arms would hold a cable of ``length`` [m] so: not nearly taut nor with the
    grippers touching, the chord not near the vertical, no clamp turned back on the rod."""
    assert boundary.right is not None
    chord = boundary.right[:3, 3] - boundary.left[:3, 3]
    distance = boundary.distance
    if not CLAMP_DISTANCE[0] * length <= distance <= CLAMP_DISTANCE[1] * length:
        return False
    along = np.array([boundary.left[:3, 2], boundary.right[:3, 2]]) @ chord / distance
    return bool(
        abs(chord[2]) <= np.sin(LARGEST_SLOPE) * distance and (along >= np.cos(LARGEST_TILT)).all()
    )
