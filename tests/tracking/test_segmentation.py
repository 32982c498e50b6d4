import cv2
import numpy as np
import pytest

from dlo_gym.geometry import View
from tests.tracking.drawing import draw_cable
from tracking.projection import pixels_per_metre
from tracking.ridge import best_path, ridge_strength, straighten
from tracking.segmentation import ColourSegmenter

LOOKS = {
    "red on grey": ((200, 60, 50), (150, 152, 148)),
    "black on grey": ((30, 30, 32), (150, 152, 148)),
    "blue on white": ((40, 70, 190), (235, 235, 235)),
    "white on dark": ((235, 235, 230), (60, 62, 60)),
    "grey on darker grey": ((120, 120, 122), (70, 70, 72)),
}


def true_mask(camera, centerline, thickness):
    mask = np.zeros((camera.height, camera.width), np.uint8)
    points = np.round(camera.project(centerline) * 16).astype(np.int32)
    cv2.polylines(mask, [points], False, 1, thickness, cv2.LINE_8, 4)
    return mask > 0


def fit(view, centerline, segmenter=None, uncertainty=30.0):
    camera = view.camera
    radius = float(np.median(0.003 * pixels_per_metre(camera, centerline)))
    segmenter = segmenter or ColourSegmenter()
    ok = segmenter.fit(
        view, camera.project(centerline), radius, uncertainty=uncertainty, held=(True, True)
    )
    return segmenter, ok


def segment(segmenter, view):
    everywhere = np.ones(view.image.shape[:2], np.uint8)
    return segmenter.segment(view.image, view.camera.name, everywhere) > 0


@pytest.mark.parametrize("look", LOOKS)
def test_a_cable_of_any_colour_is_told_from_its_background(look, cameras, hanging):
    colour, background = LOOKS[look]
    view = draw_cable(cameras[0], hanging, colour=colour, background=background)
    segmenter, ok = fit(view, hanging)
    assert ok
    mask = segment(segmenter, view)
    assert mask[true_mask(cameras[0], hanging, 1)].mean() > 0.97
    assert mask[~true_mask(cameras[0], hanging, 9)].mean() < 1e-3


def test_a_prediction_off_by_many_diameters_still_leads_to_the_cable(cameras, hanging):
    bump = np.sin(np.linspace(0.0, np.pi, len(hanging)))[:, None] ** 2
    view = draw_cable(cameras[0], hanging)
    segmenter, ok = fit(view, hanging + 0.03 * bump * np.array([0.0, 0.0, 1.0]), uncertainty=40.0)
    assert ok
    assert segment(segmenter, view)[true_mask(cameras[0], hanging, 1)].mean() > 0.95


def test_grippers_of_the_cables_colour_do_not_spoil_the_model(cameras, hanging):
    camera = cameras[0]
    view = draw_cable(camera, hanging)
    image = view.image.copy()
    for end in camera.project(hanging[[0, -1]]):
        x, y = np.round(end).astype(int)
        outwards = -1 if x < camera.width / 2 else 1
        cv2.rectangle(image, (x, y - 15), (x + outwards * 60, y + 15), (200, 60, 50), -1)
    view = View(image, camera)
    segmenter, ok = fit(view, hanging)
    assert ok
    assert segment(segmenter, view)[true_mask(camera, hanging, 1)].mean() > 0.95


def test_shading_does_not_hide_the_cable(cameras, hanging):
    segmenter, _ = fit(draw_cable(cameras[0], hanging), hanging)
    darker = draw_cable(cameras[0], hanging, colour=(160, 48, 40), background=(135, 137, 133))
    assert segment(segmenter, darker)[true_mask(cameras[0], hanging, 1)].mean() > 0.95


def test_an_occluder_of_a_colour_never_seen_is_not_the_cable(cameras, hanging):
    view = draw_cable(cameras[0], hanging)
    segmenter, _ = fit(view, hanging)
    for colour in ((30, 200, 40), (240, 240, 30), (0, 0, 0), (255, 255, 255)):
        patch = View(np.full_like(view.image, colour), cameras[0])
        assert not segment(segmenter, patch).any()


def test_without_a_cable_the_fit_says_so(cameras, hanging):
    rng = np.random.default_rng(0)
    image = rng.normal(150, 4, (cameras[0].height, cameras[0].width, 3)).astype(np.uint8)
    segmenter, ok = fit(View(image, cameras[0]), hanging)
    assert not ok
    with pytest.raises(ValueError, match="fitted"):
        segment(segmenter, View(image, cameras[0]))


def test_nothing_is_looked_at_outside_the_occupancy(cameras, hanging):
    view = draw_cable(cameras[0], hanging)
    segmenter, _ = fit(view, hanging)
    nowhere = np.zeros(view.image.shape[:2], np.uint8)
    assert not segmenter.segment(view.image, "side", nowhere).any()


def test_the_ridge_is_found_beside_a_stronger_edge():
    image = np.full((120, 300, 3), 100, np.uint8)
    image[:40] = 220  # a table's edge: stronger, but no ridge
    image[58:64] = 130
    curve = np.column_stack([np.linspace(10.0, 290.0, 50), np.full(50, 52.0)])
    strip = straighten(image, curve, 3.0, 40.0)
    path = best_path(ridge_strength(strip), (False, False), 1.0)
    np.testing.assert_allclose(np.abs(strip.offsets[path]), 8.5, atol=1.5)


def test_a_starker_cable_beside_it_is_not_learnt(cameras, hanging):
    camera = cameras[1]
    view = draw_cable(camera, hanging, colour=(70, 100, 75))
    shift = np.linspace(-0.006, 0.008, len(hanging))[:, None] * np.array([0.0, 1.0, 0.0])
    points = np.round(16 * camera.project(hanging + shift)).astype(np.int32)
    image = view.image.copy()
    cv2.polylines(image, [points], False, (250, 220, 20), 3, cv2.LINE_AA, 4)
    segmenter, ok = fit(View(image, camera), hanging, uncertainty=12.0)
    assert ok
    assert segment(segmenter, view)[true_mask(camera, hanging, 1)].mean() > 0.9
    yellow = View(np.full_like(image, (250, 220, 20)), camera)
    assert not segment(segmenter, yellow).any()
