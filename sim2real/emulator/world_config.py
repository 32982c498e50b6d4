"""What the simulated world behind two emulated controllers is made of."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from math import isfinite
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, check_single_pose, exp_so3, pose
from dlo_gym.rod.properties import RodProperties
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.board import BoardPlate
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.threads import n_cores
from sim2real.calibration.board import BoardSpec
from sim2real.calibration.plan import nominal_mount
from sim2real.config import CellConfig
from sim2real.emulator.loopback import check_loopback, is_loopback

Gripper = Literal["left", "right"]  # that carries the board, where one is carried

DEFAULT_CONTROLLERS = ("127.0.0.2", "127.0.0.3")
DEFAULT_ADDRESS = "127.0.0.4"
DEFAULT_PORT = 8080
IMAGE_SCALE = 1 / 3  # of the scene's 1920x1080 cameras
LARGEST_RATE = 120.0
LARGEST_LATENCY = 5.0
_PIXELS_PER_SQUARE = 128  # of the drawn board
_GRIPPED_OFF = (0.002, 0.03)  # a board from where it was meant to be gripped [m], [rad]


@dataclass(frozen=True, eq=False)
class WorldConfig:
    """Everything the world's process needs to know.

    Attributes:
        rod: what the grippers hold.
        n_elements: of the simulated rod.
        overstretch_stiffness: how fast the pull grows when the clamps are further apart than the
            rod is long [N/m].
        dual_arm: where the arms stand and their tool centre points.
        cameras: that are served, each under its own name.
        controllers: loopback addresses of the left and the right emulated controller.
        address, port: where pictures and truth are served; port 0 takes a free one.
        rate: sets of pictures per second; fewer where the processor does not keep up [Hz].
        drawing_share: of one processor core's time that drawing may take; the rate drops where it
            would take more. By default a fifth per core that the process may use.
        latency: by camera, how much later than drawn its pictures are served [s].
        clutter, n_distractor_cables, n_occluders, occluder_size, rod_color, quality: of the scene.
        seed: of the distractor cables, the occluders' paths and how boards are gripped.
        board: side of the gripper that carries a calibration board; there is no rod then.
        board_spec: what is printed on it.
        T_tcp_board: (4, 4) where it is gripped; when omitted, a few millimetres and degrees off
            ``nominal_mount``, in each gripper differently.

    Raises:
        ValueError: naming the field; also on an address outside 127.0.0.0/8.
    """

    rod: RodProperties = field(default_factory=lambda: RodProperties(length=0.5))
    n_elements: int = 50
    overstretch_stiffness: float = 2000.0
    dual_arm: DualArm = field(default_factory=DualArm)
    cameras: tuple[CameraModel, ...] = field(default_factory=lambda: default_cameras(IMAGE_SCALE))
    controllers: tuple[str, str] = DEFAULT_CONTROLLERS
    address: str = DEFAULT_ADDRESS
    port: int = DEFAULT_PORT
    rate: float = 20.0
    drawing_share: float = field(default_factory=lambda: min(0.2 * n_cores(), 1.0))
    latency: Mapping[str, float] = field(default_factory=dict)
    clutter: Literal["none", "industrial"] = "none"
    n_distractor_cables: int = 0
    n_occluders: int = 0
    occluder_size: tuple[float, float, float] = (0.12, 0.08, 0.12)
    rod_color: tuple[float, float, float] = SceneConfig.rod_color
    quality: Literal["fast", "high"] = "fast"
    seed: int = 0
    board: Gripper | None = None
    board_spec: BoardSpec = field(default_factory=BoardSpec)
    T_tcp_board: Array | None = None

    def __post_init__(self) -> None:
        for name in ("cameras", "controllers", "occluder_size", "rod_color"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if len(self.controllers) != 2 or self.controllers[0] == self.controllers[1]:
            raise ValueError(f"controllers: expected two addresses, got {self.controllers}")
        for side, address in zip(SIDES, self.controllers, strict=True):
            check_loopback(address, f"controllers {side}")
        check_loopback(self.address, "address")
        if not 0 <= self.port < 65536:
            raise ValueError(f"port: expected 0 to 65535, got {self.port}")
        if not 0.0 < self.rate <= LARGEST_RATE:
            raise ValueError(f"rate: expected 0 < rate <= {LARGEST_RATE:.0f} Hz, got {self.rate}")
        if not 0.0 < self.drawing_share <= 1.0:
            raise ValueError(f"drawing_share: expected 0 < share <= 1, got {self.drawing_share}")
        if not (isfinite(self.overstretch_stiffness) and self.overstretch_stiffness > 0):
            raise ValueError(
                "overstretch_stiffness: expected a positive number [N/m],"
                f" got {self.overstretch_stiffness}"
            )
        names = [camera.name for camera in self.cameras]
        for name, seconds in self.latency.items():
            if name not in names:
                raise ValueError(
                    f"latency: there is no camera {name!r}; there are: {', '.join(names)}"
                )
            check_seconds(seconds, f"latency {name}")
        self.rod.check_n_elements(self.n_elements)
        if self.n_elements < 2:
            raise ValueError(f"n_elements: expected at least 2, got {self.n_elements}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")
        if self.board not in (None, *SIDES):
            raise ValueError(f"board: expected left, right or None, got {self.board!r}")
        if self.T_tcp_board is not None:
            given = check_single_pose(self.T_tcp_board, "T_tcp_board")
            object.__setattr__(self, "T_tcp_board", given)
        _ = self.scene

    @property
    def scene(self) -> SceneConfig:
        """What the cameras see."""
        # The rasteriser leaves the processor to the robots; it draws no boards and no shadows.
        simple = self.board is None and self.quality == "fast"
        return SceneConfig(
            cameras=self.cameras,
            renderer="raster" if simple else "opengl",
            rod_radius=float(np.max(self.rod.radius)),
            n_nodes=self.n_elements + 1 if self.board is None else 0,
            boards=() if self.board is None else (self._plate(self.board),),
            rod_color=self.rod_color,
            clutter=self.clutter,
            n_distractor_cables=self.n_distractor_cables,
            n_occluders=self.n_occluders,
            occluder_size=self.occluder_size,
            quality=self.quality,
            seed=self.seed,
            arms=self.dual_arm,
        )

    def board_mount(self, side: Gripper) -> Array:
        """``T_tcp_board`` (4, 4) of the board when this side's gripper carries it."""
        if self.T_tcp_board is not None:
            return self.T_tcp_board
        rng = np.random.default_rng([self.seed, SIDES.index(side)])
        metres, radians = _GRIPPED_OFF
        turn = exp_so3(radians * rng.standard_normal(3))
        return nominal_mount(self.board_spec) @ pose(turn, metres * rng.standard_normal(3))

    def _plate(self, side: Gripper) -> BoardPlate:
        picture = self.board_spec.image(_PIXELS_PER_SQUARE)
        return BoardPlate(side, picture, self.board_spec.size_m, self.board_mount(side))

    @property
    def url(self) -> str:
        """Of the page that shows all cameras."""
        return f"http://{self.address}:{self.port}"

    @classmethod
    def of_cell(cls, cell: CellConfig, **options: Any) -> "WorldConfig":
        """The world that imitates a cell, with the fields named in ``options`` set besides.

        Where its cameras are MJPEG streams on loopback, the world serves there; a real cell's
        cameras are served at the default address.
        """
        for camera in cell.cameras.values():
            where = urlsplit(str(camera.device))
            if where.scheme == "http" and is_loopback(where.hostname or ""):
                options = {"address": where.hostname, "port": where.port or 80} | options
                break
        left, right = (cell.arms[side].address for side in SIDES)  # type: ignore[index]
        return cls(
            **{
                "rod": cell.rod.properties,
                "n_elements": cell.tracker.n_nodes - 1,
                "dual_arm": cell.dual_arm,
                "cameras": cell.camera_models,
                "controllers": (left, right),
            }
            | options
        )

    def to_json(self) -> str:
        """One line that ``from_json`` reads."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        values["cameras"] = [
            {one.name: getattr(camera, one.name) for one in fields(CameraModel)}
            for camera in self.cameras
        ]
        values["rod"] = asdict(self.rod)
        values["board_spec"] = asdict(self.board_spec)
        values["dual_arm"] = {one.name: getattr(self.dual_arm, one.name) for one in fields(DualArm)}
        values["latency"] = dict(self.latency)
        return json.dumps(values, default=lambda array: array.tolist())

    @classmethod
    def from_json(cls, text: str) -> "WorldConfig":
        """From a JSON object of any of the fields.

        Raises:
            ValueError: if the text is no JSON object, or on an unknown field or a wrong value.
        """
        values = json.loads(text)
        if not isinstance(values, dict):
            raise ValueError(f"world: expected a JSON object, got {type(values).__name__}")
        known = {one.name for one in fields(cls)}
        if unknown := set(values) - known:
            raise ValueError(f"world: unknown {sorted(unknown)}; there are: {sorted(known)}")
        parts = {
            "rod": lambda value: RodProperties(**value),
            "board_spec": lambda value: BoardSpec(**value),
            "dual_arm": lambda value: DualArm(**value),
            "cameras": lambda value: tuple(CameraModel(**camera) for camera in value),
        }
        try:
            return cls(
                **{
                    name: parts[name](value) if name in parts else value
                    for name, value in values.items()
                }
            )
        except TypeError as error:
            raise ValueError(f"world: {error}") from error

    def behind(self, left: str, right: str) -> "WorldConfig":
        """The same world behind other controllers."""
        return replace(self, controllers=(left, right))

    def carrying(self, board: Gripper | None) -> "WorldConfig":
        """The same world with the board in that gripper; with the rod in both for None."""
        return replace(self, board=board)

    def moved_to(self, address: str, port: int) -> "WorldConfig":
        """The same world, served elsewhere."""
        return replace(self, address=address, port=port)


def check_seconds(value: Any, name: str, largest: float = LARGEST_LATENCY) -> float:
    """``value`` as a duration from 0 to ``largest`` [s].

    Raises:
        ValueError: if it is no such number.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0.0 <= value <= largest:
        raise ValueError(f"{name}: expected 0 to {largest:g} s, got {value!r}")
    return float(value)
