"""Reads and checks the files of a recording: each error names the file and what was expected."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import RecordingError
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, check_pose

SCHEMA = "dlo-recording/1"
IMAGE_SUFFIXES = (".jpg", ".png")


def read_description(file: Path) -> dict[str, Any]:
    """recording.json, with its schema checked."""
    try:
        description = json.loads(file.read_text())
    except FileNotFoundError:
        raise RecordingError(f"{file}: expected this file, it is missing") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RecordingError(f"{file}: expected a JSON object, got {error}") from error
    if not isinstance(description, dict):
        raise RecordingError(f"{file}: expected a JSON object, got {type(description).__name__}")
    if description.get("schema") != SCHEMA:
        raise RecordingError(
            f"{file}: expected schema {SCHEMA!r}, got {description.get('schema')!r}"
        )
    return description


def required(container: dict[str, Any], key: str, kind: type, file: Path) -> Any:
    """``container[key]`` of ``file`` after checking that it is a ``kind``."""
    if not isinstance(container, dict) or not isinstance(container.get(key), kind):
        got = container.get(key) if isinstance(container, dict) else container
        raise RecordingError(f"{file}: expected {key!r} to be a {kind.__name__}, got {got!r}")
    return container[key]


def positive(container: dict[str, Any], key: str, file: Path) -> float:
    """``container[key]`` of ``file`` after checking that it is a finite positive number."""
    value = container.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RecordingError(f"{file}: expected {key!r} to be a number, got {value!r}")
    if not (np.isfinite(value) and value > 0):
        raise RecordingError(f"{file}: expected {key!r} to be finite and positive, got {value!r}")
    return float(value)


def positive_or_none(container: dict[str, Any], key: str, file: Path) -> float | None:
    """The same, or None where there is no such entry."""
    return None if container.get(key) is None else positive(container, key, file)


def read_cameras(description: dict[str, Any], file: Path) -> tuple[CameraModel, ...]:
    """The cameras of recording.json."""
    entries = required(description, "cameras", list, file)
    if not entries:
        raise RecordingError(f"{file}: expected at least one camera, got none")
    cameras = []
    for entry in entries:
        name = required(entry, "name", str, file)
        if Path(name).name != name or name in ("", ".", ".."):
            raise RecordingError(f"{file}: expected a camera name fit for a folder, got {name!r}")
        try:
            cameras.append(
                CameraModel(
                    name,
                    required(entry, "width", int, file),
                    required(entry, "height", int, file),
                    np.array(required(entry, "K", list, file), dtype=np.float64),
                    np.array(required(entry, "T_world_camera", list, file), dtype=np.float64),
                    np.array(required(entry, "distortion", list, file), dtype=np.float64),
                )
            )
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{file}: camera {name!r}: {error}") from error
    names = [camera.name for camera in cameras]
    if len(set(names)) != len(names):
        raise RecordingError(f"{file}: expected cameras with distinct names, got {names}")
    return tuple(cameras)


def _read_npz(file: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise RecordingError(f"{file}: expected this file, it is missing") from None
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise RecordingError(f"{file}: expected an npz of plain arrays, got {error}") from error


def _array(
    arrays: dict[str, NDArray[Any]], key: str, shape: tuple[int | None, ...], file: Path
) -> Array:
    """``arrays[key]`` as float64 after checking its shape; None in ``shape`` fits any length."""
    wanted = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
    if key not in arrays:
        raise RecordingError(f"{file}: expected array {key!r} of shape {wanted}, it is missing")
    value = arrays[key]
    fits = len(value.shape) == len(shape) and all(
        size is None or size == got for size, got in zip(shape, value.shape, strict=True)
    )
    if not fits or not (np.issubdtype(value.dtype, np.number) or value.dtype == bool):
        raise RecordingError(
            f"{file}: expected {key!r} to be numbers of shape {wanted},"
            f" got {value.dtype} {value.shape}"
        )
    if not np.isfinite(value).all():
        raise RecordingError(f"{file}: expected {key!r} to be finite, got NaN or infinity")
    return np.ascontiguousarray(value, dtype=np.float64)


def read_signals(file: Path, cameras: tuple[CameraModel, ...]) -> dict[str, Array]:
    """signals.npz: stamps (T,), clamp_left and, if it has one, clamp_right (T, 4, 4), and
    stamps_<camera> (T,) of the cameras that have their own."""
    arrays = _read_npz(file)
    signals = {"stamps": _array(arrays, "stamps", (None,), file)}
    n_samples = len(signals["stamps"])
    if n_samples == 0:
        raise RecordingError(f"{file}: expected at least one sample in 'stamps', got none")
    for key in ("clamp_left", "clamp_right"):
        if key == "clamp_left" or key in arrays:
            poses = _array(arrays, key, (n_samples, 4, 4), file)
            try:
                signals[key] = check_pose(poses, key)
            except ValueError as error:
                raise RecordingError(f"{file}: {error}") from error
    for camera in cameras:
        key = f"stamps_{camera.name}"
        if key in arrays:
            signals[key] = _array(arrays, key, (n_samples,), file)
    return signals


def read_extra(file: Path, known: Mapping[str, Array]) -> dict[str, NDArray[Any]]:
    """What signals.npz holds of T samples beside the arrays in ``known``."""
    n_samples = len(known["stamps"])
    return {
        key: array
        for key, array in _read_npz(file).items()
        if key not in known and array.ndim and len(array) == n_samples
    }


def read_truth(
    file: Path, n_samples: int, cameras: tuple[CameraModel, ...]
) -> dict[str, NDArray[Any]]:
    """truth.npz: centerline (T, n_nodes, 3), visible_<camera> (T, n_nodes); empty without it."""
    if not file.exists():
        return {}
    arrays = _read_npz(file)
    truth: dict[str, NDArray[Any]] = {
        "centerline": _array(arrays, "centerline", (n_samples, None, 3), file)
    }
    n_nodes = truth["centerline"].shape[1]
    if n_nodes < 2:
        raise RecordingError(f"{file}: expected 'centerline' of two nodes or more, got {n_nodes}")
    for camera in cameras:
        key = f"visible_{camera.name}"
        if key in arrays:
            if arrays[key].dtype != bool:
                raise RecordingError(
                    f"{file}: expected {key!r} to be bool, got {arrays[key].dtype}"
                )
            truth[key] = _array(arrays, key, (n_samples, n_nodes), file).astype(bool)
    return truth


def find_images(folder: Path, n_samples: int) -> tuple[Path, ...]:
    """One camera's images, one per sample, in order."""
    if not folder.is_dir():
        raise RecordingError(f"{folder}: expected a folder of {n_samples} images, it is missing")
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        if file.stem in files:
            raise RecordingError(
                f"{file}: expected one image per sample, got {files[file.stem]} too"
            )
        files[file.stem] = file
    wanted = [f"{sample:06d}" for sample in range(n_samples)]
    missing = [stem for stem in wanted if stem not in files]
    if missing:
        raise RecordingError(
            f"{folder / missing[0]}.jpg or .png: expected an image for each of the {n_samples}"
            f" samples, {len(missing)} missing"
        )
    extra = sorted(set(files) - set(wanted))
    if extra:
        raise RecordingError(
            f"{files[extra[0]]}: expected {n_samples} images numbered from 000000 as signals.npz"
            f" has samples, got {len(extra)} more"
        )
    return tuple(files[stem] for stem in wanted)
