"""Samples of a board in known places: corners projected with noise, or images rendered."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import exp_so3, inverse, log_so3, pose, transform_points
from dlo_gym.scene.arms import SIDES, DualArm
from dlo_gym.scene.board import BoardPlate
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.renderer import SceneRenderer
from sim2real.calibration.board import BoardSpec, Detection
from sim2real.calibration.plan import nominal_mount, plan_poses
from sim2real.calibration.samples import Sample, SampleFolder

BOARD = BoardSpec()
ARMS = DualArm()
BASES = dict(zip(SIDES, ARMS.T_world_base, strict=True))
# Never quite where it was meant to be gripped.
T_TCP_BOARD = nominal_mount(BOARD) @ pose(exp_so3([0.02, -0.03, 0.05]), [0.002, 0.003, -0.001])


def cell_cameras(scale=2 / 3) -> dict[str, CameraModel]:
    """Both cameras with a lens: unequal focal lengths, principal point off the centre."""
    K_off = np.array([[8.0, 0.0, 6.0], [0.0, 5.0, -9.0], [0.0, 0.0, 0.0]])
    distortion = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
    return {
        camera.name: replace(camera, K=camera.K + K_off, distortion=distortion)
        for camera in default_cameras(scale)
    }


def seen_from(camera, T_world_board, rng, corner_px):
    """The corners that a camera would find, with noise; empty from behind or too far aslant."""
    towards = transform_points(T_world_board, BOARD.centre) - camera.centre
    if towards @ T_world_board[:3, 2] < 0.4 * np.linalg.norm(towards):
        return Detection.nothing()
    pixels = camera.project(transform_points(T_world_board, BOARD.corners))
    ids = np.flatnonzero(camera.sees(pixels))
    return Detection(ids, pixels[ids] + corner_px * rng.standard_normal((len(ids), 2)))


def arm_noise(rng, position_m, rotation_deg):
    turn = np.radians(rotation_deg) * rng.standard_normal(3)
    return pose(exp_so3(turn), position_m * rng.standard_normal(3))


def synthetic_samples(
    cameras,
    rng,
    n=15,
    *,
    sides=SIDES,
    corner_px=0.2,
    position_m=5e-5,
    rotation_deg=0.01,
    turns=0.6,
    axis=None,
):
    """``n`` samples per arm, the board anywhere in the middle of the cell.

    ``turns`` [rad] is how far it is turned from facing a camera; with ``axis`` it only ever turns
    about that axis of the world.
    """
    samples = []
    for side in sides:
        for k in range(n):
            camera = list(cameras.values())[k % len(cameras)]
            centre = rng.uniform([-0.2, -0.25, 0.2], [0.2, 0.1, 0.45])
            z = centre - camera.centre
            z /= np.linalg.norm(z)
            if axis is None:
                x = np.cross(rng.standard_normal(3), z)
                x /= np.linalg.norm(x)
                rotation = np.column_stack([x, np.cross(z, x), z])
                rotation = rotation @ exp_so3(rng.uniform(-turns, turns, 3))
            else:
                facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.7071, 0.7071], [0.0, -0.7071, 0.7071]])
                turn = rng.uniform(-turns, turns) * np.asarray(axis)
                u, _, vt = np.linalg.svd(facing)
                rotation = exp_so3(turn) @ (u @ vt)
            T_world_board = pose(rotation, centre - rotation @ BOARD.centre)
            T_base_tcp = inverse(BASES[side]) @ T_world_board @ inverse(T_TCP_BOARD)
            detections = {
                name: seen_from(c, T_world_board, rng, corner_px) for name, c in cameras.items()
            }
            reported = T_base_tcp @ arm_noise(rng, position_m, rotation_deg)
            samples.append(Sample(side, reported, detections, f"{side}-{k}"))
    return samples


def views_by_hand(camera, rng, n, corner_px=0.2):
    """A board held close, all over the image."""
    views = []
    while len(views) < n:
        pixel = rng.uniform([0, 0], [camera.width, camera.height])
        centre = camera.centre + rng.uniform(0.25, 0.5) * camera.rays(pixel)
        turn = exp_so3([0.0, 0.0, rng.uniform(-3, 3)]) @ exp_so3([*rng.uniform(-0.7, 0.7, 2), 0.0])
        rotation = camera.T_world_camera[:3, :3] @ turn
        T_world_board = pose(rotation, centre - rotation @ BOARD.centre)
        view = seen_from(camera, T_world_board, rng, corner_px)
        if len(view) >= 15:
            views.append(view)
    return views


def render_samples(
    path, cameras, rng, n, *, sides=SIDES, seen_by=None, pixel_noise=3.0, position_m=5e-5
):
    """A folder of ``n`` samples per arm of a board rendered in the cell.

    ``seen_by`` are the cameras as they really stand, ``cameras`` as the plan believes.
    """
    real = cameras if seen_by is None else seen_by
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    folder = SampleFolder.create(path, BOARD, sizes)
    below = np.column_stack([np.linspace(-0.2, 0.2, 51), np.zeros(51), np.full(51, -1.0)])
    for side in sides:
        plan = plan_poses(ARMS, list(cameras.values()), side, BOARD, n, rng)
        plate = BoardPlate(side, BOARD.image(128), BOARD.size_m, T_TCP_BOARD)
        config = SceneConfig(cameras=tuple(real.values()), boards=(plate,), arms=ARMS)
        with SceneRenderer(config) as scene:
            for k, stop in enumerate(plan):
                joints = ARMS.home.copy()
                joints[SIDES.index(side)] = stop.joint_angles
                scene.update(below, ARMS.forward_kinematics(joints), joint_angles=joints)
                images = {}
                for name in stop.cameras:
                    try:
                        image = scene.render(name).image
                    except RenderingUnavailable as error:
                        pytest.skip(str(error))
                    noisy = image + rng.normal(0.0, pixel_noise, image.shape)
                    images[name] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
                reported = stop.T_base_tcp @ arm_noise(rng, position_m, 0.01)
                folder.append(side, reported, images, planned=k)
    return folder


def apart(first, second):
    """Distance of two poses [mm], [degrees]."""
    off = inverse(first) @ second
    turn = np.degrees(np.linalg.norm(log_so3(off[:3, :3])))
    return 1e3 * np.linalg.norm(off[:3, 3]), turn


def cell_file(path, cameras, bases=BASES):
    """Writes a cell file with these cameras and bases, comments included."""
    lines = [
        'schema = "dlo-cell/1"',
        'name = "bench"',
        "[rod]",
        "length_m = 0.5  # with a ruler",
        "radius_m = 0.003",
    ]
    for index, side in enumerate(SIDES):
        lines += [
            f"[arms.{side}]",
            'driver = "simulated"',
            f'address = "127.0.0.{2 + index}"',
            f"base_position_m = {bases[side][:3, 3].tolist()}  # {side}",
            f"base_rotation_rad = {log_so3(bases[side][:3, :3]).tolist()}",
            f"home_rad = {ARMS.home[index].tolist()}",
        ]
    for name, camera in cameras.items():
        K, T = camera.K, camera.T_world_camera
        lines += [
            f"[cameras.{name}]",
            'driver = "mjpeg"',
            f'device = "http://127.0.0.1:1/{name}"',
            f"width_px = {camera.width}",
            f"height_px = {camera.height}",
            f"intrinsics_px = {[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}".replace("np.float64", ""),
            f"distortion = {camera.distortion.tolist()}",
            f"position_m = {T[:3, 3].tolist()}",
            f"rotation_rad = {log_so3(T[:3, :3]).tolist()}",
        ]
    path.write_text("\n".join(lines).replace("(", "").replace(")", "") + "\n")
    return path
