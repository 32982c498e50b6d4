"""Rollouts on disk: the surrogate's training data (Section VI-A1).

A dataset is a folder:

    manifest.json     schema, settings, and the sha256 of every finished shard
    shard_0000.npz    positions, clamps, rods of ``shard_size`` rollouts, without pickle

Rollout i is made from its own child of the seed, so that the data depend neither on who works at
them, processes or a Ray cluster, nor on where a run was interrupted. Shards and manifest are
written aside and renamed; a shard that the manifest does not vouch for is made again.
"""

import hashlib
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DatasetError
from dlo_gym.executor import run_tasks
from dlo_gym.output_folder import check_resume
from dlo_gym.surrogate.simulation import Rollouts, RolloutSettings, simulate_rollout

SCHEMA = "dlo-rollouts/2"
THE_PAPER = RolloutSettings()  # Section VI-A1


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
                raise DatasetError(
                    f"{file}: expected schema {SCHEMA}, got {content['schema']}; make the data"
                    " again by  dlo rollouts --overwrite"
                )
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
        with written_aside(folder / "manifest.json", DatasetError) as part:
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
    return Rollouts.joined(shards), manifest


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


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def simulate_shard(settings: RolloutSettings, shard: int) -> Rollouts:
    """The rollouts of a shard."""
    return Rollouts.joined(
        simulate_rollout(settings, index) for index in settings.shard_indices(shard)
    )


def _write_shard(folder: Path, shard: int, arrays: Rollouts) -> str:
    """Writes a shard; its sha256."""
    with written_aside(folder / shard_name(shard), DatasetError) as part:
        with part.open("wb") as file:
            np.savez(file, **arrays._asdict())
        return _sha256(part)


def rollouts(
    out: tyro.conf.Positional[Path],
    /,
    settings: tyro.conf.OmitArgPrefixes[RolloutSettings] = THE_PAPER,
    *,
    workers: int = 0,
    ray_address: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Simulate rollouts of a Cosserat rod under random actions, the surrogate's training data.

    Args:
        out: folder to write.
        settings: what is simulated.
        workers: processes; 0 for one per core.
        ray_address: simulate on the Ray cluster there, host:port, instead of on this machine's
            cores; "local" starts one here. Needs  pip install 'dlo-gym[scale]'.
        resume: finish a dataset that was interrupted, and make damaged shards again.
        overwrite: throw away the dataset in OUT.

    Raises:
        FileExistsError: if OUT holds something and neither resume nor overwrite was given.
        DatasetError: if a file cannot be written; what was finished is kept for --resume.
        WorkersLost: if processes were killed again and again; likewise.
        ValueError: if OUT holds a dataset of other settings, or on conflicting options.
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
        tasks = [(settings, shard) for shard in shards]
        for i, made in run_tasks(simulate_shard, tasks, workers=workers, ray_address=ray_address):
            manifest.shards[shard_name(shards[i])] = _write_shard(out, shards[i], made)
            manifest.write(out)
            progress.advance(task, len(made.rods))
    console.print(f"{settings.n_rollouts} rollouts in {out}", highlight=False, markup=False)


def _open_dataset(out: Path, settings: RolloutSettings, resume: bool, overwrite: bool) -> Manifest:
    """The manifest to go on from, in a folder that exists."""
    check_resume(resume=resume, overwrite=overwrite)
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
