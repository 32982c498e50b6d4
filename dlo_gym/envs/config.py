"""The options of a shape-control environment."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from dlo_gym.envs.randomization import Randomization
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.rod.properties import RodProperties

CHOICES = {
    "observation_mode": ("state", "images"),
    "reward": ("dense", "sparse"),
    "straight_way": ("any", "blocked"),
    "clutter": ("none", "industrial"),
    "renderer": ("opengl", "raster"),
    "quality": ("fast", "high"),
}
TOUCHES = ("forbidden", "allowed")


@dataclass(frozen=True)
class ShapeEnvConfig:
    """Every option that ``gym.make`` takes for a shape-control environment.

    Attributes:
        observer: ``"privileged"`` for the simulator's own state, or ``"module:Class"`` of an
            ``Observer``.
        observer_options: keyword arguments for that class.
        observation_mode: ``"state"``, or ``"images"`` to add the cameras' images as keys.
        properties: of the rod.
        n_elements: of the rod; the centerline has one node more.
        control_step: time between two actions [s].
        max_translation_step: largest motion of a clamp along each world axis in one step [m].
        max_rotation_step: largest rotation of a clamp about each of its axes in one step [rad].
        axial_rotation: whether the action also turns the clamps about the rod's own axis.
        planar: whether both clamps stay in the vertical plane through the arms' tools, and with
            them, unless it buckles, the rod: two translations and a rotation each.
        free_end: whether the left arm alone holds the rod.
        randomization: what every reset samples anew; None for nothing.
        reward: ``"dense"`` or ``"sparse"``.
        success_threshold: mean node error that counts as success [m].
        termination_penalty: taken off the reward of the step that ends an episode early.
        start_distance, start_height: of the clamps in the middle of the start distribution [m].
        start_noise: half-ranges of the start's clamp positions [m] and tilts [rad].
        goal_moves: number of random motions of the clamps that lead from the start to the goal.
        goal_translation: half-range of the clamps' positions over these motions [m].
        goal_rotation: largest rotation about each clamp axis in one of these motions [rad].
        goal_distance: smallest and largest mean node distance between start and goal [m].
        straight_way: ``"blocked"`` takes only goals where arms or grippers would collide, or not
            reach, if both clamps went straight there.
        max_stretch: largest distance between the clamps, in lengths of the rod.
        min_gripper_distance: smallest distance between the clamps [m].
        workspace: lowest and highest clamp position (2, 3), world [m].
        check_arms: whether the arms' reach and collisions are checked at every step.
        cameras: of the scene; the scene's own ``side`` and ``top`` if empty.
        image_scale: size of the images relative to the cameras'.
        clutter: ``"none"`` or ``"industrial"``.
        obstacles: what may stand in the way to a goal, each a ``"post"`` or ``"box"`` on the table;
            every reset places them anew.
        touch: ``"forbidden"``, or ``"allowed"`` where the cable may touch an obstacle; the arms
            never may. One for all obstacles, or one for each.
        standing_obstacles: smallest and largest number of the obstacles, counted from the first,
            that stand in an episode; None for all.
        friction: Coulomb's coefficient between cable and obstacles.
        self_contact: whether the cable can touch itself.
        n_distractor_cables, n_occluders: in the scene; the occluders are boxes that move.
        occluder_size: their full extents in x, y, z [m].
        renderer: ``"opengl"``, or ``"raster"``, which is faster on a CPU and needs no OpenGL.
        quality: of the rendering, ``"fast"`` or ``"high"``, the latter with OpenGL only.
        render_file: an .rrd file that ``render_mode="human"`` writes, for the rerun viewer,
            instead of opening it; no other mode heeds it.

    Raises:
        ValueError: naming the option, what was expected and what came.
    """

    observer: str = "privileged"
    observer_options: Mapping[str, Any] = field(default_factory=dict)
    observation_mode: Literal["state", "images"] = "state"
    properties: RodProperties = field(default_factory=lambda: RodProperties(length=0.5))
    n_elements: int = 50
    control_step: float = 0.1
    max_translation_step: float = 0.01
    max_rotation_step: float = float(np.deg2rad(4.5))
    axial_rotation: bool = False
    planar: bool = False
    free_end: bool = False
    randomization: Randomization | None = None
    reward: Literal["dense", "sparse"] = "dense"
    success_threshold: float = 0.005
    termination_penalty: float = 20.0
    start_distance: float = 0.4
    start_height: float = 0.34
    start_noise: tuple[float, float] = (0.02, float(np.deg2rad(10.0)))
    goal_moves: int = 3
    goal_translation: float = 0.12
    goal_rotation: float = float(np.deg2rad(30.0))
    goal_distance: tuple[float, float] = (0.06, 0.25)
    straight_way: Literal["any", "blocked"] = "any"
    max_stretch: float = 0.98
    min_gripper_distance: float = 0.05
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-0.4, -0.25, 0.22),
        (0.4, 0.25, 0.55),
    )
    check_arms: bool = True
    obstacles: tuple[str, ...] = ()
    touch: str | tuple[str, ...] = "forbidden"
    standing_obstacles: tuple[int, int] | None = None
    friction: float = 0.0
    self_contact: bool = False
    cameras: tuple[CameraModel, ...] = ()
    image_scale: float = 0.5
    clutter: Literal["none", "industrial"] = "none"
    n_distractor_cables: int = 0
    n_occluders: int = 0
    occluder_size: tuple[float, float, float] = (0.12, 0.12, 0.12)
    renderer: Literal["opengl", "raster"] = "opengl"
    quality: Literal["fast", "high"] = "fast"
    render_file: Path | None = None

    OBSTACLE_KINDS: ClassVar[tuple[str, ...]] = ("post", "box")

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if self.render_file is not None:
            object.__setattr__(self, "render_file", Path(self.render_file))
        if self.renderer == "raster" and self.quality == "high":
            raise ValueError('quality: expected "fast" with renderer "raster", got "high"')
        if self.observer != "privileged" and not _is_entry_point(self.observer):
            raise ValueError(
                f"observer: expected 'privileged' or 'module:Class', got {self.observer!r}"
            )
        if not isinstance(self.properties, RodProperties):
            raise ValueError(f"properties: expected RodProperties, got {self.properties!r}")
        if not isinstance(self.randomization, Randomization | None):
            raise ValueError(f"randomization: expected Randomization, got {self.randomization!r}")
        for name in (
            "control_step", "max_translation_step", "max_rotation_step", "success_threshold",
            "start_distance", "start_height", "goal_translation", "max_stretch",
            "min_gripper_distance", "image_scale",
        ):  # fmt: skip
            self._check_number(name, positive=True)
        self._check_number("termination_penalty")
        self._check_number("goal_rotation")
        self._check_obstacles()
        for name, least in (
            ("n_elements", 4), ("goal_moves", 1), ("n_distractor_cables", 0), ("n_occluders", 0),
        ):  # fmt: skip
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name}: expected an integer of at least {least}, got {value!r}")
        self._check_pair("start_noise")
        self._check_pair("goal_distance")
        if not self.goal_distance[0] < self.goal_distance[1]:
            raise ValueError(
                "goal_distance: expected a smallest below a largest distance [m],"
                f" got {self.goal_distance}"
            )
        if self.planar and self.axial_rotation:
            raise ValueError("axial_rotation: expected False with planar, got True")
        if self.straight_way == "blocked" and self.free_end:
            raise ValueError('straight_way: "blocked" needs both arms, expected free_end=False')
        if self.straight_way == "blocked" and not self.check_arms:
            raise ValueError('straight_way: "blocked" is about the arms, expected check_arms=True')
        if self.max_stretch >= 1.0:
            raise ValueError(f"max_stretch: expected a fraction below 1, got {self.max_stretch}")
        if not all(isinstance(camera, CameraModel) for camera in self.cameras):
            raise ValueError(f"cameras: expected CameraModels, got {self.cameras!r}")
        workspace = np.asarray(self.workspace, dtype=np.float64)
        if workspace.shape != (2, 3) or not (workspace[0] < workspace[1]).all():
            raise ValueError(f"workspace: expected (lowest, highest) corners, got {self.workspace}")
        longest = self.max_stretch * self.rod_length[0]
        if not self.min_gripper_distance < self.start_distance < longest:
            raise ValueError(
                f"start_distance: expected between min_gripper_distance"
                f" {self.min_gripper_distance} m and {longest:.4g} m, which is max_stretch times"
                f" the shortest rod's length, got {self.start_distance}"
            )
        element = self.rod_length[0] / self.n_elements
        if self.thickest_rod > element:
            raise ValueError(
                "radius: expected no thicker rod, randomized or not, than the shortest one's"
                f" elements are long, {element:.4g} m, got {self.thickest_rod:.4g} m"
            )

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> "ShapeEnvConfig":
        """The defaults with ``options`` in their place.

        Raises:
            ValueError: if an option does not exist; lists those that do.
        """
        valid = [option.name for option in fields(cls)]
        unknown = [name for name in options if name not in valid]
        if unknown:
            raise ValueError(
                f"unknown environment option {', '.join(map(repr, unknown))};"
                f" valid options are: {', '.join(valid)}"
            )
        return cls(**options)

    @property
    def n_nodes(self) -> int:
        return self.n_elements + 1

    @property
    def n_clamps(self) -> int:
        return 1 if self.free_end else 2

    @property
    def rod_length(self) -> tuple[float, float]:
        """Of the shortest and of the longest rod [m]."""
        sampled = None if self.randomization is None else self.randomization.length
        return sampled or (self.properties.length, self.properties.length)

    @property
    def thickest_rod(self) -> float:
        """The largest radius [m]."""
        sampled = None if self.randomization is None else self.randomization.radius
        return float(np.max(self.properties.radius)) if sampled is None else sampled[1]

    @property
    def touches(self) -> tuple[str, ...]:
        """``touch`` of each obstacle."""
        if isinstance(self.touch, str):
            return (self.touch,) * len(self.obstacles)
        return tuple(self.touch)

    @property
    def uses_images(self) -> bool:
        """Whether every step needs the cameras."""
        return self.observation_mode == "images" or self.observer != "privileged"

    def _check_number(self, name: str, positive: bool = False) -> None:
        value = getattr(self, name)
        number = isinstance(value, int | float | np.number) and np.isfinite(value)
        if not number or value < 0 or (positive and value == 0):
            kind = "positive" if positive else "non-negative"
            raise ValueError(f"{name}: expected a finite {kind} number, got {value!r}")

    def _check_obstacles(self) -> None:
        valid = self.OBSTACLE_KINDS
        if isinstance(self.obstacles, str) or any(kind not in valid for kind in self.obstacles):
            raise ValueError(
                f"obstacles: expected a sequence of {', '.join(valid)}, got {self.obstacles!r}"
            )
        n = len(self.obstacles)
        if len(self.touches) != n or any(how not in TOUCHES for how in self.touches):
            raise ValueError(
                f"touch: expected {' or '.join(TOUCHES)}, for all of {n} obstacles or each of them,"
                f" got {self.touch!r}"
            )
        self._check_number("friction")
        sampled = self.randomization is not None and self.randomization.friction is not None
        if not n and (self.friction > 0 or sampled):
            name = "friction" if self.friction > 0 else "randomization.friction"
            value = self.friction or self.randomization.friction  # type: ignore[union-attr]
            raise ValueError(f"{name}: expected none without obstacles to rub on, got {value}")
        if self.standing_obstacles is not None:
            numbers = np.asarray(self.standing_obstacles)
            whole = numbers.shape == (2,) and np.issubdtype(numbers.dtype, np.integer)
            if not whole or not 1 <= numbers[0] <= numbers[1] <= n:
                raise ValueError(
                    f"standing_obstacles: expected (lowest, highest) number of {n} obstacles,"
                    f" got {self.standing_obstacles!r}"
                )
        if n and self.straight_way == "blocked":
            raise ValueError(
                'straight_way: expected "any" with obstacles, which block it, got "blocked"'
            )

    def _check_pair(self, name: str) -> None:
        values = np.asarray(getattr(self, name), dtype=np.float64)
        if values.shape != (2,) or not (values >= 0).all():
            raise ValueError(
                f"{name}: expected two non-negative numbers, got {getattr(self, name)!r}"
            )


def _is_entry_point(name: str) -> bool:
    return isinstance(name, str) and name.count(":") == 1 and all(name.split(":"))
