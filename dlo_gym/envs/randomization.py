"""What may differ from episode to episode: the rod, its look, the cameras, delays."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from dlo_gym.rod.properties import RodProperties
from dlo_gym.scene.furnishings import sample_clutter

Range = tuple[float, float]


@dataclass(frozen=True)
class Randomization:
    """Ranges (lowest, highest) that every reset samples from; None leaves what the options say.

    Attributes:
        youngs_modulus: [Pa], log-uniform.
        radius, length: [m], uniform.
        density: [kg/m^3], uniform.
        friction: Coulomb's coefficient between rod and obstacles, uniform.
        rest_curvature: about d1 and about d2, each [1/m], uniform.
        clutter: how many cables, and how many coloured blocks, lie on the table.
        rod_color: each of red, green, blue in [0, 1], uniform.
        camera_translation, camera_rotation: size of the error in each camera's pose as observers
            know it, in a random direction [m], [rad], uniform.
        camera_latency: how many control steps old the images are.
        arm_latency: after how many control steps the arms make a motion.

    Raises:
        ValueError: naming the range.
    """

    youngs_modulus: Range | None = None
    radius: Range | None = None
    length: Range | None = None
    density: Range | None = None
    rest_curvature: Range | None = None
    friction: Range | None = None
    rod_color: Range | None = None
    camera_translation: Range | None = None
    camera_rotation: Range | None = None
    camera_latency: tuple[int, int] | None = None
    arm_latency: tuple[int, int] | None = None
    clutter: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if value is None:
                continue
            ends = np.asarray(value, dtype=np.float64)
            if ends.shape != (2,) or not np.isfinite(ends).all() or ends[0] > ends[1]:
                raise ValueError(f"{option.name}: expected (lowest, highest), got {value!r}")
            positive = option.name in ("youngs_modulus", "radius", "length", "density")
            if (positive and ends[0] <= 0) or (option.name != "rest_curvature" and ends[0] < 0):
                kind = "positive" if positive else "non-negative"
                raise ValueError(f"{option.name}: expected {kind} numbers, got {value!r}")
            if option.name == "rod_color" and ends[1] > 1.0:
                raise ValueError(f"rod_color: expected numbers in [0, 1], got {value!r}")
            if option.name.endswith("latency") and (ends != np.round(ends)).any():
                raise ValueError(f"{option.name}: expected whole control steps, got {value!r}")
            if option.name == "clutter" and (ends != np.round(ends)).any():
                raise ValueError(f"clutter: expected whole numbers of things, got {value!r}")

    def sample(self, rng: np.random.Generator, cameras: tuple[CameraModel, ...]) -> dict[str, Any]:
        """A value of everything that has a range, by name."""
        values: dict[str, Any] = {}
        if self.youngs_modulus is not None:
            low, high = np.log(self.youngs_modulus)
            values["youngs_modulus"] = float(np.exp(rng.uniform(low, high)))
        for name in ("radius", "length", "density"):
            if getattr(self, name) is not None:
                values[name] = float(rng.uniform(*getattr(self, name)))
        if self.rest_curvature is not None:
            values["rest_curvature"] = np.append(rng.uniform(*self.rest_curvature, size=2), 0.0)
        if self.rod_color is not None:
            values["rod_color"] = rng.uniform(*self.rod_color, size=3)
        for name in ("camera_translation", "camera_rotation"):
            if getattr(self, name) is not None:
                sizes = rng.uniform(*getattr(self, name), size=(len(cameras), 1))
                values[name] = sizes * _directions(rng, len(cameras))
        for name in ("camera_latency", "arm_latency"):
            if getattr(self, name) is not None:
                low, high = getattr(self, name)
                values[name] = int(rng.integers(low, high, endpoint=True))
        if self.friction is not None:
            values["friction"] = float(rng.uniform(*self.friction))
        if self.clutter is not None:
            low, high = self.clutter
            n_cables, n_blocks = rng.integers(low, high, size=2, endpoint=True)
            values["clutter"] = sample_clutter(rng, n_cables, n_blocks, int(high))._asdict()
        return values


def randomized_properties(properties: RodProperties, values: dict[str, Any]) -> RodProperties:
    """``properties`` with what was sampled in their place."""
    names = ("youngs_modulus", "radius", "length", "density", "rest_curvature")
    return replace(properties, **{name: values[name] for name in names if name in values})


def believed_cameras(
    cameras: tuple[CameraModel, ...], values: dict[str, Any]
) -> tuple[CameraModel, ...]:
    """The cameras with the errors in their poses that were sampled."""
    shifts = values.get("camera_translation", np.zeros((len(cameras), 3)))
    turns = values.get("camera_rotation", np.zeros((len(cameras), 3)))
    return tuple(
        replace(camera, T_world_camera=camera.T_world_camera @ pose(exp_so3(turn), shift))
        for camera, shift, turn in zip(cameras, shifts, turns, strict=True)
    )


def _directions(rng: np.random.Generator, n: int) -> Array:
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
