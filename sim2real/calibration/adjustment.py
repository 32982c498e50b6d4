"""All cameras, both bases and the board in both grippers in one least squares.

Minimises the corners' reprojection errors over the cameras' poses (and their intrinsics, if asked
for), a free base, the board's place in each gripper, and a small correction of every reported tool
pose. The corrections carry the arm's own noise: without them every pose would count as exact and
the deviations would come out far too small. How large the noises are is estimated along the way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array, exp_so3, pose
from sim2real.calibration.board import BoardSpec, Detection
from sim2real.calibration.hand_eye import board_pose
from sim2real.calibration.normal_equations import (
    INTRINSICS,
    Noise,
    NormalEquations,
    by_frame,
    covariance_of,
    project,
    transformed,
)
from sim2real.calibration.samples import Sample

# Weak knowledge of every lens, so that what no view shows stays put: focal lengths and principal
# point as a share of the image's width, then k1 k2 p1 p2 k3.
_LENS_PRIOR = np.array([0.2, 0.2, 0.05, 0.05, 0.5, 1.0, 0.02, 0.02, 2.0])
_MOST_STEPS = 40


@dataclass(frozen=True, eq=False)
class CellGeometry:
    """Where everything is.

    Attributes:
        cameras: models by name.
        T_world_base: (4, 4) by arm.
        T_tcp_board: (4, 4) by arm.
    """

    cameras: dict[str, CameraModel]
    T_world_base: dict[str, Array]
    T_tcp_board: dict[str, Array]

    def T_camera_board(self, camera: str, sample: Sample) -> Array:
        """Where a camera must see the board of a sample (4, 4)."""
        T_world_tcp = self.T_world_base[sample.side] @ sample.T_base_tcp
        return self.cameras[camera].T_camera_world @ T_world_tcp @ self.T_tcp_board[sample.side]


_LEAST_NOISE = Noise(0.02, 1e-5, 3e-5)
_MOST_NOISE = Noise(5.0, 5e-3, 2e-2)


class Deviation(NamedTuple):
    """Standard deviation of a pose, all axes together: [mm], [degrees]."""

    mm: float
    deg: float


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The result of ``adjust``.

    Attributes:
        geometry: with all unknowns at their best.
        deviations: of ``camera/<name>``, ``base/<side>`` and ``board/<side>``, as far as free.
        intrinsics_deviations: (9,) by camera, fx fy cx cy k1 k2 p1 p2 k3; empty if they were kept.
        corrections: (k, 6) of the tool poses, rotation vectors [rad] and shifts [m] in tool axes.
        noise: as estimated.
    """

    geometry: CellGeometry
    deviations: dict[str, Deviation]
    intrinsics_deviations: dict[str, Array]
    corrections: Array
    noise: Noise


def adjust(
    board: BoardSpec,
    samples: Sequence[Sample],
    start: CellGeometry,
    *,
    free_bases: Sequence[str] = (),
    fixed_cameras: bool = False,
    refine_intrinsics: bool = False,
    lens_views: Mapping[str, Sequence[Detection]] | None = None,
    noise: Noise | None = None,
) -> Adjustment:
    """Adjusts a cell to samples that hold no gross errors.

    Args:
        board: that was carried.
        samples: at least 3 per arm; empty detections do not count.
        start: close enough that every board projects near where it was seen. Cameras without a
            detection keep their values.
        free_bases: arms whose base is unknown; the world stays fixed to the others.
        fixed_cameras: whether the cameras are known; only where the board sits in each gripper
            and free bases are found then.
        refine_intrinsics: whether K and distortion are unknown too.
        lens_views: by camera, what it saw of a board that was held anywhere, by hand; used where
            the intrinsics are unknown.
        noise: to assume; estimated from the residuals when omitted.

    Raises:
        ValueError: if no sample shows the board, or the unknowns are not determined.
    """
    if fixed_cameras and refine_intrinsics:
        raise ValueError("fixed_cameras: expected not together with refine_intrinsics")
    problem = _Problem(
        board,
        samples,
        start,
        tuple(free_bases),
        0 if fixed_cameras else 6 + INTRINSICS * refine_intrinsics,
        lens_views or {},
    )
    state = _State(start, np.zeros((problem.n_samples + len(problem.by_hand), 6)))
    assumed = Noise() if noise is None else noise
    for _ in range(1 if noise is not None else 5):
        state, normal = problem.minimise(state, assumed)
        covariance = covariance_of(normal.schur)
        if noise is None:
            former, assumed = assumed, problem.estimate_noise(state, normal, covariance, assumed)
            if max(abs(np.log(np.array(assumed) / former))) < 0.05:
                break
    state, normal = problem.minimise(state, assumed)
    covariance = covariance_of(normal.schur)
    deviations, lenses = {}, {}
    for name, columns in problem.blocks.items():
        variances = np.diag(covariance)[columns]
        rotation, shift = (float(np.sqrt(v.sum())) for v in (variances[:3], variances[3:6]))
        deviations[name] = Deviation(1e3 * shift, float(np.degrees(rotation)))
        if len(variances) > 6:
            lenses[name.removeprefix("camera/")] = np.sqrt(variances[6:])
    corrections = state.corrections[: problem.n_samples]
    return Adjustment(state.geometry, deviations, lenses, corrections, assumed)


@dataclass(frozen=True, eq=False)
class _State:
    geometry: CellGeometry
    corrections: Array


class _Problem:
    def __init__(
        self,
        board: BoardSpec,
        samples: Sequence[Sample],
        start: CellGeometry,
        free_bases: tuple[str, ...],
        per_camera: int,
        lens_views: Mapping[str, Sequence[Detection]],
    ) -> None:
        self.board, self.samples, self.start = board, samples, start
        self.n_samples = len(samples)
        self.views = [
            (k, name, detection)
            for k, sample in enumerate(samples)
            for name, detection in sample.detections.items()
            if len(detection)
        ]
        if not self.views:
            raise ValueError("samples: expected some that show the board, got none")
        seen = {name for _, name, _ in self.views}
        sizes = {f"camera/{name}": per_camera for name in sorted(seen) if per_camera}
        sides = sorted({samples[k].side for k, _, _ in self.views})
        sizes |= {f"base/{side}": 6 for side in sides if side in free_bases}
        sizes |= {f"board/{side}": 6 for side in sides}
        ends = np.cumsum([0, *sizes.values()])
        self.blocks = {
            name: slice(int(a), int(b)) for name, a, b in zip(sizes, ends, ends[1:], strict=False)
        }
        self.size = int(ends[-1])
        self.refine_intrinsics = refine_intrinsics = per_camera > 6
        self.by_hand = [
            (name, detection, board_pose(start.cameras[name], board, detection))
            for name in lens_views
            if refine_intrinsics and name in seen
            for detection in lens_views[name]
            if detection.spans_a_plane(board)
        ]

    def minimise(self, state: _State, noise: Noise) -> tuple[_State, NormalEquations]:
        """Levenberg-Marquardt to convergence; the state and its normal equations."""
        normal, damping = self.linearise(state, noise), 1e-6
        for _ in range(_MOST_STEPS):
            schur, gain = normal.schur, normal.gain
            right = normal.b - np.einsum("kcg,kc->g", gain, normal.b_c)
            scale = np.diag(np.maximum(np.diag(schur), 1e-12))
            step = -np.linalg.lstsq(schur + damping * scale, right, rcond=None)[0]
            step_c = -np.linalg.solve(normal.H_c, normal.b_c[..., None])[..., 0] - gain @ step
            candidate = self.moved(state, step, step_c)
            tried = self.linearise(candidate, noise)
            if tried.cost <= normal.cost:
                gained = normal.cost - tried.cost
                state, normal, damping = candidate, tried, max(damping / 10, 1e-9)
                if gained < 1e-9 * (1.0 + normal.cost):
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return state, normal

    def moved(self, state: _State, step: Array, step_c: Array) -> _State:
        geometry = state.geometry
        cameras = dict(geometry.cameras)
        bases, boards = dict(geometry.T_world_base), dict(geometry.T_tcp_board)
        for name, columns in self.blocks.items():
            kind, key = name.split("/", 1)
            change = pose(exp_so3(step[columns][:3]), step[columns][3:6])
            if kind == "camera":
                cameras[key] = _moved_camera(cameras[key], change, step[columns][6:])
            elif kind == "base":
                bases[key] = bases[key] @ change
            else:
                boards[key] = boards[key] @ change
        return _State(CellGeometry(cameras, bases, boards), state.corrections + step_c)

    def linearise(self, state: _State, noise: Noise) -> NormalEquations:
        k, g = len(state.corrections), self.size
        prior = np.tile(np.repeat([noise.rotation_rad, noise.position_m], 3) ** -2.0, (k, 1))
        # A board held by hand may be anywhere; a trace of a prior keeps its equations regular.
        prior[self.n_samples :] = 1e-6
        normal = NormalEquations(
            np.zeros((g, g)),
            np.zeros(g),
            prior[:, :, None] * np.eye(6),
            np.zeros((k, g, 6)),
            state.corrections * prior,
            float((np.square(state.corrections) * prior).sum()),
        )
        for index, name, detection in self.views:
            self._add_view(normal, state, index, name, detection, noise)
        for i, (name, detection, T_camera_board) in enumerate(self.by_hand):
            self._add_view_by_hand(
                normal, state, self.n_samples + i, name, detection, T_camera_board, noise
            )
        if self.refine_intrinsics:
            self._add_lens_priors(normal, state)
        return normal

    def _add_view(
        self,
        normal: NormalEquations,
        state: _State,
        index: int,
        name: str,
        detection: Detection,
        noise: Noise,
    ) -> None:
        sample, geometry = self.samples[index], state.geometry
        camera = geometry.cameras[name]
        correction = state.corrections[index]
        T_base_tcp = sample.T_base_tcp @ pose(exp_so3(correction[:3]), correction[3:])
        T_camera_base = camera.T_camera_world @ geometry.T_world_base[sample.side]
        T_camera_tcp = T_camera_base @ T_base_tcp
        on_board = self.board.corners[detection.ids]
        T_tcp_board = geometry.T_tcp_board[sample.side]
        in_tcp = transformed(T_tcp_board, on_board)
        in_base, in_camera = transformed(T_base_tcp, in_tcp), transformed(T_camera_tcp, in_tcp)
        seen = project(geometry.cameras[name], in_camera, detection, noise)
        if seen is None:
            normal.cost = np.inf
            return
        J = np.zeros((len(in_camera), 2, self.size))
        columns = self.blocks.get(f"camera/{name}", slice(0, 0))
        if columns.stop:
            J[:, :, columns][:, :, :6] = -by_frame(seen.by_point, np.eye(3), in_camera)
        if self.refine_intrinsics:
            J[:, :, columns][:, :, 6:] = seen.by_lens
        if f"base/{sample.side}" in self.blocks:
            R = T_camera_base[:3, :3]
            J[:, :, self.blocks[f"base/{sample.side}"]] = by_frame(seen.by_point, R, in_base)
        R = T_camera_tcp[:3, :3] @ T_tcp_board[:3, :3]
        J[:, :, self.blocks[f"board/{sample.side}"]] = by_frame(seen.by_point, R, on_board)
        normal.add(index, J, by_frame(seen.by_point, T_camera_tcp[:3, :3], in_tcp), seen, noise)

    def _add_view_by_hand(
        self,
        normal: NormalEquations,
        state: _State,
        index: int,
        name: str,
        detection: Detection,
        T_camera_board: Array,
        noise: Noise,
    ) -> None:
        change = state.corrections[index]
        T_camera_board = T_camera_board @ pose(exp_so3(change[:3]), change[3:])
        on_board = self.board.corners[detection.ids]
        in_camera = transformed(T_camera_board, on_board)
        seen = project(state.geometry.cameras[name], in_camera, detection, noise)
        if seen is None:
            normal.cost = np.inf
            return
        J = np.zeros((len(in_camera), 2, self.size))
        J[:, :, self.blocks[f"camera/{name}"]][:, :, 6:] = seen.by_lens
        normal.add(index, J, by_frame(seen.by_point, T_camera_board[:3, :3], on_board), seen, noise)

    def _add_lens_priors(self, normal: NormalEquations, state: _State) -> None:
        for name, camera in state.geometry.cameras.items():
            if f"camera/{name}" not in self.blocks:
                continue
            sigma = _LENS_PRIOR.copy()
            sigma[:4] *= camera.width
            off = _lens_vector(camera) - _lens_vector(self.start.cameras[name])
            columns = self.blocks[f"camera/{name}"]
            lens = np.arange(columns.start + 6, columns.stop)
            normal.H[lens, lens] += sigma**-2.0
            normal.b[lens] += off / sigma**2
            normal.cost += float(np.square(off / sigma).sum())

    def estimate_noise(
        self, state: _State, normal: NormalEquations, covariance: Array, assumed: Noise
    ) -> Noise:
        """Variance components: squared residuals of a kind over how many of them are redundant
        (Förstner and Wrobel, Photogrammetric Computer Vision, 4.2.4)."""
        H_c_inverse = np.linalg.inv(normal.H_c)
        gain = normal.gain
        posterior = np.diagonal(
            H_c_inverse + gain @ covariance @ np.swapaxes(gain, 1, 2), axis1=1, axis2=2
        )
        sigmas = np.repeat([assumed.rotation_rad, assumed.position_m], 3)
        redundant = 1.0 - posterior / sigmas**2
        redundant = redundant[: self.n_samples]
        squares = np.square(state.corrections[: self.n_samples])
        rotation, position = (
            float(np.sqrt(squares[:, part].sum() / max(redundant[:, part].sum(), 1.0)))
            for part in (slice(0, 3), slice(3, 6))
        )
        rows = normal.n_rows - self.size - 6 * len(self.by_hand) - redundant.sum()
        rows = max(rows, 1.0)
        corner = assumed.corner_px * float(np.sqrt(normal.squares / rows))
        found = np.array([corner, position, rotation])
        return Noise(*np.clip(found, _LEAST_NOISE, _MOST_NOISE).tolist())


def _moved_camera(camera: CameraModel, change: Array, lens_step: Array) -> CameraModel:
    T_world_camera = camera.T_world_camera @ change
    if not len(lens_step):
        return replace(camera, T_world_camera=T_world_camera)
    lens = _lens_vector(camera) + lens_step
    fx, fy = np.maximum(lens[:2], 1.0)
    K = np.array([[fx, 0.0, lens[2]], [0.0, fy, lens[3]], [0.0, 0.0, 1.0]])
    return replace(camera, T_world_camera=T_world_camera, K=K, distortion=lens[4:])


def _lens_vector(camera: CameraModel) -> Array:
    return np.concatenate([camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion])
