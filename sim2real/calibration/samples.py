"""Calibration samples: where the arm was, what the cameras saw; on disk as a folder.

    samples.json                the board, the cameras' image sizes, one entry per sample
    images/<camera>/0000.png    the sample's view from each camera
    intrinsics/<camera>/*.png   optional: further images of the board, held by hand

``samples.json`` is rewritten after every sample, so that a collection that was cut off goes on.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError
from dlo_gym.geometry.se3 import Array, check_single_pose
from dlo_gym.scene.arms import SIDES
from sim2real.calibration.board import BoardSpec, Detection

SCHEMA = "dlo-calibration-samples/1"


class SamplesError(DloError, ValueError):
    """A folder of calibration samples is missing, incomplete or does not fit; names the file."""


@dataclass(frozen=True, eq=False)
class Sample:
    """The board in one arm's gripper, seen by cameras at one moment.

    Attributes:
        side: the arm that carried it, "left" or "right".
        T_base_tcp: (4, 4) where that arm reported its tool centre point.
        detections: by camera name; a camera that saw nothing is absent or has an empty one.
        name: for reports.
    """

    side: str
    T_base_tcp: Array
    detections: Mapping[str, Detection]
    name: str = ""

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ValueError(f"side: expected one of {', '.join(SIDES)}, got {self.side!r}")
        object.__setattr__(self, "T_base_tcp", check_single_pose(self.T_base_tcp, "T_base_tcp"))


@dataclass
class SampleFolder:
    """A folder of samples, read or being written.

    Attributes:
        path: of the folder.
        board: what was carried.
        image_sizes: (width, height) [pixels] by camera name.
        entries: one JSON-ready entry per sample, in order.
    """

    path: Path
    board: BoardSpec
    image_sizes: dict[str, tuple[int, int]]
    entries: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path) -> "SampleFolder":
        """Reads a folder's ``samples.json``.

        Raises:
            SamplesError: naming the file and what is wrong with it.
        """
        file = path / "samples.json"
        try:
            content = json.loads(file.read_text())
            if content.get("schema") != SCHEMA:
                raise SamplesError(
                    f"{file}: expected schema {SCHEMA!r}, got {content.get('schema')!r}"
                )
            sizes = {name: (int(w), int(h)) for name, (w, h) in content["image_sizes"].items()}
            folder = cls(path, BoardSpec(**content["board"]), sizes, list(content["samples"]))
            for entry in folder.entries:
                Sample(entry["side"], np.array(entry["T_base_tcp"]), {}, entry["name"])
                entry["images"].items()
        except OSError as error:
            raise SamplesError(
                f"{file}: cannot be read: {error.strerror}; `dlo robot calibrate CELL --collect"
                " --samples FOLDER` makes such a folder"
            ) from error
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, SamplesError):
                raise
            raise SamplesError(f"{file}: is not a list of samples: {error!r}") from error
        return folder

    @classmethod
    def create(
        cls, path: Path, board: BoardSpec, image_sizes: Mapping[str, tuple[int, int]]
    ) -> "SampleFolder":
        """A new folder, or the one that is there if it was begun with this board and cameras.

        Raises:
            SamplesError: if the folder has other samples, or other files.
        """
        if (path / "samples.json").exists():
            folder = cls.open(path)
            if folder.board != board or folder.image_sizes != dict(image_sizes):
                raise SamplesError(f"{path}: holds samples of another board or other cameras")
            return folder
        if path.exists() and any(path.iterdir()):
            raise SamplesError(f"{path}: exists and holds no samples; name another folder")
        path.mkdir(parents=True, exist_ok=True)
        folder = cls(path, board, dict(image_sizes))
        folder._save()
        return folder

    def append(
        self,
        side: str,
        T_base_tcp: Array,
        images: Mapping[str, NDArray[np.uint8]],
        name: str | None = None,
        **details: Any,
    ) -> None:
        """Adds one sample: RGB images by camera, and JSON-ready details."""
        index = len(self.entries)
        files = {}
        for camera, image in images.items():
            file = Path("images") / camera / f"{index:04d}.png"
            (self.path / file).parent.mkdir(parents=True, exist_ok=True)
            encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1]
            with written_aside(self.path / file, SamplesError) as part:
                part.write_bytes(encoded.tobytes())
            files[camera] = file.as_posix()
        entry = {"name": name or f"{index:04d}", "side": side, "images": files, **details}
        self.entries.append(entry | {"T_base_tcp": np.asarray(T_base_tcp).tolist()})
        self._save()

    def _save(self) -> None:
        content = {
            "schema": SCHEMA,
            "board": asdict(self.board),
            "image_sizes": self.image_sizes,
            "samples": self.entries,
        }
        with written_aside(self.path / "samples.json", SamplesError) as part:
            part.write_text(json.dumps(content, indent=1))

    def samples(self, cameras: Sequence[str] | None = None) -> list[Sample]:
        """All samples with the board found in their images, of some or all cameras."""
        names = list(self.image_sizes) if cameras is None else list(cameras)
        return [
            Sample(
                entry["side"],
                np.array(entry["T_base_tcp"]),
                {
                    name: self._detect(self.path / entry["images"][name], name)
                    for name in names
                    if name in entry["images"]
                },
                entry["name"],
            )
            for entry in self.entries
        ]

    def extra_views(self, camera: str) -> list[Detection]:
        """The board in the further images that are there for a camera's intrinsics."""
        files = sorted((self.path / "intrinsics" / camera).glob("*.png"))
        return [self._detect(file, camera) for file in files]

    def _detect(self, file: Path, camera: str) -> Detection:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SamplesError(f"{file}: is missing or not an image")
        size = self.image_sizes[camera]
        if image.shape != size[::-1]:
            raise SamplesError(
                f"{file}: expected {size[0]}x{size[1]} pixels, got"
                f" {image.shape[1]}x{image.shape[0]}"
            )
        return self.board.detect(np.asarray(image, dtype=np.uint8))

    def digest(self) -> str:
        """SHA-256 (hex) over everything the calibration reads from the folder."""
        digest = hashlib.sha256((self.path / "samples.json").read_bytes())
        used = [Path(file) for entry in self.entries for file in entry["images"].values()]
        extra = [p.relative_to(self.path) for p in self.path.glob("intrinsics/*/*.png")]
        for file in sorted({*used, *extra}):
            digest.update(file.as_posix().encode())
            digest.update((self.path / file).read_bytes())
        return digest.hexdigest()
