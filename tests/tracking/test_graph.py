import cv2
import numpy as np
import pytest

from tracking.graph import EMPTY, build_graph, local_maxima


def band(curve, radius, shape=(200, 400)):
    mask = np.zeros(shape, np.uint8)
    points = np.round(curve * 16).astype(np.int32)
    cv2.polylines(mask, [points], False, 1, 2 * radius, cv2.LINE_8, 4)
    return mask


@pytest.fixture
def sine():
    x = np.linspace(20.0, 380.0, 600)
    return np.column_stack([x, 100.0 + 40.0 * np.sin(x / 50.0)])


def everywhere(mask):
    return np.ones_like(mask)


def distance(points, curve):
    return np.linalg.norm(points[:, None] - curve, axis=2).min(axis=1)


@pytest.mark.parametrize("radius", [2, 4])
def test_nodes_lie_on_the_centerline_and_cover_it(sine, radius):
    mask = band(sine, radius)
    graph = build_graph(mask, everywhere(mask), (radius, radius))
    assert np.median(distance(graph.nodes, sine)) < 0.5
    inner = sine[20:-20]
    assert distance(inner, graph.nodes).max() < 2.0 * max(2.0 * radius, 3.0)


def test_edges_form_one_chain_along_the_directions(sine):
    mask = band(sine, 4)
    graph = build_graph(mask, everywhere(mask), (4, 4))
    assert sorted(np.bincount(graph.degrees).nonzero()[0]) == [1, 2]
    assert (graph.degrees == 1).sum() == 2
    steps = np.diff(graph.nodes[graph.edges], axis=1)[:, 0]
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    cosines = np.abs((steps * graph.directions[graph.edges[:, 0]]).sum(axis=1))
    assert cosines.min() > 0.7


def test_a_gap_is_not_bridged(sine):
    mask = band(sine, 4)
    mask[:, 180:230] = 0
    graph = build_graph(mask, everywhere(mask), (4, 4))
    spans = np.sort(graph.nodes[graph.edges][..., 0], axis=1)
    assert not ((spans[:, 0] < 182) & (spans[:, 1] > 228)).any()
    ends = graph.nodes[graph.degrees == 1][:, 0]
    borders = np.array([20.0, 180.0, 230.0, 380.0])
    assert np.abs(ends[:, None] - borders).min(axis=1).max() < 16.0


def test_at_a_crossing_edges_go_straight_on():
    x = np.linspace(50.0, 350.0, 400)
    rising = np.column_stack([x, 30.0 + 0.4 * x])
    falling = np.column_stack([x, 190.0 - 0.4 * x])
    mask = band(rising, 4) | band(falling, 4)
    graph = build_graph(mask, everywhere(mask), (4, 4))
    ends = graph.nodes[graph.edges]
    away = np.abs(ends[..., 0] - 200.0).min(axis=1) > 25.0
    steps = np.diff(ends[away], axis=1)[:, 0]
    slopes = np.abs(steps[:, 1] / steps[:, 0])
    np.testing.assert_allclose(slopes, 0.4, atol=0.15)


def test_what_is_wider_than_the_cable_is_left_out(sine):
    mask = band(sine, 4)
    cv2.rectangle(mask, (0, 120), (40, 180), 1, -1)
    cv2.rectangle(mask, (150, 20), (210, 60), 1, -1)
    maxima = local_maxima(mask, (4.0, 4.0), everywhere(mask))
    graph = build_graph(mask, everywhere(mask), (4, 4))
    inside = (np.abs(maxima[:, 0] - 180) < 10) & (np.abs(maxima[:, 1] - 40) < 6)
    assert not inside.any()
    assert np.quantile(distance(graph.nodes, sine), 0.9) < 1.0


def test_only_inside_the_occupancy_and_in_full_image_pixels(sine):
    mask = band(sine, 4)
    occupancy = everywhere(mask)
    occupancy[:, 200:] = 0
    graph = build_graph(mask, occupancy, (4, 4), origin=(1000, 500))
    assert graph.nodes[:, 0].max() < 1200
    assert distance(graph.nodes - [1000, 500], sine).max() < 1.5


@pytest.mark.parametrize("fill", [0, 1])
def test_an_empty_or_a_full_mask_gives_no_graph(fill):
    mask = np.full((60, 80), fill, np.uint8)
    assert len(build_graph(mask, everywhere(mask), (3, 3)).edges) == 0
    assert len(EMPTY.nodes) == 0
