"""Distances to obstacles and between segments, against sampling, minimisers and differences."""

import numpy as np
import pytest
from scipy.optimize import minimize

from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod import Box, Capsule, Plane, Sphere
from dlo_gym.rod import _kernels_distance as kernels
from dlo_gym.rod.obstacles import between, check_obstacles, pack, placed, same_bodies

POSE = pose(exp_so3([0.4, -0.7, 0.2]), [0.1, -0.2, 0.3])
BODIES = [
    Plane(POSE),
    Box(POSE, (0.05, 0.03, 0.08)),
    Sphere(POSE, 0.06),
    Capsule(POSE, 0.07, 0.03),
]


def kernel_distance(obstacle, point, derivatives=False):
    arrays = pack([obstacle])
    local, normal, curvature = np.empty(3), np.empty(3), np.empty((3, 3))
    rotation = arrays.rotations[0]
    kernels.to_local(rotation, arrays.origins[0], point, local)
    distance = kernels.local_distance(arrays.kinds[0], arrays.sizes[0], local)
    kernels.local_derivatives(arrays.kinds[0], arrays.sizes[0], local, normal, curvature)
    kernels.to_world(rotation, normal, curvature, np.empty((3, 3)))
    return (distance, normal, curvature) if derivatives else distance


def inside(body, local) -> bool:
    """Membership by the definition of each body, in its own frame."""
    x, y, z = local
    match body:
        case Plane():
            return z < 0
        case Box():
            return bool((np.abs(local) < body.half_size).all())
        case Sphere():
            return x * x + y * y + z * z < body.radius**2
        case Capsule():
            return x * x + y * y + max(abs(z) - body.half_length, 0.0) ** 2 < body.radius**2


@pytest.mark.parametrize("body", BODIES, ids=lambda body: type(body).__name__)
def test_signed_distance_is_that_of_the_nearest_point_across_the_surface(body):
    # The ball of that radius stays on one side; along the normal it touches the other.
    rng = np.random.default_rng(0)
    for point in POSE[:3, 3] + rng.uniform(-0.15, 0.15, (60, 3)):
        distance, normal, _ = kernel_distance(body, point, derivatives=True)
        np.testing.assert_allclose(body.signed_distance(point), distance, atol=1e-15)
        local = POSE[:3, :3].T @ (point - POSE[:3, 3])
        assert inside(body, local) == (distance < 0)
        directions = rng.normal(size=(200, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sides = {inside(body, local + 0.999 * abs(distance) * d) for d in directions}
        assert sides == {distance < 0}
        across = local - 1.001 * distance * (POSE[:3, :3].T @ normal)
        assert inside(body, across) != (distance < 0)


@pytest.mark.parametrize("body", BODIES, ids=lambda body: type(body).__name__)
def test_distance_derivatives_match_finite_differences(body):
    rng = np.random.default_rng(1)
    h = 1e-6
    for point in POSE[:3, 3] + rng.uniform(-0.2, 0.2, (60, 3)):
        distance, normal, curvature = kernel_distance(body, point, derivatives=True)
        if distance < 1e-3:  # inside a box the distance has creases
            continue
        for k in range(3):
            step = h * np.eye(3)[k]
            ahead, n_ahead, _ = kernel_distance(body, point + step, derivatives=True)
            behind, n_behind, _ = kernel_distance(body, point - step, derivatives=True)
            np.testing.assert_allclose((ahead - behind) / (2 * h), normal[k], atol=1e-8)
            np.testing.assert_allclose((n_ahead - n_behind) / (2 * h), curvature[k], atol=1e-5)


def random_segments(rng, parallel):
    a, b, c, d = rng.uniform(-0.01, 0.01, (4, 3))
    if parallel:
        d = c + b - a
    return a, b, c, d


@pytest.mark.parametrize("parallel", [False, True])
def test_segment_distance_is_the_least_over_both_segments(parallel):
    rng = np.random.default_rng(2)
    for _ in range(100):
        a, b, c, d = random_segments(rng, parallel)
        distance, s, t = kernels.segment_distance(a, b, c, d)

        def square(st, a=a, b=b, c=c, d=d):
            gap = a + st[0] * (b - a) - c - st[1] * (d - c)
            pull = (b - a) @ (b - a) * (st[0] - 0.5) ** 2 + (d - c) @ (d - c) * (st[1] - 0.5) ** 2
            return 1e6 * (gap @ gap + kernels.PARALLEL * pull)

        found = minimize(square, [0.5, 0.5], bounds=[(0, 1), (0, 1)], tol=1e-14)
        np.testing.assert_allclose(1e6 * distance**2, found.fun, atol=1e-6)
        plain = np.linalg.norm(a + s * (b - a) - c - t * (d - c))
        assert plain <= distance
        assert distance**2 - plain**2 <= 0.5 * kernels.PARALLEL * 0.035**2


@pytest.mark.parametrize("parallel", [False, True])
def test_segment_derivatives_match_finite_differences(parallel):
    rng = np.random.default_rng(3)
    gradient, hessian = np.empty(12), np.empty((12, 12))
    ahead, behind, scratch = np.empty(12), np.empty(12), np.empty((12, 12))
    h = 1e-8
    for _ in range(40):
        points = np.concatenate(random_segments(rng, parallel))
        distance, s, t = kernels.segment_distance(*points.reshape(4, 3))
        kernels.segment_derivatives(*points.reshape(4, 3), distance, s, t, gradient, hessian)
        for k in range(12):
            values = []
            for sign, out in ((1.0, ahead), (-1.0, behind)):
                moved = points.copy()
                moved[k] += sign * h
                value, s, t = kernels.segment_distance(*moved.reshape(4, 3))
                kernels.segment_derivatives(*moved.reshape(4, 3), value, s, t, out, scratch)
                values.append(value)
            np.testing.assert_allclose((values[0] - values[1]) / (2 * h), gradient[k], atol=1e-7)
            row = (ahead - behind) / (2 * h)
            np.testing.assert_allclose(row, hessian[k], atol=1e-5 * np.abs(hessian).max())


def test_bodies_by_points_are_where_they_were_asked():
    bar = Capsule.between([0.0, 0.0, 0.1], [0.0, 0.2, 0.1], 0.01)
    np.testing.assert_allclose(
        bar.signed_distance([[0.0, 0.21, 0.1], [0.05, 0.1, 0.1]]), [0, 0.04], atol=1e-15
    )
    wall = Plane.through([0.1, 0.0, 0.0], [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(wall.signed_distance([0.0, 5.0, 1.0]), 0.1)
    np.testing.assert_allclose(Sphere.at([1, 2, 3], 0.5).signed_distance([1, 2, 4]), 0.5)


def test_bodies_move_rigidly_between_two_poses():
    start = Box(np.eye(4), (0.1, 0.1, 0.2))
    end = placed(start, POSE)
    assert same_bodies([start], [end])
    assert not same_bodies([start], [Sphere(POSE, 0.1)])
    np.testing.assert_allclose(between(start, end, 1.0).pose, POSE, atol=1e-15)
    half = between(start, end, 0.5).pose
    np.testing.assert_allclose(half[:3, :3] @ half[:3, :3], POSE[:3, :3], atol=1e-14)
    np.testing.assert_allclose(half[:3, 3], 0.5 * POSE[:3, 3])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box(POSE, (0.1, -0.1, 0.1)), "box half_size"),
        (lambda: Box(2 * POSE, (0.1, 0.1, 0.1)), "box pose.*rigid"),
        (lambda: Sphere(POSE, np.nan), "sphere radius"),
        (lambda: Capsule(POSE, 0.0, 0.1), "capsule half_length"),
        (lambda: Capsule.between([0, 0, 0], [0, 0, 0], 0.1), "end - start"),
        (lambda: Plane.through([0, 0, 0], [0, 0, 0]), "normal"),
        (lambda: check_obstacles([Plane(), "table"]), r"obstacles\[1\].*'table'"),
    ],
)
def test_impossible_bodies_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
