"""A cell in the rerun viewer: shapes in space, arms, cameras with their images, plots, a log."""

import os
import shutil
import socket
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dlo_gym.exceptions import MissingExtra, RenderingUnavailable
from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array, matrix_to_quaternion
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.obstacles import Box, Capsule, Obstacle, Sphere
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.cell_model import TABLE_CENTRE, TABLE_HALF_SIZE
from dlo_gym.scene.clearance import CAPSULE_RADII, capsule_axes

JPEG_QUALITY = 80
RADIUS = 0.0025  # of lines in space [m]
AXIS = 0.05  # of the grippers' frames [m]
IMAGE_PLANE = 0.2  # from a camera to its image in space [m]
ARM = (150, 160, 175, 255)
OBSTACLE = (230, 160, 20, 255)
TABLE = (110, 110, 115, 255)
TABLE_THICKNESS = 0.01  # as drawn [m]
TIMELINE = "run"
PORT = 9876  # of the viewer

Colour = tuple[int, int, int]


class SceneViewer:
    """Shows a cell in the rerun viewer, or writes a file for it.

    Entities are ``world/...`` for what is in space, ``world/cameras/NAME/image/...`` for what is
    in an image; all is shown at the time of the last ``set_time``, or, if static, always.

    Args:
        camera_names: of the cameras, in the order of their images.
        arms: whose links are shown.
        plots: every number ``PLOT/...`` is drawn into the plot of that name.
        spawn: whether to open the viewer; one that runs already is used.
        save: an .rrd file to write instead.

    Raises:
        MissingExtra: if rerun-sdk is not installed.
        RenderingUnavailable: if the viewer has no display to open on.
        FileExistsError: if the file is there already.
        ValueError: if there is neither a viewer nor a file.
    """

    def __init__(
        self,
        camera_names: Sequence[str],
        arms: DualArm,
        plots: Sequence[str] = (),
        *,
        spawn: bool = True,
        save: Path | None = None,
    ) -> None:
        try:
            import rerun as rr
        except ImportError as error:
            raise MissingExtra("rerun-sdk", "view") from error
        if save is None and not spawn:
            raise ValueError("spawn, save: expected a viewer to open or a file to write, got none")
        if save is not None and save.exists():
            raise FileExistsError(f"{save} exists; name another file")
        self._rr, self._arms = rr, arms
        self._stream = rr.RecordingStream("dlo-gym")
        if save is None:
            _open_viewer(rr, self._stream)
        else:
            self._stream.save(save)
        self._stream.send_blueprint(_layout(camera_names, plots))
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        table = rr.Boxes3D(
            centers=[[*TABLE_CENTRE, -TABLE_THICKNESS / 2]],
            half_sizes=[[*TABLE_HALF_SIZE, TABLE_THICKNESS / 2]],
            colors=[TABLE],
            fill_mode="solid",
        )
        self._log("world/table", table, static=True)

    def set_time(self, stamp: float) -> None:
        """What is shown from now on, is so at ``stamp`` [s]."""
        self._stream.set_time(TIMELINE, duration=stamp)

    def show_curve(
        self,
        name: str,
        curve: Array,
        colour: Colour,
        *,
        radius: float = RADIUS,
        static: bool = False,
    ) -> None:
        """A centerline (n, 3) [m] as a line of ``radius`` [m]."""
        strips = self._rr.LineStrips3D([curve], colors=[colour], radii=radius)
        self._log(f"world/{name}", strips, static=static)

    def show_drawn(
        self, name: str, camera: CameraModel, curve: Array, colour: Colour, *, static: bool = False
    ) -> None:
        """The part of a curve (n, 3) [m] in front of a camera, in its image, distorted as that."""
        pixels = camera.project(curve)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        strips = self._rr.LineStrips2D([pixels], colors=[colour])
        self._log(f"world/cameras/{camera.name}/image/{name}", strips, static=static)

    def show_camera(self, camera: CameraModel, *, static: bool = False) -> None:
        rr, at, T = self._rr, f"world/cameras/{camera.name}", camera.T_world_camera
        self._log(at, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=static)
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            width=camera.width,
            height=camera.height,
            image_plane_distance=IMAGE_PLANE,
        )
        self._log(f"{at}/image", pinhole, static=static)

    def show_image(self, view: View) -> None:
        image = self._rr.Image(view.image).compress(jpeg_quality=JPEG_QUALITY)
        self._log(f"world/cameras/{view.camera.name}/image", image)

    def show_clamps(self, boundary: BoundaryPoses) -> None:
        """The clamps that hold the rod, as frames."""
        for side, clamp in zip(SIDES, boundary.clamps, strict=False):
            pose = self._rr.Transform3D(translation=clamp[:3, 3], mat3x3=clamp[:3, :3])
            self._log(f"world/grippers/{side}", pose)
            self._log(f"world/grippers/{side}", self._rr.TransformAxes3D(AXIS))

    def show_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Boxes, and spheres and capsules; planes have no end and are left out."""
        boxes = [body for body in obstacles if isinstance(body, Box)]
        round_ones = [body for body in obstacles if isinstance(body, Sphere | Capsule)]
        self._log(
            "world/obstacles/boxes",
            self._rr.Boxes3D(
                centers=[box.pose[:3, 3] for box in boxes],
                half_sizes=[box.half_size for box in boxes],
                quaternions=[_xyzw(box.pose) for box in boxes],
                colors=[OBSTACLE],
                fill_mode="solid",
            ),
        )
        half = [body.half_length if isinstance(body, Capsule) else 0.0 for body in round_ones]
        places = zip(round_ones, half, strict=True)
        self._log(
            "world/obstacles/capsules",
            self._rr.Capsules3D(
                lengths=2.0 * np.array(half),
                radii=[body.radius for body in round_ones],
                translations=[body.pose[:3, 3] - h * body.pose[:3, 2] for body, h in places],
                quaternions=[_xyzw(body.pose) for body in round_ones],
                colors=[OBSTACLE],
                fill_mode="solid",
            ),
        )

    def show_arms(self, joint_angles: Array) -> None:
        """The links at joint angles (2, 6) [rad], as the capsules that keep their distance."""
        axes = capsule_axes(self._arms.T_world_base, joint_angles)
        for side, ends in zip(SIDES, axes, strict=True):
            along = ends[:, 1] - ends[:, 0]
            capsules = self._rr.Capsules3D(
                lengths=np.linalg.norm(along, axis=1),
                radii=CAPSULE_RADII,
                translations=ends[:, 0],
                quaternions=_from_z(along),
                colors=[ARM],
                fill_mode="solid",
            )
            self._log(f"world/arms/{side}", capsules)

    def show_numbers(self, numbers: Mapping[str, float]) -> None:
        for name, value in numbers.items():
            self._log(name, self._rr.Scalars(float(value)))

    def note(self, text: str, *, level: str = "WARN") -> None:
        """A line in the log."""
        self._log("log", self._rr.TextLog(text, level=level))

    def close(self) -> None:
        """Hands over what is left; the viewer stays open. Closing twice does no harm."""
        with suppress(RuntimeError):  # of a viewer that was closed before
            self._stream.flush()
        self._stream.disconnect()

    def _log(self, entity: str, what: Any, *, static: bool = False) -> None:
        self._stream.log(entity, what, static=static)


def _open_viewer(rr: Any, stream: Any) -> None:
    """Connects to the viewer that runs, or opens one.

    Raises:
        RenderingUnavailable: if none runs and there is no display.
    """
    with socket.socket() as probe:
        probe.settimeout(0.5)
        runs = probe.connect_ex(("127.0.0.1", PORT)) == 0
    display = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if not runs and not display:
        raise RenderingUnavailable(
            "the rerun viewer has no display to open on: neither DISPLAY nor WAYLAND_DISPLAY is"
            " set; write an .rrd file instead (render_file of an environment), or forward the"
            f" port of a viewer elsewhere:  ssh -R {PORT}:localhost:{PORT} ..."
        )
    beside = Path(sys.executable).with_name("rerun")
    executable = str(beside) if beside.exists() else shutil.which("rerun") or "rerun"
    rr.spawn(port=PORT, executable_path=executable, recording=stream)


def _xyzw(T: Array) -> Array:
    return np.roll(matrix_to_quaternion(T[:3, :3]), -1)


def _from_z(vectors: Array) -> Array:
    """Quaternions xyzw (n, 4) that turn the z axis along vectors (n, 3)."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    x, y, z = (vectors / np.maximum(lengths, 1e-12)).T
    halfway = np.stack([-y, x, np.zeros_like(x), 1.0 + z], axis=1)
    halfway[z < -1.0 + 1e-9] = [1.0, 0.0, 0.0, 0.0]
    return halfway / np.linalg.norm(halfway, axis=1, keepdims=True)


def _layout(cameras: Sequence[str], plots: Sequence[str]) -> Any:
    """Images on the left, space in the middle, plots on the right, the log below."""
    import rerun.blueprint as rrb

    images = [
        rrb.Spatial2DView(origin=f"world/cameras/{name}/image", name=name) for name in cameras
    ]
    views = [rrb.TimeSeriesView(origin=name, name=name) for name in plots]
    columns = [rrb.Vertical(*images), rrb.Spatial3DView(origin="world", name="cell")]
    if views:
        columns.append(rrb.Vertical(*views))
    log = rrb.TextLogView(origin="log", name="log")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*columns), log, row_shares=[5, 1]))
