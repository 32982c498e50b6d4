"""The folder of an RL training: its settings and the newest checkpoint."""

import json
import os
import shutil
import warnings
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import gymnasium as gym
from stable_baselines3 import SAC

from control.evaluate import write_metrics
from dlo_gym.exceptions import DloError
from dlo_gym.output_folder import check_output_folder, check_resume

FORMAT = "dlo-gym checkpoint 1"
# What reading a model or a pickle raises that is damaged, or whose classes have changed since.
UNREADABLE = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, UnpicklingError,
    AttributeError, ImportError, TypeError, AssertionError,
)  # fmt: skip
# What a training leaves in its folder.
MADE = (
    "config.json*", "metrics.json*", "evaluations.jsonl", "tensorboard", "checkpoint-*",
    "policy.*", "untrained.*",
)  # fmt: skip


def prepare_folder(out: Path, settings: dict[str, Any], *, resume: bool, overwrite: bool) -> None:
    """Make the run's folder, or check that it holds a run with the same settings to go on from.

    Raises:
        FileExistsError: if the folder exists and is neither to be resumed nor replaced, or holds
            what no training made.
        FileNotFoundError: if there is no run to resume.
        ValueError: if the run to resume was started with other settings, or resume and overwrite
            are asked for at once.
        DloError: if the run's settings are damaged or of another version.
    """
    check_resume(resume=resume, overwrite=overwrite)
    if resume:
        _check_same_run(out, settings)
        return
    if out.exists() and not overwrite:
        raise FileExistsError(f"{out} exists; pass --overwrite to replace it, or --resume")
    check_output_folder(out, MADE, overwrite=overwrite)
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    write_metrics(out / "config.json", settings)


def _check_same_run(out: Path, settings: dict[str, Any]) -> None:
    path = out / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; there is no run to resume in {out}")
    try:
        former = json.loads(path.read_text())
    except ValueError as error:
        raise DloError(f"{path} is damaged: {error}") from error
    asked = json.loads(json.dumps(settings))
    if not isinstance(former, dict) or set(former) != set(asked):
        raise DloError(
            f"{path} is of another version: expected the settings {', '.join(asked)},"
            f" got {', '.join(former)}; train anew with --overwrite"
        )
    changed = [name for name in asked if asked[name] != former[name]]
    if changed:
        differences = ", ".join(f"{name} {former[name]} -> {asked[name]}" for name in changed)
        raise ValueError(f"--resume: {out} was started with other settings: {differences}")


def save_checkpoint(model: SAC, out: Path, best_error: float) -> None:
    """Write model, replay buffer and score [m] to a folder that appears whole or not at all."""
    folder = out / f"checkpoint-{model.num_timesteps:09d}"
    part = folder.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    model.save(part / "model.zip")
    model.save_replay_buffer(part / "replay_buffer.pkl")
    write_metrics(part / "progress.json", {"format": FORMAT, "best_error": best_error})
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)
    for older in _checkpoints(out):
        if older != folder:
            shutil.rmtree(older)


def load_checkpoint(out: Path, env: gym.Env, seed: int) -> tuple[SAC, float]:
    """The newest model, with its replay buffer, and the error [m] of the best policy so far.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        DloError: if the newest one is damaged or of another version; names it.
    """
    checkpoints = _checkpoints(out)
    if not checkpoints:
        raise FileNotFoundError(f"no checkpoint-* in {out}; there is nothing to resume")
    folder = checkpoints[-1]
    try:
        progress = json.loads((folder / "progress.json").read_text())
        best_error, found = progress["best_error"], progress.get("format")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DloError(f"checkpoint {folder} is damaged: {error!r}") from error
    if found != FORMAT:
        raise DloError(f"checkpoint {folder}: expected format {FORMAT!r}, got {found!r}")
    try:
        model = SAC.load(folder / "model.zip", env=env, device="cpu")
        with warnings.catch_warnings():
            # The episode that was under way ends here; SB3 warns that it is cut.
            warnings.simplefilter("ignore", UserWarning)
            model.load_replay_buffer(folder / "replay_buffer.pkl", truncate_last_traj=True)
    except UNREADABLE as error:
        raise DloError(
            f"checkpoint {folder} is damaged, or of another version of dlo-gym or"
            f" stable-baselines3: {error}"
        ) from error
    model.set_random_seed(seed + model.num_timesteps)
    return model, float("inf") if best_error is None else float(best_error)


def _checkpoints(out: Path) -> list[Path]:
    return sorted(path for path in out.glob("checkpoint-*") if path.suffix != ".part")
