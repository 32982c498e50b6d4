"""Recordings on disk, format ``dlo-recording/1``: one folder with poses, images and truth.

recording.json    schema, name, rate_hz, rod, cameras
signals.npz       stamps, clamp_left[, clamp_right][, stamps_<camera>]
truth.npz         optional: centerline[, visible_<camera>]
views/<camera>/   000000.jpg or .png, one per sample
"""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.exceptions import RecordingError
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array, check_single_pose
from dlo_gym.recording_files import (
    IMAGE_SUFFIXES,
    SCHEMA,
    find_images,
    positive,
    positive_or_none,
    read_cameras,
    read_description,
    read_extra,
    read_signals,
    read_truth,
    required,
)


@dataclass(frozen=True, eq=False)
class Recording:
    """T synchronous samples of a rod held by one or two grippers; images are read when asked for.

    Attributes:
        name: of the recording.
        rate_hz: nominal sample rate [Hz].
        rod_length, rod_radius: [m].
        cameras: one per view.
        stamps: (T,) [s].
        clamp_left: (T, 4, 4) world pose of the material frame at node 0.
        clamp_right: (T, 4, 4) the same at the last node; None where only one gripper held it.
        image_files: per camera name the T files.
        youngs_modulus: [Pa], None if unknown.
        density: [kg/m^3], None if unknown.
        camera_stamps: per camera name (T,) [s], for cameras that have their own.
        centerline: (T, n_nodes, 3) true shape [m], equally spaced by arc length; None if unknown.
        visible: per camera name (T, n_nodes) whether each node is truly visible.
        extra: further signals by name, (T, ...), such as the commands of a controlled run.
        run: settings of the run that was recorded; empty if it was not a controlled one.
    """

    name: str
    rate_hz: float
    rod_length: float
    rod_radius: float
    cameras: tuple[CameraModel, ...]
    stamps: Array
    clamp_left: Array
    clamp_right: Array | None
    image_files: dict[str, tuple[Path, ...]]
    youngs_modulus: float | None = None
    density: float | None = None
    camera_stamps: dict[str, Array] = field(default_factory=dict)
    centerline: Array | None = None
    visible: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)
    run: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    def load(cls, path: str | Path) -> "Recording":
        """Reads and checks everything but the images' pixels.

        Raises:
            RecordingError: naming the file and what was expected of it.
        """
        root = Path(path)
        description_file = root / "recording.json"
        description = read_description(description_file)
        cameras = read_cameras(description, description_file)
        rod = required(description, "rod", dict, description_file)
        signals = read_signals(root / "signals.npz", cameras)
        n_samples = len(signals["stamps"])
        truth = read_truth(root / "truth.npz", n_samples, cameras)
        return cls(
            name=required(description, "name", str, description_file),
            rate_hz=positive(description, "rate_hz", description_file),
            rod_length=positive(rod, "length", description_file),
            rod_radius=positive(rod, "radius", description_file),
            cameras=cameras,
            stamps=signals["stamps"],
            clamp_left=signals["clamp_left"],
            clamp_right=signals.get("clamp_right"),
            image_files={c.name: find_images(root / "views" / c.name, n_samples) for c in cameras},
            youngs_modulus=positive_or_none(rod, "youngs_modulus", description_file),
            density=positive_or_none(rod, "density", description_file),
            camera_stamps={
                c.name: signals[f"stamps_{c.name}"]
                for c in cameras
                if f"stamps_{c.name}" in signals
            },
            centerline=truth.get("centerline"),
            visible={
                c.name: truth[f"visible_{c.name}"] for c in cameras if f"visible_{c.name}" in truth
            },
            extra=read_extra(root / "signals.npz", signals),
            run=description.get("run", {}),
        )

    def camera(self, name: str) -> CameraModel:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise ValueError(f"camera: expected one of {[c.name for c in self.cameras]}, got {name!r}")

    def view(self, camera_name: str, sample: int) -> View:
        """One image with its camera and capture time.

        Raises:
            RecordingError: naming the image, if it cannot be decoded or has another size.
        """
        camera = self.camera(camera_name)
        file = self.image_files[camera_name][sample]
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if image is None:
            raise RecordingError(f"{file}: expected a readable image, got a damaged or missing one")
        if image.shape[:2] != (camera.height, camera.width):
            raise RecordingError(
                f"{file}: expected {camera.width}x{camera.height} pixels as camera"
                f" {camera_name!r} says, got {image.shape[1]}x{image.shape[0]}"
            )
        stamps = self.camera_stamps.get(camera_name, self.stamps)
        rgb = np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)
        return View(rgb, camera, float(stamps[sample]))

    def views(self, sample: int) -> tuple[View, ...]:
        """All views of one sample, in the cameras' order."""
        return tuple(self.view(camera.name, sample) for camera in self.cameras)


class RecordingWriter:
    """Writes a recording sample by sample; the folder appears under its name when complete.

    Used as a context manager. Samples are collected in a hidden folder beside ``path``; leaving
    the block, also through an exception, publishes the samples completed so far. Nothing appears
    if there are none.

    Args:
        path: the folder to make.
        cameras: one per view.
        rod_length, rod_radius: [m].
        rate_hz: nominal sample rate [Hz].
        name: of the recording; the folder's name if omitted.
        youngs_modulus, density: [Pa], [kg/m^3]; left out if None.
        image_format: "png" (lossless) or "jpg" (quality 95).
        run: settings of the run, as JSON takes them.

    Raises:
        FileExistsError: if ``path`` exists.
    """

    def __init__(
        self,
        path: str | Path,
        cameras: Sequence[CameraModel],
        *,
        rod_length: float,
        rod_radius: float,
        rate_hz: float,
        name: str | None = None,
        youngs_modulus: float | None = None,
        density: float | None = None,
        image_format: str = "png",
        run: Mapping[str, Any] | None = None,
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise FileExistsError(f"{self.path} exists; choose another name or remove it first")
        if f".{image_format}" not in IMAGE_SUFFIXES:
            raise ValueError(f"image_format: expected 'png' or 'jpg', got {image_format!r}")
        self.cameras = tuple(cameras)
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"cameras: expected one or more with distinct names, got {names}")
        self._suffix = f".{image_format}"
        rod = {"length": rod_length, "radius": rod_radius}
        if youngs_modulus is not None:
            rod["youngs_modulus"] = youngs_modulus
        if density is not None:
            rod["density"] = density
        self._description = {
            "schema": SCHEMA,
            "name": name or self.path.name,
            "rate_hz": rate_hz,
            "rod": rod,
            "cameras": [
                {
                    "name": camera.name,
                    "width": camera.width,
                    "height": camera.height,
                    "K": camera.K.tolist(),
                    "distortion": camera.distortion.tolist(),
                    "T_world_camera": camera.T_world_camera.tolist(),
                }
                for camera in self.cameras
            ],
        }
        if run:
            self._description["run"] = dict(run)
        for key, value in {**rod, "rate_hz": rate_hz}.items():
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{key}: expected a positive number, got {value}")
        self._samples: list[dict[str, Any]] = []
        self._folder = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        shutil.rmtree(self._folder, ignore_errors=True)
        for camera_name in names:
            (self._folder / "views" / camera_name).mkdir(parents=True)
        self._closed = False

    def append(
        self,
        views: Sequence[View],
        clamp_left: ArrayLike,
        clamp_right: ArrayLike | None,
        stamp: float,
        *,
        centerline: ArrayLike | None = None,
        visible: ArrayLike | None = None,
        extra: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Adds one sample; every sample must bring the same kinds of data as the first.

        Args:
            views: one per camera, in any order.
            clamp_left, clamp_right: (4, 4) clamp poses; right None if one gripper holds the rod.
            stamp: [s].
            centerline: (n_nodes, 3) true shape [m].
            visible: (n_views, n_nodes) true visibility, in the order of the writer's cameras.
            extra: further signals by name.

        Raises:
            ValueError: naming the argument that does not fit; the sample is then not added.
        """
        if self._closed:
            raise ValueError(f"{self.path}: the recording is closed")
        by_name = {view.camera.name: view for view in views}
        expected = {camera.name for camera in self.cameras}
        if set(by_name) != expected or len(views) != len(self.cameras):
            raise ValueError(
                f"views: expected one of each camera {sorted(expected)},"
                f" got {[view.camera.name for view in views]}"
            )
        sample = self._checked_sample(clamp_left, clamp_right, stamp, centerline, visible, extra)
        index = len(self._samples)
        for camera in self.cameras:
            view = by_name[camera.name]
            if view.image.shape[:2] != (camera.height, camera.width):
                raise ValueError(
                    f"views: expected {camera.width}x{camera.height} pixels of camera"
                    f" {camera.name!r}, got {view.image.shape[1]}x{view.image.shape[0]}"
                )
            sample[f"stamps_{camera.name}"] = float(view.stamp)
            file = self._folder / "views" / camera.name / f"{index:06d}{self._suffix}"
            image = cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR)
            options = [cv2.IMWRITE_JPEG_QUALITY, 95] if self._suffix == ".jpg" else []
            if not cv2.imwrite(str(file), image, options):
                raise OSError(f"{file}: the image could not be written; is the disk full?")
        self._samples.append(sample)

    def _checked_sample(
        self,
        clamp_left: ArrayLike,
        clamp_right: ArrayLike | None,
        stamp: float,
        centerline: ArrayLike | None,
        visible: ArrayLike | None,
        extra: Mapping[str, ArrayLike] | None,
    ) -> dict[str, Any]:
        sample: dict[str, Any] = {"clamp_left": check_single_pose(clamp_left, "clamp_left")}
        for key, value in (extra or {}).items():
            if key.startswith(("stamps", "clamp_", "centerline", "visible_")):
                raise ValueError(f"extra: {key!r} is a name of the format itself")
            sample[key] = np.array(value)
        if not np.isfinite(stamp):
            raise ValueError(f"stamp: expected a finite time [s], got {stamp}")
        sample["stamps"] = float(stamp)
        if clamp_right is not None:
            sample["clamp_right"] = check_single_pose(clamp_right, "clamp_right")
        if centerline is not None:
            nodes = np.array(centerline, dtype=np.float64)
            if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
                raise ValueError(f"centerline: expected finite (n_nodes, 3), got {nodes.shape}")
            sample["centerline"] = nodes
        if visible is not None:
            mask = np.array(visible, dtype=bool)
            n_nodes = None if centerline is None else len(sample["centerline"])
            if n_nodes is None or mask.shape != (len(self.cameras), n_nodes):
                raise ValueError(
                    f"visible: expected ({len(self.cameras)}, n_nodes) beside a centerline,"
                    f" got {mask.shape}"
                )
            for camera, row in zip(self.cameras, mask, strict=True):
                sample[f"visible_{camera.name}"] = row
        if self._samples:
            first, this = _shapes(self._samples[0]), _shapes(sample)
            if first != this:
                raise ValueError(f"sample: expected the data of the first, {first}, got {this}")
        return sample

    def close(self) -> None:
        """Publishes the recording under its name; does nothing the second time."""
        if self._closed:
            return
        self._closed = True
        if not self._samples:
            shutil.rmtree(self._folder, ignore_errors=True)
            return
        try:
            self._write_arrays()
        except OSError as error:
            raise OSError(
                f"{self.path} could not be completed: {error}; its images are in {self._folder}"
            ) from error
        if self.path.exists():
            raise FileExistsError(f"{self.path} appeared meanwhile; the data is in {self._folder}")
        os.replace(self._folder, self.path)

    def _write_arrays(self) -> None:
        """Everything but the images; those of a sample that was not completed go."""
        keys = self._samples[0].keys()
        stacked = {key: np.stack([sample[key] for sample in self._samples]) for key in keys}
        truth = {k: v for k, v in stacked.items() if k == "centerline" or k.startswith("visible_")}
        signals = {key: value for key, value in stacked.items() if key not in truth}
        np.savez(self._folder / "signals.npz", allow_pickle=False, **signals)
        if truth:
            np.savez(self._folder / "truth.npz", allow_pickle=False, **truth)
        (self._folder / "recording.json").write_text(json.dumps(self._description, indent=1))
        for folder in (self._folder / "views").iterdir():
            for file in folder.iterdir():
                if int(file.stem) >= len(self._samples):
                    file.unlink()

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _shapes(sample: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Of a sample's arrays; every sample has its stamps."""
    return {key: np.shape(value) for key, value in sample.items() if not key.startswith("stamps")}
