"""Random rollouts of a rod: a random settled state and random actions (Section VI-A1)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DatasetError, RodDiverged
from dlo_gym.geometry.se3 import matrix_to_quaternion
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod

CLAMP_DISTANCE = (0.2, 0.98)  # of the rod's length, at the end of every action
LARGEST_SLOPE = np.deg2rad(60.0)  # of the chord between the clamps
LARGEST_TILT = np.deg2rad(100.0)  # between a clamp's d3 and the chord
LARGEST_JUMP = 0.08  # of a node in one step, per rod length: more means that the rod snapped over
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
        radius: of the rods [m].
        youngs_modulus: [Pa].
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
    radius: float = 0.003
    youngs_modulus: float = 1e6
    density: float = 1e3
    n_elements: int = 50
    shard_size: int = 50

    def __post_init__(self) -> None:
        for name in ("n_rollouts", "n_actions", "n_steps", "shard_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed: expected at least 0, got {self.seed}")
        if self.n_elements < 4:
            raise ValueError(f"n_elements: expected at least 4, got {self.n_elements}")
        if not 0.0 < self.length_min <= self.length_max:
            raise ValueError(
                "length_min, length_max: expected 0 < length_min <= length_max,"
                f" got {self.length_min} and {self.length_max}"
            )
        for name in ("translation", "rotation"):
            if not 0.0 <= getattr(self, name) < np.pi:
                raise ValueError(f"{name}: expected 0 to pi, got {getattr(self, name)}")
        self.properties(self.length_min)

    def properties(self, length: float) -> RodProperties:
        return RodProperties(length, self.radius, self.youngs_modulus, self.density)

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
        lengths: (R,) of the rods [m].
    """

    positions: Array32
    clamps: Array32
    lengths: Array32


def simulate_rollout(settings: RolloutSettings, index: int) -> Rollouts:
    """Rollout ``index``, with a leading axis of 1.

    Raises:
        DatasetError: if the settings leave no rollout that can be simulated.
    """
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(index,)))
    for _ in range(ATTEMPTS):
        length = rng.uniform(settings.length_min, settings.length_max)
        rod = CosseratRod(settings.properties(length), settings.n_elements)
        positions = np.empty((1, settings.n_states, rod.n_nodes, 3), np.float32)
        clamps = np.empty((1, settings.n_states, 2, 4), np.float32)
        try:
            _record(rod, rod.settle(random_boundary(rng, length)).boundary, 0, positions, clamps)
            for action in range(settings.n_actions):
                first = 1 + action * settings.n_steps
                _act(rod, settings, rng, first, positions, clamps)
        except RodDiverged:
            continue
        return Rollouts(positions, clamps, np.array([length], np.float32))
    raise DatasetError(
        f"rollout {index}: no rollout with these settings could be simulated in {ATTEMPTS} attempts"
    )


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
                    raise RodDiverged("the rod snapped over")
                before = state.positions
                _record(rod, state.boundary, i, positions, clamps)
        except (ValueError, RodDiverged):
            rod.restore(start)
            continue
        return
    raise RodDiverged(f"no action that the rod can follow in {ATTEMPTS} attempts")


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
