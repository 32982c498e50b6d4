"""The latency estimate against shifts that are known."""

import numpy as np
import pytest

from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.latency import estimate_latency

CAMERA = CameraModel.looking_at(
    "side", (0.05, -1.0, 0.4), (0, 0, 0.3), width=640, height=360, focal_length=467
)
POSE_STAMPS = np.arange(0.0, 9.0, 0.008)


def path(times, seed=3, amplitude=0.03):
    """An irregular motion (n, 3) [m] below 1 Hz."""
    rng = np.random.default_rng(seed)
    t = np.asarray(times)[:, None]
    moved = np.zeros((len(t), 3))
    for frequency in (0.23, 0.41, 0.67, 0.94):
        moved += (
            amplitude * rng.normal(size=3) * np.sin(2 * np.pi * (frequency * t + rng.random(3)))
        )
    return np.array([0.0, 0.0, 0.3]) + moved / 2


def seen(stamps, latency, noise=0.0, seed=0, **motion):
    """Pixels (n, 2) of images that show the gripper as it was ``latency`` before their stamp."""
    noise = noise * np.random.default_rng(seed).normal(size=(len(stamps), 2))
    return CAMERA.project(path(stamps - latency, **motion)) + noise


def image_stamps(rate=20.0, seed=1):
    """Seven seconds of images that do not arrive quite evenly."""
    n = int(7 * rate)
    return 1.0 + np.arange(n) / rate + np.random.default_rng(seed).uniform(0, 0.3 / rate, n)


@pytest.mark.parametrize("latency", [-0.0213, 0.0, 0.0337, 0.1234, 0.4])
def test_known_shift_without_noise(latency):
    stamps = image_stamps()
    found = estimate_latency(stamps, seen(stamps, latency), POSE_STAMPS, path(POSE_STAMPS))
    assert found.latency == pytest.approx(latency, abs=1e-3)
    assert found.explained > 0.99
    assert found.n_images == len(stamps)


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_error_under_noise_is_what_it_says(rate):
    stamps = image_stamps(rate)
    projected = CAMERA.project(path(POSE_STAMPS))
    found = [
        estimate_latency(stamps, seen(stamps, 0.083, noise=1.0, seed=seed), POSE_STAMPS, projected)
        for seed in range(40)
    ]
    errors = np.array([each.latency - 0.083 for each in found])
    claimed = np.array([each.standard_error for each in found])
    assert np.abs(errors).max() < 0.01
    assert abs(errors.mean()) < 4 * claimed.mean() / np.sqrt(len(found)) + 2e-4
    assert 0.6 < errors.std() / claimed.mean() < 1.6
    assert np.mean([each.residual for each in found]) == pytest.approx(np.sqrt(2), rel=0.1)


def test_more_noise_is_less_sure():
    stamps = image_stamps()
    errors = [
        estimate_latency(
            stamps, seen(stamps, 0.05, noise=noise), POSE_STAMPS, path(POSE_STAMPS)
        ).standard_error
        for noise in (1.0, 3.0)
    ]
    assert errors[1] > 2 * errors[0]


def test_one_dimension_is_enough():
    stamps = image_stamps()
    found = estimate_latency(
        stamps, seen(stamps, 0.06)[:, :1], POSE_STAMPS, CAMERA.project(path(POSE_STAMPS))
    )
    assert found.latency == pytest.approx(0.06, abs=1e-3)


def test_images_without_the_gripper_and_without_poses_take_no_part():
    stamps = np.concatenate([image_stamps(), [-3.0, 20.0]])
    pixels = seen(stamps, 0.06)
    pixels[10:30] = np.nan
    found = estimate_latency(stamps, pixels, POSE_STAMPS, path(POSE_STAMPS))
    assert found.n_images == len(stamps) - 22
    assert found.latency == pytest.approx(0.06, abs=1e-3)


def test_too_small_a_motion_is_refused():
    stamps = image_stamps()
    pixels = seen(stamps, 0.06, noise=0.5, amplitude=0.002)
    with pytest.raises(ValueError, match="motion of at least 5 pixels"):
        estimate_latency(stamps, pixels, POSE_STAMPS, path(POSE_STAMPS, amplitude=0.002))


def test_something_else_in_the_picture_is_refused():
    stamps = image_stamps()
    with pytest.raises(ValueError, match="explain only"):
        estimate_latency(stamps, seen(stamps, 0.06, seed=0), POSE_STAMPS, other_path())


def other_path():
    rng = np.random.default_rng(9)
    return np.cumsum(rng.normal(size=(len(POSE_STAMPS), 3)), axis=0) * 1e-3


def test_a_latency_outside_the_search_is_refused():
    stamps = image_stamps()
    with pytest.raises(ValueError, match="search: expected the latency inside"):
        estimate_latency(
            stamps, seen(stamps, 0.14), POSE_STAMPS, path(POSE_STAMPS), search=(0.0, 0.1)
        )


def test_a_periodic_motion_is_refused():
    stamps = image_stamps()

    def shaking(times):
        return np.column_stack([0.05 * np.sin(2 * np.pi * 3.0 * times), 0 * times, 0.3 + 0 * times])

    with pytest.raises(ValueError, match="move less regularly"):
        estimate_latency(
            stamps, CAMERA.project(shaking(stamps - 0.1)), POSE_STAMPS, shaking(POSE_STAMPS)
        )


def test_wrong_arguments_are_named():
    stamps = image_stamps()
    pixels, positions = seen(stamps, 0.06), path(POSE_STAMPS)
    with pytest.raises(ValueError, match="^pixels: expected shape"):
        estimate_latency(stamps[1:], pixels, POSE_STAMPS, positions)
    with pytest.raises(ValueError, match="^positions: expected shape"):
        estimate_latency(stamps, pixels, POSE_STAMPS, positions.ravel())
    with pytest.raises(ValueError, match="increasing"):
        estimate_latency(stamps, pixels, POSE_STAMPS[::-1], positions)
    with pytest.raises(ValueError, match="at least 20 images"):
        estimate_latency(stamps[:15], pixels[:15], POSE_STAMPS, positions)
    with pytest.raises(ValueError, match="^search"):
        estimate_latency(stamps, pixels, POSE_STAMPS, positions, search=(0.1, 0.0))
