"""Draws the world as its cameras see it."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.envs.cell import sample_occluder_paths
from dlo_gym.geometry.se3 import Array
from dlo_gym.scene.renderer import SceneRenderer
from sim2real.emulator.held_rod import HeldShape
from sim2real.emulator.world_config import Gripper, WorldConfig

_JPEG = [
    *(cv2.IMWRITE_JPEG_QUALITY, 95),
    # Halved chroma would smear a cable's colour over three pixels on either side.
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The world at one moment.

    Attributes:
        stamp: monotonic [s].
        joint_angles: (2, 6) [rad].
        shape: the rod between the grippers.
        board: side of the gripper that carries a calibration board instead; None if none does.
    """

    stamp: float
    joint_angles: Array
    shape: HeldShape
    board: Gripper | None = None


class Drawn(NamedTuple):
    """What one camera saw: RGB (height, width, 3) uint8, and which nodes (n_nodes,) it saw."""

    image: NDArray[np.uint8]
    visible: NDArray[np.bool_]


class Drawing(Protocol):
    """Anything that turns the world into pictures; used by one thread alone, OpenGL wants it so."""

    def draw(self, snapshot: Snapshot) -> dict[str, Drawn]:
        """One picture per camera, all of the same moment."""
        ...

    def close(self) -> None: ...


class CellDrawing:
    """The cell with its arms, the rod or a board, clutter and occluders that pass by."""

    def __init__(self, config: WorldConfig) -> None:
        self._config = config
        self._renderer = SceneRenderer(config.scene)
        rng = np.random.default_rng(config.seed)
        self._paths = sample_occluder_paths(rng, config.cameras, config.n_occluders)
        self._began: float | None = None

    def draw(self, snapshot: Snapshot) -> dict[str, Drawn]:
        if self._began is None:
            self._began = snapshot.stamp
        if snapshot.board != self._config.board:
            self._renderer.close()
            self._config = self._config.carrying(snapshot.board)
            self._renderer = SceneRenderer(self._config.scene)
        elapsed = snapshot.stamp - self._began
        occluders = np.array([path.position(elapsed) for path in self._paths])
        shape = snapshot.shape
        self._renderer.update(
            shape.positions,
            shape.boundary,
            occluder_positions=occluders if len(occluders) else None,
            joint_angles=snapshot.joint_angles,
        )
        return {
            view.camera.name: Drawn(view.image, self._renderer.visibility(view.camera.name))
            for view in self._renderer.views(snapshot.stamp)
        }

    def close(self) -> None:
        self._renderer.close()


def encode(image: NDArray[np.uint8]) -> bytes:
    """A JPEG file of quality 95 with full chroma from an RGB image (height, width, 3)."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)
    if not done:
        raise ValueError(f"image: cannot be encoded, shape {image.shape}")
    return data.tobytes()
