import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import RodDiverged, TrackLost
from dlo_gym.geometry import CameraModel, View
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, RodProperties
from dlo_gym.rod.rod import CosseratRod
from tests.tracking.drawing import LENGTH, N_NODES, clamps, draw_cable
from tracking.predictors import RodPredictor, make_predictor
from tracking.projection import occupancy_mask
from tracking.tracker import MultiViewTracker, TrackerConfig

MOVES = [(0.0, 0.0), (0.01, 0.05), (0.02, 0.1), (0.03, 0.15), (0.03, 0.2)]


class StandStill:
    """The worst predictor there is."""

    n_nodes = N_NODES

    def predict(self, centerline, displacement, boundary=None):
        return centerline


class Broken:
    n_nodes = N_NODES

    def __init__(self, answer):
        self.answer = answer

    def predict(self, centerline, displacement, boundary=None):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def boundary_at(step):
    shift, turn = MOVES[step]
    return clamps(shift=(shift, 0.5 * shift, shift), turn=turn)


@pytest.fixture(scope="module")
def motion(properties, cameras):
    """Boundary poses, true shapes and clear views along a short motion."""
    rod = CosseratRod(properties)
    poses = [boundary_at(step) for step in range(len(MOVES))]
    shapes = [rod.settle(pose).positions for pose in poses]
    views = [[draw_cable(camera, shape) for camera in cameras] for shape in shapes]
    return poses, shapes, views


def start(motion, cameras, properties, predictor=None, **config):
    predictor = predictor or RodPredictor(properties)
    tracker = MultiViewTracker(predictor, cameras, config=TrackerConfig(**config))
    tracker.initialise(motion[0][0], properties)
    return tracker


def follow(tracker, motion, views=None):
    """Tracks the motion; (steps, n) errors [m] and the estimates."""
    poses, shapes, clear = motion
    errors, estimates = [], []
    for step, seen in enumerate(views or clear):
        displacement = poses[max(step - 1, 0)].displacement_to(poses[step])
        estimates.append(tracker.update(seen, displacement, 0.1 * step))
        assert np.isfinite(estimates[-1].centerline).all()
        errors.append(np.linalg.norm(estimates[-1].centerline - shapes[step], axis=1))
    return np.array(errors), estimates


@pytest.mark.parametrize("m", [2, 3])
@pytest.mark.parametrize("stand_still", [False, True])
def test_clear_views_give_the_shape(motion, cameras, properties, m, stand_still):
    predictor = StandStill() if stand_still else None
    tracker = start(motion, cameras[:m], properties, predictor)
    errors, estimates = follow(tracker, motion, [views[:m] for views in motion[2]])
    assert errors.mean() < 5e-4
    assert errors.max() < 3e-3
    assert estimates[-1].visible.shape == (m, N_NODES)
    assert estimates[-1].visible[:, 3:-3].all()
    assert estimates[-1].confidence.max() == 1.0
    assert estimates[-1].seen


def test_the_papers_triangulation_works_too(motion, cameras, properties):
    errors, _ = follow(start(motion, cameras, properties, triangulation="paper"), motion)
    assert errors.mean() < 2e-3


def test_the_estimate_keeps_the_clamps_and_the_length(motion, cameras, properties):
    _, estimates = follow(start(motion, cameras, properties), motion)
    centerline, pose = estimates[-1].centerline, motion[0][-1]
    h = LENGTH / (N_NODES - 1)
    np.testing.assert_allclose(centerline[0], pose.left[:3, 3], atol=1e-12)
    np.testing.assert_allclose(centerline[1], pose.left[:3, 3] + h * pose.left[:3, 2], atol=1e-12)
    np.testing.assert_allclose(centerline[-1], pose.right[:3, 3], atol=1e-12)
    steps = np.linalg.norm(np.diff(centerline, axis=0), axis=1)
    np.testing.assert_allclose(steps, h, rtol=2e-2)


@pytest.mark.parametrize("youngs_modulus", [2e5, 5e6])
def test_a_rod_of_other_stiffness_than_assumed_is_found(motion, cameras, youngs_modulus):
    wrong = RodProperties(length=LENGTH, youngs_modulus=youngs_modulus)
    errors, _ = follow(start(motion, cameras, wrong), motion)
    assert errors[1:].mean() < 1e-3


def test_another_cable_where_the_rod_is_expected_is_not_the_rod(cameras, properties):
    true = RodProperties(LENGTH, youngs_modulus=1e7, rest_curvature=(2.5, 2.5, 0.0))
    rod = CosseratRod(true)
    poses = [boundary_at(step) for step in range(len(MOVES))]
    shapes = [rod.settle(pose).positions for pose in poses]
    lying = CosseratRod(properties).settle(poses[0]).positions[12:38]  # where it is expected
    views = []
    for shape in shapes:
        views.append([draw_cable(camera, shape, colour=(95, 100, 120)) for camera in cameras[:2]])
        for view in views[-1]:
            points = np.round(16 * view.camera.project(lying)).astype(np.int32)
            cv2.polylines(view.image, [points], False, (250, 220, 20), 3, cv2.LINE_AA, 4)
    tracker = MultiViewTracker(RodPredictor(properties), cameras[:2])
    tracker.initialise(poses[0], properties)
    errors, _ = follow(tracker, (poses, shapes, views))
    assert errors.mean() < 1e-3
    assert errors[-1].max() < 4e-3


def test_looks_are_not_guessed_before_the_rod_is_found(motion, cameras, properties):
    poses, shapes, views = motion
    tracker = start(motion, cameras, properties)
    rng = np.random.default_rng(0)
    empty = [
        View(rng.normal(150, 4, view.image.shape).astype(np.uint8), view.camera)
        for view in views[0]
    ]
    estimate = tracker.update(empty, BoundaryDisplacement.zero(), 0.0)
    assert not estimate.seen
    for camera in cameras:
        assert f"view '{camera.name}': nothing in it looks like the rod" in estimate.message
    np.testing.assert_allclose(estimate.centerline, shapes[0], atol=1e-4)
    estimate = tracker.update(views[1], poses[0].displacement_to(poses[1]), 0.1)
    assert np.linalg.norm(estimate.centerline - shapes[1], axis=1).mean() < 5e-4


def test_hidden_nodes_are_told_and_bridged(motion, cameras, properties):
    _, shapes, clear = motion
    covered = [list(views) for views in clear]
    for step in (2, 3):
        for i, view in enumerate(clear[step]):
            low, high = (
                f(view.camera.project(shapes[step][20:32]), axis=0) for f in (np.min, np.max)
            )
            image = view.image.copy()
            rows, columns = (
                slice(int(low[1]) - 8, int(high[1]) + 9),
                slice(int(low[0]), int(high[0])),
            )
            image[rows, columns] = (90, 110, 60)
            covered[step][i] = View(image, view.camera)
    errors, estimates = follow(start(motion, cameras, properties), motion, covered)
    hidden = ~estimates[3].visible
    assert hidden[:, 23:29].all()
    assert not hidden[:, 5:17].any()
    assert estimates[3].confidence[25] == 0.0
    assert errors[2:4].mean() < 1e-3
    assert errors[4].mean() < 5e-4


def test_a_missing_view_is_named_and_survived(motion, cameras, properties):
    views = [[v[0], None, v[2]] for v in motion[2]]
    errors, estimates = follow(start(motion, cameras, properties), motion, views)
    assert "view 'top' is missing" in estimates[-1].message
    assert errors.mean() < 1e-3
    one = [v[:1] for v in motion[2]]
    errors, _ = follow(start(motion, cameras[:1], properties), motion, one)
    assert errors.mean() < 2e-3


def black(views):
    return [View(np.zeros_like(view.image), view.camera) for view in views]


def test_unseen_falls_back_to_the_prediction_then_is_lost_then_found(motion, cameras, properties):
    poses, shapes, views = motion
    tracker = start(motion, cameras, properties, lost_after=1.0)
    tracker.update(views[0], BoundaryDisplacement.zero(), 0.0)
    displacement = poses[0].displacement_to(poses[1])
    estimate = tracker.update(black(views[1]), displacement, 0.5)
    assert not estimate.seen
    assert not estimate.visible.any()
    assert (estimate.confidence == 0.0).all()
    assert "prediction" in estimate.message
    np.testing.assert_allclose(estimate.centerline, shapes[1], atol=2e-3)
    with pytest.raises(TrackLost, match=r"1\.50 s"):
        tracker.update([], BoundaryDisplacement.zero(), 1.5)
    estimate = tracker.update(views[1], BoundaryDisplacement.zero(), 1.6)
    assert estimate.seen
    assert np.linalg.norm(estimate.centerline - shapes[1], axis=1).mean() < 5e-4


@pytest.mark.parametrize(
    "answer",
    [np.full((N_NODES, 3), np.nan), np.zeros((4, 3)), RodDiverged("no equilibrium")],
    ids=["nan", "shape", "diverged"],
)
def test_a_failing_predictor_is_survived_and_named(motion, cameras, properties, answer):
    errors, estimates = follow(start(motion, cameras, properties, Broken(answer)), motion)
    assert "predictor failed" in estimates[-1].message
    assert errors.mean() < 1e-3


def test_one_gripper(cameras):
    properties = RodProperties(length=LENGTH, youngs_modulus=3e7)
    rod = CosseratRod(properties)
    tracker = MultiViewTracker(RodPredictor(properties), cameras)
    poses = [BoundaryPoses(boundary_at(step).left) for step in range(4)]
    tracker.initialise(poses[0], properties)
    for step, pose in enumerate(poses):
        shape = rod.settle(pose).positions
        displacement = poses[max(step - 1, 0)].displacement_to(pose)
        estimate = tracker.update([draw_cable(c, shape) for c in cameras], displacement)
        assert np.linalg.norm(estimate.centerline - shape, axis=1).mean() < 2e-3


def test_bad_arguments_are_named(motion, cameras, properties):
    tracker = MultiViewTracker(RodPredictor(properties), cameras[:2])
    with pytest.raises(ValueError, match="initialise"):
        tracker.update([], BoundaryDisplacement.zero())
    away = CameraModel.looking_at("away", (0, -1, 0.4), (0, -2, 0.4))
    with pytest.raises(ValueError, match="sees the rod"):
        MultiViewTracker(StandStill(), [away]).initialise(motion[0][0], properties)
    with pytest.raises(ValueError, match="distinct"):
        MultiViewTracker(StandStill(), [away, away])
    with pytest.raises(ValueError, match="centerline"):
        tracker.initialise(motion[0][0], properties, centerline=np.zeros((3, 3)))
    tracker.initialise(motion[0][0], properties)
    with pytest.raises(ValueError, match="third"):
        tracker.update(motion[2][0], BoundaryDisplacement.zero())
    with pytest.raises(ValueError, match="right clamp"):
        tracker.update(motion[2][0][:2], BoundaryDisplacement(np.zeros(6)))
    with pytest.raises(ValueError, match="triangulation"):
        TrackerConfig(triangulation="best")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="lost_after"):
        TrackerConfig(lost_after=0.0)
    with pytest.raises(ValueError, match="predictor"):
        make_predictor("oracle", properties)


def test_overstretched_clamps_do_not_crash(motion, cameras, properties):
    tracker = start(motion, cameras, properties)
    apart = BoundaryDisplacement(np.array([-0.2, 0, 0, 0, 0, 0]), np.zeros(6))
    estimate = tracker.update(motion[2][0], apart)
    assert "predictor failed" in estimate.message
    assert np.isfinite(estimate.centerline).all()
    back = tracker.update(motion[2][0], apart.scaled(-1.0))
    assert np.linalg.norm(back.centerline - motion[1][0], axis=1).mean() < 1e-3


def test_the_occupancy_mask_follows_the_width_and_the_image():
    pixels = np.column_stack([np.linspace(50.0, 150.0, 11), np.full(11, 40.0)])
    (x, y), mask = occupancy_mask(pixels, np.full(11, 10.0), (100, 300))
    assert (x, y) == (40, 30)
    inside = np.flatnonzero(mask[:, 60 - x])
    assert inside[0] + y == pytest.approx(30, abs=1)
    assert inside[-1] + y == pytest.approx(50, abs=1)
    (x, y), mask = occupancy_mask(pixels, np.full(11, 1000.0), (100, 300))
    assert (x, y) == (0, 0)
    assert mask.shape == (100, 300)
    assert mask.all()
    pixels[3] = np.nan
    assert occupancy_mask(pixels, np.full(11, 10.0), (100, 300))[1].any()


def test_the_rod_predictor_without_memory_is_the_rod(properties):
    poses = [boundary_at(step) for step in (0, 2)]
    rod = CosseratRod(properties)
    shapes = [rod.settle(pose).positions for pose in poses]
    predictor = RodPredictor(properties, memory=0.0)
    moved = predictor.predict(shapes[0], poses[0].displacement_to(poses[1]), poses[0])
    np.testing.assert_allclose(moved, shapes[1], atol=1e-5)
    offset = np.array([0.0, 0.002, 0.0])
    predictor = RodPredictor(properties, memory=0.5)
    still = predictor.predict(shapes[0] + offset, poses[0].displacement_to(poses[0]), poses[0])
    np.testing.assert_allclose(still, shapes[0] + 0.5 * offset, atol=1e-5)
    with pytest.raises(ValueError, match="boundary"):
        RodPredictor(properties).predict(shapes[0], BoundaryDisplacement.zero())
    with pytest.raises(ValueError, match="memory"):
        RodPredictor(properties, memory=2.0)
