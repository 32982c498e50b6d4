import numpy as np
import pytest

from tracking.association import associate, correct_occluded, image_tangents
from tracking.graph import EMPTY, CenterlineGraph


def chain(points):
    """A graph of one chain through points (m, 2)."""
    points = np.asarray(points, dtype=np.float64)
    edges = np.column_stack([np.arange(len(points) - 1), np.arange(1, len(points))])
    degrees = np.bincount(edges.ravel(), minlength=len(points))
    return CenterlineGraph(points, image_tangents(points), edges, degrees)


def two_chains(first, second):
    a, b = chain(first), chain(second)
    return CenterlineGraph(
        np.vstack([a.nodes, b.nodes]),
        np.vstack([a.directions, b.directions]),
        np.vstack([a.edges, b.edges + len(a.nodes)]),
        np.concatenate([a.degrees, b.degrees]),
    )


def row(y, start=0.0, stop=100.0, step=10.0):
    x = np.arange(start, stop + 1e-9, step)
    return np.column_stack([x, np.full(len(x), y)])


def run(predicted, graph, gate=20.0, overshoot=3.0):
    n = len(predicted)
    return associate(predicted, graph, np.full(n, gate), np.full(n, overshoot))


def test_nodes_move_straight_across_to_the_edge():
    predicted = row(5.0, 12.0, 88.0, 7.0)
    found = run(predicted, chain(row(0.0)))
    assert found.visible.all()
    np.testing.assert_allclose(
        found.points, np.column_stack([predicted[:, 0], 0 * predicted[:, 0]])
    )
    np.testing.assert_allclose(found.offsets, np.tile([0.0, -5.0], (len(predicted), 1)))
    np.testing.assert_allclose(found.directions, np.tile([1.0, 0.0], (len(predicted), 1)))


def test_a_node_in_a_gap_is_hidden_though_its_projection_lies_on_the_graph():
    graph = two_chains(row(0.0, 0.0, 40.0), row(0.0, 70.0, 100.0))
    predicted = row(2.0, 0.0, 100.0, 5.0)
    found = run(predicted, graph)
    hidden = (predicted[:, 0] > 43.0) & (predicted[:, 0] < 67.0)
    np.testing.assert_array_equal(found.visible, ~hidden)


def test_a_node_beyond_the_gate_is_hidden():
    assert not run(row(30.0, 10.0, 90.0), chain(row(0.0)), gate=20.0).visible.any()


def test_a_crossing_cable_is_not_taken():
    x = np.full(11, 50.0)
    crossing = np.column_stack([x, np.linspace(-50.0, 50.0, 11)])
    found = run(row(3.0, 10.0, 90.0, 8.0), two_chains(row(0.0), crossing))
    np.testing.assert_allclose(found.points[:, 1], 0.0, atol=1e-12)


def test_an_empty_graph_sees_nothing_and_moves_nothing():
    predicted = row(5.0)
    found = run(predicted, EMPTY)
    assert not found.visible.any()
    np.testing.assert_array_equal(found.points, predicted)


def test_nan_pixels_are_hidden_and_do_not_spread():
    predicted = row(5.0, 10.0, 90.0)
    predicted[0] = np.nan
    found = run(predicted, chain(row(0.0)))
    assert not found.visible[0]
    assert found.visible[2:].all()
    assert np.isfinite(found.points[1:]).all()


def test_coincident_pixels_give_no_nan():
    predicted = np.repeat(row(5.0, 10.0, 90.0), 2, axis=0)
    found = run(predicted, chain(row(0.0)))
    assert np.isfinite(found.points).all()
    assert np.isfinite(found.directions).all()


def test_interpolation_keeps_the_sign_across_a_gap():
    predicted = row(0.0, 0.0, 100.0)
    found = run(predicted, chain(row(0.0)))
    offsets = np.zeros((11, 2))
    offsets[2], offsets[8] = (0.0, 6.0), (0.0, -6.0)
    visible = np.zeros(11, dtype=bool)
    visible[[2, 8]] = True
    found = found._replace(offsets=offsets, visible=visible)
    corrected = correct_occluded(found, predicted[:, 0])
    np.testing.assert_allclose(corrected[2:9, 1], np.linspace(6.0, -6.0, 7))
    np.testing.assert_allclose(corrected[[0, 10]], 0.0)
    free = correct_occluded(found, predicted[:, 0], fixed_ends=(True, False))
    np.testing.assert_allclose(free[8:, 1], -6.0)


@pytest.mark.parametrize("ends", [(True, True), (False, False)])
def test_nothing_seen_corrects_nothing(ends):
    found = run(row(5.0), EMPTY)
    np.testing.assert_array_equal(correct_occluded(found, np.arange(11.0), ends), 0.0)
