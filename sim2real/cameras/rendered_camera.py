"""A camera that looks at the simulated cell: tests and dry runs without a socket."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.rod.state import RodState
from dlo_gym.scene.builder import SceneConfig
from dlo_gym.scene.renderer import SceneRenderer
from sim2real.cameras.camera import Frame
from sim2real.cameras.capture import EndOfStreamError, Shot, StreamCamera
from sim2real.cameras.frame_buffer import FrameBuffer


class RenderedCamera(StreamCamera):
    """Draws the scene as it is at each image's stamp.

    Everything that touches OpenGL, whose contexts belong to a thread, happens in the capture
    thread.

    Args:
        model: the camera's size, intrinsics and place.
        state: gives the rod as it is now; called in the capture thread.
        scene: what else stands in the cell; its cameras are not used.
        rate_hz: of a free-running camera; None draws one image each time ``latest`` or
            ``frames`` is called, and at no other time.
        timeout: silence after which ``latest`` refuses [s].
    """

    open_timeout = 30.0  # a first OpenGL context compiles its shaders [s]

    def __init__(
        self,
        model: CameraModel,
        state: Callable[[], RodState],
        scene: SceneConfig | None = None,
        *,
        rate_hz: float | None = None,
        timeout: float = 2.0,
    ) -> None:
        super().__init__(model, timeout=timeout, rate_hz=rate_hz)
        self._state = state
        self._scene = replace(SceneConfig() if scene is None else scene, cameras=(model,))
        self._wanted = threading.Event()

    def _connect(self) -> "_RenderedSource":
        wanted = self._wanted if self.rate_hz is None else None
        return _RenderedSource(self._scene, self._state, self.rate_hz, wanted)

    def _first_frame(self, buffer: FrameBuffer) -> bool:
        self._wanted.set()
        return super()._first_frame(buffer)

    def latest(self) -> Frame:
        """A new image of the scene, or the newest of a free-running camera.

        Raises:
            DeviceError: if none came within the timeout, or the camera is not open.
        """
        self._draw()
        return super().latest()

    def frames(self, since: float) -> list[Frame]:
        """The buffered frames with a stamp after ``since`` [s], one drawn for this call included.

        Raises:
            DeviceError: if the camera is not open.
        """
        self._draw()
        return super().frames(since)

    def _draw(self) -> None:
        if self.rate_hz is None:
            buffer = self._buffer()
            n_frames = buffer.n_frames + 1
            self._wanted.set()
            if not buffer.wait(n_frames, self.timeout):
                because = f": {buffer.failure}" if buffer.failure else ""
                raise DeviceError(
                    f"camera {self.model.name!r}: no new frame for {self.timeout:g} s{because}"
                )


class _RenderedSource:
    """One OpenGL context."""

    def __init__(
        self,
        scene: SceneConfig,
        state: Callable[[], RodState],
        rate_hz: float | None,
        wanted: threading.Event | None,
    ) -> None:
        self._renderer = SceneRenderer(scene)
        self._camera = scene.cameras[0].name
        self._state = state
        self._period = None if rate_hz is None else 1.0 / rate_hz
        self._wanted = wanted
        self._interrupted = threading.Event()
        self._due = time.monotonic()

    def read(self) -> Shot:
        self._wait()
        if self._interrupted.is_set():
            raise EndOfStreamError("the camera was closed")
        stamp = time.monotonic()
        state = self._state()
        self._renderer.update(state.positions, state.boundary)
        return Shot(self._renderer.render(self._camera, stamp).image, stamp)

    def _wait(self) -> None:
        if self._wanted is not None:
            self._wanted.wait()
            self._wanted.clear()
        elif self._period is not None:
            self._interrupted.wait(max(self._due - time.monotonic(), 0.0))
            self._due = max(self._due, time.monotonic() - self._period) + self._period

    def interrupt(self) -> None:
        self._interrupted.set()
        if self._wanted is not None:
            self._wanted.set()

    def close(self) -> None:
        self._renderer.close()
