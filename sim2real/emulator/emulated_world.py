"""Starts, asks and stops the simulated world's process."""

import http.client
import json
import os
import selectors
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from types import TracebackType
from typing import IO, Any, Self
from urllib.parse import urlsplit

from dlo_gym.exceptions import DeviceError
from sim2real.emulator.truth import WorldTruth
from sim2real.emulator.world_config import Gripper, WorldConfig

START_TIMEOUT = 60.0  # the first start on a machine compiles the rod's kernels [s]
STOP_TIMEOUT = 5.0
_ANSWER_TIMEOUT = 5.0
# The robots need the processor's cores more than NumPy and the rasteriser do.
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
    "MUJOCO_GL": "egl",
}


class EmulatedWorld:
    """The world as a process of its own; a context manager that starts and stops it.

    Args:
        config: of the world.
        log: where the process writes what went wrong; this process's stderr when omitted.

    Attributes:
        config: of the world.
        url: where it serves, from ``wait`` on.
    """

    def __init__(self, config: WorldConfig | None = None, *, log: IO[Any] | None = None) -> None:
        self.config = WorldConfig() if config is None else config
        self.url = self.config.url
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Launches the process and waits until it serves.

        Raises:
            DeviceError: if it ended or took too long.
        """
        self.launch()
        self.wait()

    def launch(self) -> None:
        """Launches the process without waiting for it."""
        if self._process is not None:
            raise DeviceError("the world's process has been started before")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim2real.emulator.world", "--config", "-"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=_ENVIRONMENT | os.environ,
            # Ctrl-C is the starter's: it may have arms to stop before the world may go.
            start_new_session=True,
        )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it ended at once; ``wait`` says so
            self._process.stdin.write(self.config.to_json().encode())
            self._process.stdin.close()

    def wait(self, timeout: float = START_TIMEOUT) -> None:
        """Waits until the launched process serves.

        Raises:
            DeviceError: if it ended or took longer than ``timeout`` [s]; it is stopped then.
        """
        process = self._running()
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            ready = selector.select(timeout)
        line = process.stdout.readline() if ready else b""
        if not line:
            self.stop()
            ended = f"ended with status {process.returncode}" if ready else "did not get ready"
            raise DeviceError(
                f"the simulated world at {self.config.url} {ended} within {timeout:g} s;"
                " what it wrote says why"
            )
        self.url = json.loads(line)["url"]

    def stop(self) -> None:
        """Ends the process; stopping twice does no harm."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()

    @property
    def pid(self) -> int:
        """Of the process.

        Raises:
            DeviceError: if it is not running.
        """
        return self._running().pid

    def status(self) -> dict[str, Any]:
        """The ``/status`` page."""
        return self._json("GET", "/status")

    def picture(self, camera: str) -> bytes:
        """The newest picture of a camera, a JPEG file."""
        return self._request("GET", f"/{camera}.jpg")

    def fault(self, camera: str, **faults: float | bool) -> dict[str, Any]:
        """Lets a camera ``freeze=`` or ``drop=`` for some seconds, changes its ``latency=`` [s],
        or ends its faults with ``clear=True``."""
        return self._json("POST", "/fault", {"camera": camera, **faults})

    def settle(self) -> None:
        """Hangs the rod anew between the grippers, whatever its past."""
        self._json("POST", "/settle", {})

    def carry(self, board: Gripper | None) -> None:
        """Puts the calibration board into a gripper in place of the rod; None brings the rod back.

        Pictures and truth follow as soon as the new scene is drawn.
        """
        self._json("POST", "/board", {"side": board})

    def truth(self, stamp: float | None = None) -> WorldTruth:
        """What was true at a picture's ``stamp``, nearest in time; of the newest when omitted.

        Raises:
            DeviceError: if the world does not answer or has nothing of that time.
        """
        if stamp is None:
            return WorldTruth.from_json(self._json("GET", "/truth"))
        nearest = None
        for truth in self.truths(stamp - 1.0, pages=1):
            if nearest is None or abs(truth.stamp - stamp) < abs(nearest.stamp - stamp):
                nearest = truth
        if nearest is None or abs(nearest.stamp - stamp) > 1.0:
            raise DeviceError(f"the simulated world knows no truth of the time {stamp:.3f} s")
        return nearest

    def truths(self, since: float, *, pages: int | None = None) -> Iterator[WorldTruth]:
        """The truth of every set of pictures later than ``since``, oldest first."""
        while pages is None or pages > 0:
            page = self._json("GET", f"/truth?since={since!r}")
            for entry in page["history"]:
                since = entry["stamp"]
                yield WorldTruth.from_json(entry)
            if not page["more"]:
                return
            pages = None if pages is None else pages - 1

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise DeviceError("the simulated world is not running")
        return self._process

    def _json(self, method: str, path: str, body: Any = None) -> dict[str, Any]:
        return json.loads(self._request(method, path, body))

    def _request(self, method: str, path: str, body: Any = None) -> bytes:
        where = urlsplit(self.url)
        connection = http.client.HTTPConnection(
            where.hostname or "", where.port, timeout=_ANSWER_TIMEOUT
        )
        try:
            connection.request(method, path, None if body is None else json.dumps(body))
            response = connection.getresponse()
            answer = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise DeviceError(f"the simulated world at {self.url} does not answer: {error}") from (
                error
            )
        finally:
            connection.close()
        if response.status == 400:
            raise ValueError(json.loads(answer)["error"])
        if response.status != 200:
            raise DeviceError(f"the simulated world: {path}: {answer.decode(errors='replace')}")
        return answer
