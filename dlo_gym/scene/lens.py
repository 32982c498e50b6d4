"""From the pinhole image that OpenGL draws to the image of a camera with distortion."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel

_LARGEST_PINHOLE = 3.0  # times the camera's own width or height


@dataclass(frozen=True, eq=False)
class Lens:
    """How a camera's image is sampled from a pinhole image.

    Attributes:
        camera: the camera to imitate.
        pinhole: a camera without distortion, at the same place, that sees at least as much;
            ``camera`` itself if it has none.
        map_x, map_y: (height, width) where in the pinhole image each of the camera's pixels lies
            [pixels]; ``None`` if the two are the same.
    """

    camera: CameraModel
    pinhole: CameraModel
    map_x: NDArray[np.float32] | None = None
    map_y: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, camera: CameraModel) -> "Lens":
        """The lens of a camera.

        Raises:
            ValueError: if the distortion folds the image over itself, or needs a pinhole image
                more than three times as wide or high.
        """
        if not camera.is_distorted:
            return cls(camera, camera)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([u, v], axis=-1).astype(np.float64)
        rays = camera.rays(pixels)
        off = np.abs(camera.project(camera.centre + rays) - pixels)
        if not (off < 0.01).all():
            raise ValueError(
                f"camera {camera.name!r}: distortion {camera.distortion.tolist()} cannot be"
                f" inverted over the {camera.width}x{camera.height} image"
            )
        in_camera = rays @ camera.T_world_camera[:3, :3]
        focal = np.array([camera.K[0, 0], camera.K[1, 1]])
        seen = in_camera[..., :2] / in_camera[..., 2:] * focal
        # Where the lens magnifies, the pinhole image must be as fine as the camera's.
        steps = [np.abs(np.diff(seen[..., axis], axis=1 - axis)).min() for axis in (0, 1)]
        finer = max(1.0, 1.0 / min(steps))
        focal, seen = finer * focal, finer * seen
        # One pixel of margin lets every sample interpolate between four pixels.
        corner = np.floor(seen.min(axis=(0, 1))) - 1
        width, height = (np.ceil(seen.max(axis=(0, 1))) + 2 - corner).astype(int)
        if width > _LARGEST_PINHOLE * camera.width or height > _LARGEST_PINHOLE * camera.height:
            raise ValueError(
                f"camera {camera.name!r}: distortion {camera.distortion.tolist()} needs a pinhole"
                f" image of {width}x{height} pixels for {camera.width}x{camera.height}"
            )
        K = np.diag([*focal, 1.0])
        K[:2, 2] = -corner
        pinhole = CameraModel(camera.name, int(width), int(height), K, camera.T_world_camera)
        map_x, map_y = np.moveaxis((seen - corner).astype(np.float32), -1, 0)
        return cls(camera, pinhole, np.ascontiguousarray(map_x), np.ascontiguousarray(map_y))

    def apply(self, image: NDArray[np.uint8], *, nearest: bool = False) -> NDArray[np.uint8]:
        """The camera's image, from the pinhole's; ``nearest`` for masks."""
        if self.map_x is None or self.map_y is None:
            return image
        interpolation = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        return cv2.remap(image, self.map_x, self.map_y, interpolation)  # type: ignore[return-value]
