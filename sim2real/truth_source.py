"""The emulated world's true shape of the cable, over HTTP; a real cell has no such thing."""

import json
import time
import urllib.error
import urllib.request

from dlo_gym.exceptions import DeviceError
from sim2real.emulator.truth import WorldTruth

TOLERANCE = 1e-4  # between the stamps of images and their truth [s]


class TruthSource:
    """Asks for the truth at the stamp of images.

    Args:
        url: of the world's ``/truth`` page.
    """

    def __init__(self, url: str, timeout: float = 2.0) -> None:
        self.url = url
        self.timeout = timeout

    def at(self, stamp: float) -> WorldTruth:
        """The truth at the monotonic time ``stamp`` [s] of images that the world rendered.

        Raises:
            DeviceError: if the world does not answer, holds no cable, or knows nothing of that
                time.
        """
        deadline = time.monotonic() + self.timeout
        while True:
            for truth in self._since(stamp - TOLERANCE):
                if abs(truth.stamp - stamp) < TOLERANCE:
                    return self._of_a_cable(truth)
            if time.monotonic() > deadline:
                raise DeviceError(f"{self.url}: knows no truth of {stamp:.6f} s")
            time.sleep(0.01)

    def newest(self) -> WorldTruth:
        """The truth of the newest images.

        Raises:
            DeviceError: if the world does not answer, or holds no cable.
        """
        return self._of_a_cable(WorldTruth.from_json(self._get(self.url)))

    def _of_a_cable(self, truth: WorldTruth) -> WorldTruth:
        if truth.board is not None:
            raise DeviceError(
                f"{self.url}: the {truth.board} gripper carries a calibration board and there is no"
                " cable; type  board none  where the cell is emulated"
            )
        return truth

    def _since(self, stamp: float) -> list[WorldTruth]:
        history = self._get(f"{self.url}?since={stamp:.6f}")["history"]
        return [WorldTruth.from_json(entry) for entry in history[:2]]

    def _get(self, url: str) -> dict:
        try:
            with urllib.request.urlopen(url, timeout=self.timeout) as reply:
                return json.load(reply)
        except (OSError, urllib.error.URLError, ValueError) as error:
            raise DeviceError(f"{self.url}: no truth from the emulated world: {error}") from error
