"""The camera model that drives the renderer, the tracker and the real cameras alike."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_gym.geometry.se3 import Array, check_single_pose, inverse, pose, transform_points


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pinhole camera with OpenCV distortion, in the OpenCV optical frame.

    The camera looks along +z, x points right and y down in the image. Pixel (0, 0) is the centre
    of the top-left pixel.

    Attributes:
        name: what the view is called in recordings and reports.
        width, height: image size [pixels].
        K: (3, 3) intrinsic matrix [pixels].
        distortion: (5,) OpenCV order k1 k2 p1 p2 k3.
        T_world_camera: (4, 4) extrinsics, ``T_world_camera @ p_camera = p_world`` [m].

    Raises:
        ValueError: on a wrong shape, a non-positive size or focal length, a non-finite value or
            a non-rigid extrinsic.
    """

    name: str
    width: int
    height: int
    K: Array
    T_world_camera: Array
    distortion: Array = None  # type: ignore[assignment]  # zeros when omitted

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(
                f"camera {self.name!r}: expected a positive image size,"
                f" got {self.width}x{self.height}"
            )
        K = np.ascontiguousarray(self.K, dtype=np.float64)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise ValueError(f"camera {self.name!r}: K must be a finite 3x3 matrix, got {self.K}")
        fixed = [K[0, 1], K[1, 0], *K[2]]
        if not (K[0, 0] > 0 and K[1, 1] > 0) or fixed != [0.0, 0.0, 0.0, 0.0, 1.0]:
            raise ValueError(
                f"camera {self.name!r}: K must have positive focal lengths, no skew and the last"
                f" row 0 0 1, got {K.tolist()}"
            )
        distortion = np.zeros(5) if self.distortion is None else self.distortion
        distortion = np.ascontiguousarray(distortion, dtype=np.float64)
        if distortion.shape != (5,) or not np.isfinite(distortion).all():
            raise ValueError(
                f"camera {self.name!r}: distortion must be 5 finite numbers k1 k2 p1 p2 k3,"
                f" got {self.distortion}"
            )
        extrinsics = check_single_pose(self.T_world_camera, f"camera {self.name!r}: T_world_camera")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "T_world_camera", extrinsics)

    @classmethod
    def looking_at(
        cls,
        name: str,
        position: ArrayLike,
        target: ArrayLike,
        *,
        width: int = 1920,
        height: int = 1080,
        focal_length: float = 1400.0,
        up: ArrayLike = (0.0, 0.0, 1.0),
        distortion: ArrayLike | None = None,
    ) -> "CameraModel":
        """A camera at ``position`` (3,) [m] that sees ``target`` (3,) [m] at its image centre.

        ``focal_length`` is in pixels; ``up`` (3,) is drawn upwards in the image.
        """
        position = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(right) < 1e-9:
            raise ValueError(f"camera {name!r}: up {up} is parallel to the viewing direction")
        right /= np.linalg.norm(right)
        rotation = np.column_stack([right, np.cross(forward, right), forward])
        K = np.array(
            [
                [focal_length, 0.0, (width - 1) / 2],
                [0.0, focal_length, (height - 1) / 2],
                [0.0, 0.0, 1.0],
            ]
        )
        return cls(name, width, height, K, pose(rotation, position), distortion)  # type: ignore[arg-type]

    @cached_property
    def T_camera_world(self) -> Array:
        return inverse(self.T_world_camera)

    @property
    def centre(self) -> Array:
        """(3,) optical centre in world [m]."""
        return self.T_world_camera[:3, 3]

    @property
    def is_distorted(self) -> bool:
        return bool(np.any(self.distortion))

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of world points (..., 3) [m]; NaN for points behind the camera."""
        points = np.asarray(points, dtype=np.float64)
        in_camera = transform_points(self.T_camera_world, points).reshape(-1, 3)
        ahead = in_camera[:, 2] > 1e-6
        pixels = np.full((len(in_camera), 2), np.nan)
        if ahead.any():
            normalised = in_camera[ahead, :2] / in_camera[ahead, 2:]
            if self.is_distorted:
                normalised = _distort(normalised, self.distortion)
            pixels[ahead] = normalised * self.K[[0, 1], [0, 1]] + self.K[:2, 2]
        return pixels.reshape(*points.shape[:-1], 2)

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit viewing directions in world (..., 3) through pixels (..., 2), undistorted."""
        pixels = np.asarray(pixels, dtype=np.float64)
        flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-12)
        normalised = cv2.undistortPoints(flat, self.K, self.distortion, criteria=criteria)
        directions = np.concatenate(
            [normalised.reshape(-1, 2), np.ones((normalised.shape[0], 1))], axis=1
        )
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return (directions @ self.T_world_camera[:3, :3].T).reshape(*pixels.shape[:-1], 3)

    def sees(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) fall inside the image (...,); NaN does not."""
        pixels = np.asarray(pixels, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels < [self.width - 0.5, self.height - 0.5])
        return np.asarray(inside.all(axis=-1))

    def scaled(self, factor: float) -> "CameraModel":
        """The same camera with its image resized by ``factor`` (0.5 halves width and height)."""
        width, height = round(self.width * factor), round(self.height * factor)
        scale = np.array([width / self.width, height / self.height, 1.0])
        K = self.K * scale[:, None]
        # Pixel centres sit at integers, so the image's corner is at -0.5.
        K[:2, 2] += (scale[:2] - 1.0) / 2
        return replace(self, width=width, height=height, K=K)


def _distort(normalised: Array, distortion: Array) -> Array:
    """OpenCV's radial and tangential distortion of normalised image points (n, 2)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = normalised.T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.column_stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


@dataclass(frozen=True, eq=False)
class View:
    """One image with the camera that took it.

    Attributes:
        image: (height, width, 3) uint8 RGB.
        camera: the camera's model.
        stamp: capture time [s].
    """

    image: NDArray[np.uint8]
    camera: CameraModel
    stamp: float = 0.0

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width, 3)
        image: Any = self.image
        if image.shape != expected or image.dtype != np.uint8:
            raise ValueError(
                f"view {self.camera.name!r}: expected a uint8 image of shape {expected},"
                f" got {image.dtype} {image.shape}"
            )
