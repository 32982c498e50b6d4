"""A drawn cable: images whose geometry is known without any renderer."""

import cv2
import numpy as np

from dlo_gym.geometry import View
from dlo_gym.geometry.curves import resample
from dlo_gym.geometry.se3 import frame_along, pose
from dlo_gym.rod import BoundaryPoses

LENGTH, RADIUS, N_NODES = 0.5, 0.003, 51


def draw_cable(camera, centerline, *, colour=(200, 60, 50), background=(150, 152, 148), seed=0):
    """A view of a cable as an antialiased band of its true width on a noisy background."""
    rng = np.random.default_rng(seed)
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    image[:] = background
    pixels = camera.project(resample(centerline, 400))
    depth = np.linalg.norm(centerline.mean(axis=0) - camera.centre)
    width = max(1, round(2 * RADIUS * camera.K[0, 0] / depth))
    points = np.round(pixels * 16).astype(np.int32)
    cv2.polylines(image, [points], False, colour, width, cv2.LINE_AA, 4)
    noisy = image + rng.normal(0.0, 3.0, image.shape)
    return View(np.clip(noisy, 0, 255).astype(np.uint8), camera, 0.0)


def clamps(span=0.4, shift=(0.0, 0.0, 0.0), turn=0.0):
    """Two clamps facing each other along x at 0.34 m, the left one turned about z [rad]."""
    shift = np.asarray(shift, dtype=np.float64)
    left = pose(
        frame_along([np.cos(turn), np.sin(turn), 0.0], [0, 0, 1]),
        np.array([-span / 2, 0, 0.34]) + shift,
    )
    right = pose(frame_along([1, 0, 0], [0, 0, 1]), np.array([span / 2, 0, 0.34]))
    return BoundaryPoses(left, right)
