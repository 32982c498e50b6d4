"""Rollouts: rods moved by random actions, simulated to disk for training (Section VI-A1).

A dataset is a folder:

    manifest.json     schema, settings, and the sha256 of every finished shard
    shard_0000.npz    positions, clamps, lengths of ``shard_size`` rollouts, without pickle

Rollout i is made from its own child of the seed, so that the data depend neither on the number of
workers nor on where a run was interrupted. Shards and manifest are written aside and renamed; a
shard that the manifest does not vouch for is made again.
"""

import hashlib
import json
import multiprocessing
import os
import signal
import threading
import zipfile
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dlo_gym.exceptions import DatasetError, RodDiverged
from dlo_gym.geometry.se3 import matrix_to_quaternion
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod

SCHEMA = "dlo-rollouts/1"
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


class Manifest(NamedTuple):
    """Attributes: ``settings``, and per finished shard's file name its sha256."""

    settings: RolloutSettings
    shards: dict[str, str]

    @property
    def data_hash(self) -> str:
        """sha256 over all shards' hashes: names the data."""
        joined = "".join(f"{name}:{self.shards[name]}\n" for name in sorted(self.shards))
        return hashlib.sha256(joined.encode()).hexdigest()

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Raises: DatasetError if there is none, or it is damaged or of another schema."""
        file = folder / "manifest.json"
        try:
            content = json.loads(file.read_text())
            if content["schema"] != SCHEMA:
                raise DatasetError(f"{file}: expected schema {SCHEMA}, got {content['schema']}")
            return cls(RolloutSettings(**content["settings"]), dict(content["shards"]))
        except FileNotFoundError:
            raise DatasetError(f"{folder}: no manifest.json, so this is not a dataset") from None
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{file}: damaged: {error!r}") from error

    def write(self, folder: Path) -> None:
        content = {
            "schema": SCHEMA,
            "settings": asdict(self.settings),
            "complete": len(self.shards) == self.settings.n_shards,
            "shards": dict(sorted(self.shards.items())),
        }
        with _written_aside(folder / "manifest.json") as part:
            part.write_text(json.dumps(content, indent=1) + "\n")


def load_rollouts(folder: Path) -> tuple[Rollouts, Manifest]:
    """All rollouts of a finished dataset, checked against the manifest.

    Raises:
        DatasetError: naming the shards that are missing or damaged.
    """
    manifest = Manifest.read(folder)
    bad = _unusable_shards(folder, manifest)
    if bad:
        raise DatasetError(
            f"{folder}: missing or damaged: {', '.join(bad)}; make them with: dlo rollouts"
            f" {folder} --resume and the settings in its manifest.json"
        )
    shards = [_read_shard(folder / shard_name(i)) for i in range(manifest.settings.n_shards)]
    return Rollouts(*(np.concatenate(parts) for parts in zip(*shards, strict=True))), manifest


def shard_name(shard: int) -> str:
    return f"shard_{shard:04d}.npz"


def _read_shard(file: Path) -> Rollouts:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return Rollouts(*(arrays[name] for name in Rollouts._fields))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{file}: damaged: {error}") from error


def _unusable_shards(folder: Path, manifest: Manifest) -> list[str]:
    """Names of the shards that are absent or differ from what the manifest vouches for."""
    names = [shard_name(shard) for shard in range(manifest.settings.n_shards)]
    return [name for name in names if _sha256(folder / name) != manifest.shards.get(name, "none")]


@contextmanager
def _written_aside(file: Path) -> Iterator[Path]:
    """A temporary file that takes the name ``file`` when it is whole.

    Raises:
        DatasetError: if it cannot be written, for example on a full disk; nothing is left behind.
    """
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        yield part
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(part, file)
    except OSError as error:
        raise DatasetError(
            f"{file}: could not be written: {error.strerror or error}; what was finished is kept"
            " and --resume goes on from it"
        ) from error
    finally:
        part.unlink(missing_ok=True)


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def _make_shard(settings: RolloutSettings, folder: Path, shard: int) -> tuple[str, str]:
    """Simulates and writes a shard; its name and sha256."""
    made = [simulate_rollout(settings, index) for index in settings.shard_indices(shard)]
    arrays = Rollouts(*(np.concatenate(parts) for parts in zip(*made, strict=True)))
    with _written_aside(folder / shard_name(shard)) as part:
        with part.open("wb") as file:
            np.savez(file, **arrays._asdict())
        digest = _sha256(part)
    return shard_name(shard), digest


def rollouts(
    out: tyro.conf.Positional[Path],
    /,
    settings: tyro.conf.OmitArgPrefixes[RolloutSettings] = RolloutSettings(),
    *,
    workers: int = 0,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Simulate rollouts of a Cosserat rod under random actions, the surrogate's training data.

    Args:
        out: folder to write.
        settings: what is simulated.
        workers: processes; 0 for one per core.
        resume: finish a dataset that was interrupted, and make damaged shards again.
        overwrite: throw away the dataset in OUT.

    Raises:
        FileExistsError: if OUT holds something and neither resume nor overwrite was given.
        DatasetError: if a file cannot be written.
        ValueError: if OUT holds a dataset of other settings.
    """
    console = Console(stderr=True)
    manifest = _open_dataset(out, settings, resume, overwrite)
    missing = _unusable_shards(out, manifest)
    damaged = [name for name in missing if name in manifest.shards]
    if damaged:
        console.print(f"missing or damaged, made again: {', '.join(damaged)}", style="yellow")
        manifest = Manifest(
            settings, {k: v for k, v in manifest.shards.items() if k not in damaged}
        )
    manifest.write(out)
    shards = [shard for shard in range(settings.n_shards) if shard_name(shard) in missing]
    columns = (TextColumn("rollouts"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        done = settings.n_rollouts - sum(len(settings.shard_indices(i)) for i in shards)
        task = progress.add_task("", total=settings.n_rollouts, completed=done)
        for name, digest in _make_shards(settings, out, shards, workers or os.cpu_count() or 1):
            manifest.shards[name] = digest
            manifest.write(out)
            progress.advance(task, len(settings.shard_indices(int(name[6:-4]))))
    console.print(f"{settings.n_rollouts} rollouts in {out}", highlight=False)


def _open_dataset(out: Path, settings: RolloutSettings, resume: bool, overwrite: bool) -> Manifest:
    """The manifest to go on from, in a folder that exists."""
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"{out} is a file; name a folder")
    if not out.exists() or not any(out.iterdir()):
        out.mkdir(parents=True, exist_ok=True)
        return Manifest(settings, {})
    if not (resume or overwrite):
        raise FileExistsError(
            f"{out} exists; pass --overwrite to replace it or --resume to finish it"
        )
    ours = [*out.glob("shard_*.npz*"), *out.glob("manifest.json*")]
    if overwrite:
        if len(ours) < len(list(out.iterdir())):
            raise FileExistsError(f"{out} holds other files than a dataset; name another folder")
        for file in ours:
            file.unlink()
        return Manifest(settings, {})
    for file in ours:
        if file.name.endswith(".part"):
            file.unlink()
    if not (out / "manifest.json").exists() and not list(out.iterdir()):
        return Manifest(settings, {})  # killed before it wrote anything
    manifest = Manifest.read(out)
    for name, value in asdict(settings).items():
        if getattr(manifest.settings, name) != value:
            raise ValueError(
                f"{name}: {out} was made with {getattr(manifest.settings, name)}, got {value};"
                " resume with the same settings"
            )
    return manifest


def _make_shards(
    settings: RolloutSettings, folder: Path, shards: list[int], workers: int
) -> Iterator[tuple[str, str]]:
    """Names and hashes of shards as they are finished."""
    if workers == 1 or len(shards) < 2:
        for shard in shards:
            yield _make_shard(settings, folder, shard)
        return
    context = multiprocessing.get_context("spawn")
    with (
        _one_thread_each(),
        ProcessPoolExecutor(min(workers, len(shards)), context, _start_worker) as pool,
    ):
        futures: list[Future[Any]] = [
            pool.submit(_make_shard, settings, folder, shard) for shard in shards
        ]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one BLAS thread: they already are one per core."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker() -> None:
    """Ctrl-C is the parent's business, and a worker does not outlive a parent that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
