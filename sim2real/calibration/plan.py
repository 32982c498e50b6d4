"""Where to hold the board: reachable, clear of everything, seen, and turned many ways."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError, UnreachablePose
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, exp_so3, inverse, pose, transform_points
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.clearance import (
    CAPSULE_FRAMES,
    CAPSULE_RADII,
    capsule_axes,
    segment_distances,
)
from dlo_gym.scene.ur5e import ik_branches, link_frames, nearest_turn
from sim2real.calibration.board import BoardSpec

DEFAULT_REGION = ((-0.25, -0.3, 0.22), (0.25, 0.12, 0.5))
_TILT = np.radians([15.0, 35.0])
_LEAST_COSINE = 0.5  # between the board's normal and the ray that sees it
_MARGIN_PX = 10.0
_CLEARANCE = 0.03  # of arms and board to anything else [m]
_TABLE_CLEARANCE = 0.06
_LARGEST_TURN = 2.4  # of any joint, away from home [rad]
_PATH_STEP = 0.1  # between two checked points of a joint-space path [rad]
_TRIES_PER_POSE = 400
_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class PlannedPose:
    """One place to hold the board.

    Attributes:
        joint_angles: (6,) of the arm that carries it [rad].
        T_base_tcp: (4, 4) of its tool centre point.
        cameras: names of those that should see the board there.
    """

    joint_angles: Array
    T_base_tcp: Array
    cameras: tuple[str, ...]


def nominal_mount(board: BoardSpec, distance: float = 0.03) -> Array:
    """``T_tcp_board`` (4, 4) of a board held by a short side, out from the fingertips.

    The board's x runs along the TCP's z, its middle line through the TCP; it faces along the TCP's
    x, the direction in which the fingers close. Planning needs this only roughly; the true place is
    found by the calibration.

    Args:
        board: that is carried.
        distance: from the TCP to the pattern [m].
    """
    rotation = np.column_stack([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    half_height = np.array([0.0, board.size_m[1] / 2, 0.0])
    return pose(rotation, np.array([0.0, 0.0, distance]) - rotation @ half_height)


def plan_poses(
    arms: DualArm,
    cameras: Sequence[CameraModel],
    side: str,
    board: BoardSpec,
    n: int,
    rng: np.random.Generator,
    *,
    T_tcp_board: Array | None = None,
    region: ArrayLike = DEFAULT_REGION,
    start: ArrayLike | None = None,
    parked: ArrayLike | None = None,
) -> list[PlannedPose]:
    """Poses for one arm, in an order whose joint-space moves collide with nothing.

    Args:
        arms: kinematics and rough base poses.
        cameras: with rough poses; each gets about as many views.
        side: the arm that carries the board; the other stays parked.
        board: that is carried.
        n: poses wanted; fewer come back where the cell does not allow as many.
        rng: draws the poses.
        T_tcp_board: (4, 4) about where the board is held; ``nominal_mount`` when omitted.
        region: (2, 3) lowest and highest corner of the box for the board's middle, world [m].
        start: (6,) the arm's joint angles before the first move [rad]; home when omitted.
        parked: (6,) the other arm's joint angles [rad]; home when omitted.

    Raises:
        ValueError: on an unknown side.
        UnreachablePose: if fewer than 5 poses are found.
    """
    if side not in SIDES:
        raise ValueError(f"side: expected one of {', '.join(SIDES)}, got {side!r}")
    index = SIDES.index(side)
    mount = nominal_mount(board) if T_tcp_board is None else T_tcp_board
    cell = _Cell(arms, tuple(cameras), index, board, mount, _joints(arms, index, parked))
    low, high = np.asarray(region, dtype=np.float64)
    at = arms.home[index] if start is None else np.asarray(start, dtype=np.float64)
    ordered: list[PlannedPose] = []
    left: list[PlannedPose] = []
    # To some poses no clear way leads; those that are drawn next may also open one.
    for _ in range(_ROUNDS):
        missing = n - len(ordered)
        if missing == 0:
            break
        for k in range(missing + missing // 4 + 1):
            camera = len(ordered) + k
            for _ in range(_TRIES_PER_POSE):
                planned = cell.at(cell.facing(camera, rng.uniform(low, high), rng))
                if planned is not None and cell.camera_name(camera) in planned.cameras:
                    left.append(planned)
                    break
        if not left:
            break
        before = len(ordered)
        ordered += cell.tour(left, at)[:missing]
        at = ordered[-1].joint_angles if ordered else at
        left = [one for one in left if not any(one is other for other in ordered[before:])]
    if len(ordered) < 5:
        raise UnreachablePose(
            f"{side} arm: only {len(ordered)} of {n} board poses can be reached and seen; move the"
            " cameras or the region, or collect by hand (--by-hand)"
        )
    return ordered


def check_tour(
    arms: DualArm,
    side: str,
    board: BoardSpec,
    stops: Sequence[PlannedPose],
    *,
    start: ArrayLike,
    parked: ArrayLike,
    T_tcp_board: Array | None = None,
) -> None:
    """Refuses a tour, begun anywhere, on which the arm or its board would come close to anything.

    Args as `plan_poses` takes them; ``stops`` are what is left to visit.

    Raises:
        UnreachablePose: naming the stop that cannot be reached clear.
    """
    index = SIDES.index(side)
    mount = nominal_mount(board) if T_tcp_board is None else T_tcp_board
    cell = _Cell(arms, (), index, board, mount, _joints(arms, index, parked))
    at = np.asarray(start, dtype=np.float64)
    for k, stop in enumerate(stops):
        if not cell.path_is_clear(at, stop.joint_angles):
            where = "from where it is" if k == 0 else f"from stop {k}"
            raise UnreachablePose(
                f"{side} arm: the way {where} to stop {k + 1} of {len(stops)} comes within"
                f" {1e3 * _CLEARANCE:.0f} mm of something; drive both arms to their home poses, or"
                " delete the plan to make a new one"
            )
        at = stop.joint_angles


def save_plan(path: Path, plan: Sequence[PlannedPose]) -> None:
    """Writes a plan as JSON, to go on with it after an interruption."""
    content = [
        {
            "joint_angles": stop.joint_angles.tolist(),
            "T_base_tcp": stop.T_base_tcp.tolist(),
            "cameras": list(stop.cameras),
        }
        for stop in plan
    ]
    with written_aside(path, DloError) as part:
        part.write_text(json.dumps(content, indent=1))


def load_plan(path: Path) -> list[PlannedPose]:
    """Reads what ``save_plan`` wrote.

    Raises:
        DloError: naming the file, if it is no plan.
    """
    try:
        return [
            PlannedPose(
                np.array(stop["joint_angles"], dtype=np.float64).reshape(6),
                np.array(stop["T_base_tcp"], dtype=np.float64).reshape(4, 4),
                tuple(stop["cameras"]),
            )
            for stop in json.loads(path.read_text())
        ]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DloError(f"{path}: cannot be read as a plan of board poses: {error}") from error


def _joints(arms: DualArm, index: int, parked: ArrayLike | None) -> Array:
    joints = arms.home.copy()
    if parked is not None:
        joints[1 - index] = np.asarray(parked, dtype=np.float64)
    return joints


@dataclass(frozen=True, eq=False)
class _Cell:
    arms: DualArm
    cameras: tuple[CameraModel, ...]
    side: int
    board: BoardSpec
    T_tcp_board: Array
    joints: Array  # (2, 6), of which the other arm's stay

    def camera_name(self, k: int) -> str:
        return self.cameras[k % len(self.cameras)].name

    def facing(self, k: int, centre: Array, rng: np.random.Generator) -> Array:
        """T_world_board facing camera k, or on every third turn between all, and tilted."""
        towards = np.array([centre - camera.centre for camera in self.cameras])
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cycle = k // len(self.cameras)
        z = towards.mean(axis=0) if cycle % 3 == 2 else towards[k % len(self.cameras)]
        z = z / np.linalg.norm(z)
        x = np.cross(rng.standard_normal(3), z)
        x /= np.linalg.norm(x)
        around = rng.uniform(0.0, 2.0 * np.pi)
        tilt = rng.uniform(*_TILT) * np.array([np.cos(around), np.sin(around), 0.0])
        rotation = np.column_stack([x, np.cross(z, x), z]) @ exp_so3(tilt)
        return pose(rotation, centre - rotation @ self.board.centre)

    def at(self, T_world_board: Array) -> PlannedPose | None:
        """The pose that holds the board there, or None if the cell does not allow it."""
        seen = tuple(c.name for c in self.cameras if self._faces(c, T_world_board))
        if not seen:
            return None
        T_world_tcp = T_world_board @ inverse(self.T_tcp_board)
        T_base_tcp = inverse(self.arms.T_world_base[self.side]) @ T_world_tcp
        home = self.arms.home[self.side]
        T_base_flange = T_base_tcp @ inverse(self.arms.T_flange_tcp[self.side])
        branches = ik_branches(T_base_flange, home[5])
        branches = nearest_turn(branches[np.isfinite(branches[:, 0])], home)
        turns = np.abs(branches - home).max(axis=1, initial=0.0)
        for branch in branches[np.argsort(turns)]:
            if np.abs(branch - home).max() > _LARGEST_TURN or not self.is_clear(branch):
                continue
            seen = tuple(c.name for c in self.cameras if c.name in seen and self._sight(c, branch))
            return PlannedPose(branch, T_base_tcp, seen) if seen else None
        return None

    def _faces(self, camera: CameraModel, T_world_board: Array) -> bool:
        corners = transform_points(T_world_board, self.board.corners)
        pixels = camera.project(corners)
        inside = (pixels > _MARGIN_PX) & (
            pixels < [camera.width, camera.height] - np.array(_MARGIN_PX)
        )
        rays = corners.mean(axis=0) - camera.centre
        cosine = float(rays @ T_world_board[:3, 2] / np.linalg.norm(rays))
        return bool(cosine > _LEAST_COSINE and inside.all(axis=1).mean() > 0.7)

    def _capsules(self, joint_angles: Array) -> tuple[Array, Array]:
        """Ends (2, n, 2, 3) of both arms' capsules in the world, and the board's frame (4, 4)."""
        joints = self.joints.copy()
        joints[self.side] = joint_angles
        axes = capsule_axes(self.arms.T_world_base, joints)
        T_world_flange = self.arms.T_world_base[self.side] @ link_frames(joint_angles)[6]
        return axes, T_world_flange @ self.arms.T_flange_tcp[self.side] @ self.T_tcp_board

    def is_clear(self, joint_angles: Array) -> bool:
        """Whether arms and board keep their distance to each other and the table."""
        joints = self.joints.copy()
        joints[self.side] = joint_angles
        clearance = self.arms.clearance(joints)
        if clearance.within_arm.min() < 0.0 or clearance.between_arms < _CLEARANCE:
            return False
        ends, T_world_board = self._capsules(joint_angles)
        lines = transform_points(T_world_board, self._board_lines())
        lowest = min(float(clearance.to_table.min()), float(lines[..., 2].min()))
        if lowest < _TABLE_CLEARANCE:
            return False
        other = segment_distances(lines[:, None], ends[1 - self.side]) - CAPSULE_RADII
        # The gripper itself may touch the board that it holds.
        arm = CAPSULE_FRAMES < 5
        own = segment_distances(lines[:, None], ends[self.side][arm]) - CAPSULE_RADII[arm]
        return bool(min(other.min(), own.min()) > _CLEARANCE)

    def _board_lines(self) -> Array:
        """Segments (m, 2, 3) along the plate, near enough to each other for a capsule."""
        width, height = self.board.size_m
        return np.array([[(0.0, y, 0.0), (width, y, 0.0)] for y in np.linspace(0.0, height, 4)])

    def _sight(self, camera: CameraModel, joint_angles: Array) -> bool:
        """Whether no arm stands between the camera and the board's middle and corners."""
        ends, T_world_board = self._capsules(joint_angles)
        width, height = self.board.size_m
        spots = [(0.5, 0.5), (0.15, 0.15), (0.85, 0.15), (0.15, 0.85), (0.85, 0.85)]
        points = transform_points(T_world_board, [(x * width, y * height, 0.0) for x, y in spots])
        rays = np.stack([np.broadcast_to(camera.centre, points.shape), points], axis=1)
        gaps = segment_distances(rays[:, None], ends.reshape(-1, 2, 3)) - np.tile(CAPSULE_RADII, 2)
        return bool(gaps.min() > 0.0)

    def tour(self, poses: Sequence[PlannedPose], at: Array) -> list[PlannedPose]:
        """By nearest neighbours as far as clear ways lead."""
        left, ordered = list(poses), []
        while left:
            left.sort(key=lambda one: float(np.abs(one.joint_angles - at).max()))
            following = (
                k for k, one in enumerate(left) if self.path_is_clear(at, one.joint_angles)
            )
            k = next(following, None)
            if k is None:
                break
            ordered.append(left.pop(k))
            at = ordered[-1].joint_angles
        return ordered

    def path_is_clear(self, start: Array, end: Array) -> bool:
        steps = int(np.ceil(np.abs(end - start).max() / _PATH_STEP)) + 1
        return all(self.is_clear(start + t * (end - start)) for t in np.linspace(0, 1, steps + 1))
