"""The contact kernels' derivatives against finite differences."""

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, pose
from dlo_gym.rod import Box, Capsule, Plane, RodProperties, Sphere
from dlo_gym.rod import _kernels_contact as kernels
from dlo_gym.rod import _kernels_self_contact as pairs
from dlo_gym.rod.contact import ContactModel

N = 6
TILTED = pose(exp_so3([0.3, -0.2, 0.1]), np.zeros(3))
BODIES = [
    Plane(TILTED),
    Box(TILTED, (0.05, 0.04, 0.002)),
    Sphere.at([0.0, 0.0, -0.05], 0.05),
    Capsule(TILTED, 0.02, 0.004),
]


def overlapping(body, friction: float):
    """A model and nodes (N + 1, 3) near the body's surface, some points overlapping it."""
    model = ContactModel(RodProperties(0.06), N, [body], False, friction)
    rng = np.random.default_rng(0)
    line = np.linspace(-0.03, 0.03, N + 1)[:, None] * [1.0, 0.2, 0.0]
    nodes = line + rng.normal(scale=2e-4, size=line.shape)
    for _ in range(50):  # onto the surface: sphere tracing along z
        nodes[:, 2] -= 0.5 * (body.signed_distance(nodes) - 0.00295)
    return model, nodes


def evaluate(model, hold, nodes):
    gradient, matrix = np.zeros(6 * N + 3), np.zeros((6 * N + 3, 17))
    energy = kernels.add_obstacles(model.constants, model.arrays, hold, nodes, gradient, matrix)
    full = np.zeros((6 * N + 3, 6 * N + 3))
    for i in range(6 * N + 3):
        for j in range(max(0, i - 8), min(6 * N + 3, i + 9)):
            full[i, j] = matrix[i, 8 + j - i]
    rows = (np.arange(N + 1)[:, None] * 6 + np.arange(3)).ravel()
    return energy, gradient[rows], full[np.ix_(rows, rows)]


@pytest.mark.parametrize("slid", [2e-6, 2e-5], ids=["sticks", "slides"])
@pytest.mark.parametrize("lagging", [False, True], ids=["exact", "lagging"])
@pytest.mark.parametrize("body", BODIES, ids=lambda body: type(body).__name__)
def test_derivatives_with_friction_match_finite_differences(body, lagging, slid):
    model, nodes = overlapping(body, 0.4)
    kernels.update_anchors(model.constants, model.arrays, nodes, model.anchors)
    touching = ~np.isnan(model.anchors[0, :, 0])
    assert touching.sum() > 3
    lag = np.zeros((1, model.n_points, 4))
    kernels.update_lag(model.constants, model.arrays, nodes, lag)
    hold = kernels.Hold(model.anchors, lag, lagging)
    nodes = nodes + slid * np.array([0.6, 0.8, 0.0])
    _, gradient, tangent = evaluate(model, hold, nodes)
    h = 1e-10
    for k in range(3 * (N + 1)):
        step = np.zeros(3 * (N + 1))
        step[k] = h
        ahead = evaluate(model, hold, nodes + step.reshape(-1, 3))
        behind = evaluate(model, hold, nodes - step.reshape(-1, 3))
        column = (ahead[1] - behind[1]) / (2.0 * h)
        np.testing.assert_allclose(tangent[:, k], column, atol=1e-4 * np.abs(tangent).max())
        if lagging:  # then all of it has a potential
            slope = (ahead[0] - behind[0]) / (2.0 * h)
            np.testing.assert_allclose(gradient[k], slope, atol=1e-5 * np.abs(gradient).max())


def test_woodbury_solves_the_dense_system():
    # A hairpin whose legs touch, on a band that is diagonally dominant.
    n = 24
    turned = np.linspace(0.0, np.pi, n - 15)
    leg = np.linspace(0.0, 0.03, 8)[:, None]
    bow = np.column_stack([0.03 + 0.0029 * np.sin(turned), -0.0029 * np.cos(turned), 0.0 * turned])
    nodes = np.concatenate(
        [
            leg * [1, 0, 0] + [0, -0.0029, 0.0],
            bow[1:],
            leg[::-1][1:] * [1, 0, 0] + [0, 0.0029, 1e-4],
        ]
    )
    n = len(nodes) - 1
    model = ContactModel(RodProperties(0.08), n, [], True, 0.0)
    rng = np.random.default_rng(1)
    size = 6 * n + 3
    matrix = rng.uniform(-1.0, 1.0, (size, 17))
    matrix[:, 8] += 1e4
    _, remote = pairs.add_pairs(model.constants, nodes, np.zeros(size), matrix)
    assert len(remote.dofs) > 0
    first, last = 3, size - 3
    dense = np.zeros((size, size))
    for i in range(size):
        for j in range(max(0, i - 8), min(size, i + 9)):
            dense[i, j] = matrix[i, 8 + j - i]
    dense[np.ix_(remote.dofs, remote.dofs)] += remote.stiffness
    columns = np.zeros((size, 2))
    columns[first:last] = rng.normal(size=(last - first, 2))
    expected = np.linalg.solve(dense[first:last, first:last], columns[first:last])
    _, remote = pairs.factorise(matrix, remote, first, last)
    pairs.solve(matrix, remote, first, last, columns)
    np.testing.assert_allclose(columns[first:last], expected, atol=1e-9 * np.abs(expected).max())
