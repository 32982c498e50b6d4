"""A cable's parameters, recovered from motions of a rod that has known ones."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.exceptions import IdentificationFailed
from dlo_gym.geometry.se3 import exp_so3
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.rod import CosseratRod
from sim2real.identification.cable_motion import CableMotion
from sim2real.identification.estimate import fit
from sim2real.identification.parameters import prior, rod_of
from sim2real.identification.prediction import predict
from sim2real.identification.residuals import Residuals

LENGTH, RADIUS, ELEMENTS = 0.5, 0.003, 20
# EI / weight, GJ / EI, rest curvature, twist, length
TRUTH = np.array([3e-4, 0.8, 1.0, -0.7, 0.3, 0.49])


def swept(seed: int, samples: int, period: float) -> CableMotion:
    """Clamps swept to and fro and turned, nothing seen of the cable yet."""
    rng = np.random.default_rng(seed)
    start = random_boundary(rng, 0.8 * LENGTH)
    assert start.right is not None
    phase = np.sin(np.linspace(0.0, np.pi, samples))
    clamps = []
    for clamp in (start.left, start.right):
        poses = np.tile(clamp, (samples, 1, 1))
        poses[:, :3, 3] += phase[:, None] * rng.uniform(-0.06, 0.06, 3)
        poses[:, :3, :3] = exp_so3(phase[:, None] * rng.uniform(-0.8, 0.8, 3)) @ poses[:, :3, :3]
        clamps.append(poses)
    return CableMotion(
        period * np.arange(samples), *clamps, np.zeros((samples, ELEMENTS + 1, 3)),
        np.linspace(0.0, 1.0, ELEMENTS + 1), LENGTH, RADIUS, 0.03, ELEMENTS,
    )  # fmt: skip


def at_rest(seed: int, samples: int = 12, noise: float = 0.0) -> CableMotion:
    """The rod of ``TRUTH`` in equilibrium in every sample."""
    motion = swept(seed, samples, 0.5)
    rod = CosseratRod(rod_of(TRUTH, motion, "rest"), ELEMENTS)
    points = [rod.settle(motion.boundary(0)).positions]
    for sample in range(1, samples):
        step = motion.boundary(sample - 1).displacement_to(motion.boundary(sample))
        points.append(rod.move(step).positions)
    error = noise * np.random.default_rng(100 + seed).normal(size=motion.points.shape)
    return replace(motion, points=np.array(points) + error)


@pytest.fixture(scope="module")
def exact() -> list[CableMotion]:
    return [at_rest(seed) for seed in range(2)]


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_equilibria_give_the_parameters_from_a_start_far_off(exact, factor):
    start = TRUTH * [factor, 1.0 / factor, 0.0, 0.0, 0.0, LENGTH / TRUTH[5]]
    found = fit(exact, model="rest", start=start)
    assert found.rms < 1e-5
    assert not found.unidentified
    np.testing.assert_allclose(list(found.values.values()), TRUTH, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("across", [False, True])
def test_intervals_hold_the_truth_of_noisy_points(across):
    found = fit([replace(at_rest(s, noise=1e-3), across=across) for s in range(2)], model="rest")
    assert found.rms == pytest.approx(1e-3 * np.sqrt(2 if across else 3), rel=0.1)
    assert found.values["EI / weight"] == pytest.approx(TRUTH[0], rel=0.05)
    assert found.values["length"] == pytest.approx(TRUTH[5], rel=0.01)
    for (low, high), true in zip(found.intervals.values(), TRUTH, strict=True):
        assert low - 0.3 * (high - low) < true < high + 0.3 * (high - low)


def test_what_hangs_in_a_plane_tells_nothing_of_twist(exact):
    motion = exact[0]
    left, right = np.eye(4), np.eye(4)
    left[:3, :3] = right[:3, :3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])
    right[0, 3] = 0.35
    still = BoundaryPoses(left, right)
    straight = TRUTH * [1, 1, 0, 0, 0, 1]
    shape = CosseratRod(rod_of(straight, motion, "rest"), ELEMENTS).settle(still).positions
    found = fit([
        replace(motion, left=np.tile(left, (len(motion), 1, 1)),
                right=np.tile(right, (len(motion), 1, 1)), points=np.tile(shape, (12, 1, 1)))
    ], model="rest")  # fmt: skip
    assert {"GJ / EI"} <= set(found.unidentified)
    assert found.told["GJ / EI"] > 0.99
    assert found.values["EI / weight"] == pytest.approx(TRUTH[0], rel=0.01)


def test_the_jacobian_is_that_of_the_residuals(exact):
    parameters = prior(exact[0], "rest")
    residuals = Residuals(exact[:1], parameters, "rest")
    z = np.array([p.z(value) for p, value in zip(parameters, 1.1 * TRUTH, strict=True)])
    exactly = residuals.jacobian(z)
    for column, step in enumerate(1e-4 * np.eye(6)):
        difference = (residuals.vector(z + step) - residuals.vector(z - step)) / 2e-4
        # Stretch follows EI, which the Jacobian neglects.
        assert np.abs(exactly[:, column] - difference).max() < 0.03 * np.abs(difference).max()


def test_a_cable_held_at_one_end_is_identified(exact):
    motion = replace(exact[0], right=None)
    straight = TRUTH * [1, 1, 0, 0, 0, 1]
    rod = CosseratRod(rod_of(straight, motion, "rest"), ELEMENTS)
    points = np.array([rod.settle(motion.boundary(i)).positions for i in range(len(motion))])
    found = fit([replace(motion, points=points)], model="rest")
    assert found.values["EI / weight"] == pytest.approx(TRUTH[0], rel=0.02)
    assert found.values["length"] == pytest.approx(TRUTH[5], rel=0.005)


def test_points_not_seen_do_not_count(exact):
    motion = exact[0]
    points = motion.points.copy()
    points[1:, ::2] = np.nan
    found = fit([replace(motion, points=points), exact[1]], model="rest")
    assert found.values["EI / weight"] == pytest.approx(TRUTH[0], rel=2e-3)


def test_bad_motions_are_refused(exact):
    motion = exact[0]
    with pytest.raises(ValueError, match="left: expected 12 poses"):
        replace(motion, left=motion.left[1:])
    with pytest.raises(ValueError, match="points: expected shape"):
        replace(motion, places=motion.places[1:])
    with pytest.raises(ValueError, match="stamps: expected two increasing"):
        replace(motion, stamps=motion.stamps[::-1])
    with pytest.raises(ValueError, match="motions: expected at least one"):
        fit([])
    far = motion.right.copy()
    far[:, :3, 3] += 1.0
    with pytest.raises(IdentificationFailed):
        fit([replace(motion, right=far)], model="rest")


def test_windows_begin_where_two_points_were_seen(exact):
    motion = exact[0]
    for hidden, lengths in ((slice(0, 0), [4, 4, 4]), (slice(4, 6), [6, 2, 4]),
                            (slice(4, 7), [7, 5]), (slice(7, 12), [4, 8])):  # fmt: skip
        points = motion.points.copy()
        points[hidden, 1:] = np.nan
        parts = replace(motion, points=points).windows(2.0)
        assert [len(part) for part in parts] == lengths
        np.testing.assert_array_equal(np.concatenate([p.stamps for p in parts]), motion.stamps)
        np.testing.assert_array_equal(np.concatenate([p.points for p in parts]), points)


def test_a_free_end_has_the_acceleration_that_was_seen(exact):
    points = exact[0].points.copy()
    points[:, -1, 2] += 1.5 * exact[0].stamps ** 2
    free = replace(exact[0], points=points, right=None)
    change = free.accelerations - replace(exact[0], right=None).accelerations
    np.testing.assert_allclose(change[:, -1], np.tile([0.0, 0.0, 3.0], (len(free), 1)), atol=1e-9)


DYNAMIC = np.array([*TRUTH, 1.5, 0.02])


def moved(seed: int, samples: int = 16) -> CableMotion:
    """A rod of ``DYNAMIC`` that is at rest when its clamps start to sweep, in 0.05 s samples."""
    motion = swept(seed, samples, 0.05)
    rod = CosseratRod(rod_of(DYNAMIC, motion, "motion"), ELEMENTS)
    points = [rod.settle(motion.boundary(0)).positions] * 2
    motion = replace(motion, left=motion.left[[0, *range(samples - 1)]],
                     right=motion.right[[0, *range(samples - 1)]])  # fmt: skip
    for sample in range(2, samples):
        step = motion.boundary(sample - 1).displacement_to(motion.boundary(sample))
        points.append(rod.advance(step, 0.05, dt=0.025).positions)
    return replace(motion, points=np.array(points))


@pytest.fixture(scope="module")
def swinging() -> list[CableMotion]:
    return [moved(seed) for seed in range(2)]


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_motion_gives_the_parameters_from_a_start_far_off(swinging, factor):
    start = DYNAMIC * [factor, 1 / factor, 0, 0, 0, LENGTH / TRUTH[5], 1 / factor, factor]
    found = fit(swinging, model="motion", start=start)
    assert found.rms < 3e-4  # the first sample's velocity is not known exactly
    assert not found.unidentified
    values = list(found.values.values())
    np.testing.assert_allclose(values, DYNAMIC, rtol=0.05, atol=0.03)
    assert values[0] == pytest.approx(DYNAMIC[0], rel=0.01)
    assert values[5] == pytest.approx(DYNAMIC[5], rel=0.003)


def test_the_jacobian_of_motion_is_that_of_the_residuals(swinging):
    motions = [replace(swinging[0], grip_known=False)]
    parameters = prior(motions[0], "motion")
    residuals = Residuals(motions, parameters, "motion")
    z = np.array([p.z(value) for p, value in zip(parameters, [*DYNAMIC, *6 * [0.0]], strict=True)])
    exactly = residuals.jacobian(z)
    for column, step in enumerate(1e-4 * np.eye(len(z))):
        difference = (residuals.vector(z + step) - residuals.vector(z - step)) / 2e-4
        largest = np.abs(difference).max()
        # Stretch follows EI, which the Jacobian neglects.
        assert np.abs(exactly[:, column] - difference).max() < (1e-6 if column else 0.03) * largest
        assert np.abs(difference).max() > 1e-4


def test_a_clip_shorter_than_the_launch_is_predicted(swinging):
    motion = swinging[0]
    short = replace(motion, stamps=0.1 * motion.stamps[:2], left=motion.left[:2],
                    right=motion.right[:2], points=motion.points[:2])  # fmt: skip
    points = predict(short, rod_of(DYNAMIC, short, "motion"), "motion").points
    np.testing.assert_allclose(points, short.points, atol=3e-4)


def test_the_first_velocity_is_not_taken_from_a_sample_that_nobody_saw(swinging):
    points = swinging[0].points.copy()
    points[1] = np.nan
    motion = replace(swinging[0], points=points)
    predicted = predict(motion, rod_of(DYNAMIC, motion, "motion"), "motion", derivatives=False)
    assert motion.mean_distance(predicted.points) < 1e-3


def test_the_jacobian_with_accelerations_leaves_out_that_forces_grow_with_length(swinging):
    parameters = prior(swinging[0], "accelerated")
    residuals = Residuals(swinging[:1], parameters, "accelerated")
    z = np.array([p.z(value) for p, value in zip(parameters, TRUTH, strict=True)])
    exactly = residuals.jacobian(z)
    for column, step in enumerate(1e-4 * np.eye(len(z))):
        difference = (residuals.vector(z + step) - residuals.vector(z - step)) / 2e-4
        error = np.abs(exactly[:, column] - difference).max() / np.abs(difference).max()
        assert error < {"EI / weight": 0.03, "length": 0.3}.get(parameters[column].name, 1e-6)
