"""What is true of the world at the moments its pictures show, to hold estimates against."""

import json
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.arms import SIDES
from sim2real.emulator.drawing import Drawn, Snapshot
from sim2real.emulator.world_config import Gripper

KEPT = 120.0  # [s]
MOST_AT_ONCE = 200  # entries of one answer


@dataclass(frozen=True, eq=False)
class WorldTruth:
    """The world at the stamp of a set of pictures.

    Attributes:
        stamp: monotonic [s], the very X-Timestamp of the pictures.
        centerline: (n_nodes, 3) in world [m]; (0, 3) where no rod is held.
        visible: by camera, (n_nodes,) which nodes it saw.
        boundary: the clamp poses.
        joint_angles: (2, 6) of the left and the right arm [rad].
        wrenches: (2, 6) of the clamps on the rod, world axes [N], [N m].
        problem: why the rod is in no equilibrium (overstretched); empty if it is.
        board: side of the gripper that carries a calibration board; None if none does.
    """

    stamp: float
    centerline: Array
    visible: Mapping[str, NDArray[np.bool_]]
    boundary: BoundaryPoses
    joint_angles: Array
    wrenches: Array
    problem: str
    board: Gripper | None = None

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> "WorldTruth":
        """From one object of the ``/truth`` page."""
        return cls(
            stamp=value["stamp"],
            centerline=np.array(value["centerline"], dtype=np.float64).reshape(-1, 3),
            visible={name: np.array(seen, dtype=bool) for name, seen in value["visible"].items()},
            boundary=BoundaryPoses(*(np.array(value["clamps"][side]) for side in SIDES)),
            joint_angles=np.array([value["joints"][side] for side in SIDES]),
            wrenches=np.array([value["wrenches"][side] for side in SIDES]),
            problem=value["problem"],
            board=value["board"],
        )


class TruthHistory:
    """The last two minutes of truth as JSON text; safe to share between threads."""

    def __init__(self) -> None:
        self._entries: deque[tuple[float, str]] = deque()
        self._lock = threading.Lock()

    def add(self, snapshot: Snapshot, drawn: Mapping[str, Drawn]) -> None:
        """Notes the truth of one set of pictures."""
        stamp, text = round(snapshot.stamp, 6), _text(snapshot, drawn)
        with self._lock:
            self._entries.append((stamp, text))
            while self._entries[0][0] < stamp - KEPT:
                self._entries.popleft()

    def newest(self) -> str | None:
        """A JSON object, or None if nothing was drawn yet."""
        with self._lock:
            return self._entries[-1][1] if self._entries else None

    def since(self, stamp: float) -> str:
        """The entries later than ``stamp``, oldest first, as a JSON object with ``history`` and
        ``more``: whether there are more than fit into one answer."""
        with self._lock:
            later = [text for when, text in self._entries if when > stamp]
        more = "true" if len(later) > MOST_AT_ONCE else "false"
        return f'{{"more": {more}, "history": [{", ".join(later[:MOST_AT_ONCE])}]}}'


def _text(snapshot: Snapshot, drawn: Mapping[str, Drawn]) -> str:
    boundary = snapshot.shape.boundary
    assert boundary.right is not None
    value = {
        "stamp": round(snapshot.stamp, 6),
        "centerline": np.round(snapshot.shape.positions, 6).tolist(),
        "visible": {name: one.visible.tolist() for name, one in drawn.items()},
        "clamps": _by_side([boundary.left, boundary.right], 9),
        "joints": _by_side(snapshot.joint_angles, 7),
        "wrenches": _by_side(snapshot.shape.wrenches, 6),
        "problem": snapshot.shape.problem,
        "board": snapshot.board,
    }
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _by_side(values: Any, digits: int) -> dict[str, Any]:
    return {
        side: np.round(value, digits).tolist() for side, value in zip(SIDES, values, strict=True)
    }
