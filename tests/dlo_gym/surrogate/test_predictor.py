import dataclasses

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, frame_along, transform_points
from dlo_gym.geometry.se3 import pose as make_pose
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.initial_shapes import random_boundary
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.surrogate.evaluation import evaluate_predictor
from dlo_gym.surrogate.predictor import ShapePredictor
from dlo_gym.surrogate.simulation import random_action
from dlo_gym.surrogate.weights_file import SHIPPED, SHIPPED_ONE_ROD, load_weights


@pytest.fixture(scope="module")
def predictor() -> ShapePredictor:
    return ShapePredictor.load()


@pytest.fixture(scope="module")
def exact() -> ShapePredictor:
    return ShapePredictor(load_weights(SHIPPED), dtype=np.float64)


def held_rod(seed: int) -> CosseratRod:
    rod = CosseratRod(RodProperties(length=0.5))
    rod.settle(random_boundary(np.random.default_rng(seed), 0.5))
    return rod


def move(rod: CosseratRod, seed: int, size: float = 0.2) -> BoundaryDisplacement:
    rng = np.random.default_rng(seed)
    return random_action(rng, rod.state.boundary, 0.05 * size, np.pi / 8 * size)


def vector(values) -> BoundaryDisplacement:
    return BoundaryDisplacement.from_vector(values)


class TestPrediction:
    def test_agrees_with_fresh_rods_at_the_reference_parameters(self, predictor, small_rollouts):
        scores = evaluate_predictor(
            lambda rod: predictor.for_rod(rod).predict, small_rollouts, n_steps=(1, 2, 3)
        )
        for score in scores:
            assert score.mean_mm <= 0.5
            assert score.mean_mm <= 0.06 * score.motion_mm

    def test_agrees_with_fresh_rods_of_all_kinds(self, predictor, varied_rollouts):
        reference = ShapePredictor.load(SHIPPED_ONE_ROD)
        told, not_told = (
            evaluate_predictor(
                lambda rod, p=p: p.for_rod(rod).predict,
                varied_rollouts,
                n_steps=(1, 2, 3),
                stride=3,
            )
            for p in (predictor, reference)
        )
        for score, without in zip(told, not_told, strict=True):
            assert score.mean_mm <= 0.1 * score.motion_mm
            assert score.mean_mm <= 0.5 * without.mean_mm

    def test_agrees_with_the_environment_s_start(self, predictor):
        forward = frame_along([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        rod = CosseratRod(RodProperties(length=0.5))
        clamps = [make_pose(forward, [x, 0.0, 0.34]) for x in (-0.2, 0.2)]
        rod.settle(BoundaryPoses(*clamps))
        for seed in range(5):
            start, action = rod.state, move(rod, seed)
            predicted = predictor.predict(start.positions, action)
            truth = rod.move(action).positions
            assert np.linalg.norm(predicted - truth, axis=1).mean() < 1.0e-3

    def test_a_null_action_moves_nothing(self, predictor):
        rng = np.random.default_rng(0)
        for seed in range(5):
            x = held_rod(seed).state.positions + 1e-3 * rng.standard_normal((51, 3))
            np.testing.assert_array_equal(predictor.predict(x, BoundaryDisplacement.zero()), x)

    def test_the_clamped_elements_follow_their_clamps(self, predictor):
        rod = held_rod(1)
        x, action = rod.state.positions, move(rod, 2)
        predicted = predictor.predict(x, action)
        np.testing.assert_allclose(predicted[0], x[0] + action.left[:3], atol=1e-12)
        np.testing.assert_allclose(predicted[-1], x[-1] + action.right[:3], atol=1e-12)
        first = exp_so3(action.left[3:]) @ (x[1] - x[0])
        last = exp_so3(action.right[3:]) @ (x[-1] - x[-2])
        np.testing.assert_allclose(predicted[1] - predicted[0], first, atol=1e-12)
        np.testing.assert_allclose(predicted[-1] - predicted[-2], last, atol=1e-12)

    def test_place_and_heading_do_not_matter(self, exact):
        rod = held_rod(3)
        x, action = rod.state.positions, move(rod, 4)
        moved = make_pose(exp_so3([0.0, 0.0, 2.1]), [0.3, -1.2, 0.5])
        turned = vector((action.vector.reshape(4, 3) @ moved[:3, :3].T).ravel())
        expected = transform_points(moved, exact.predict(x, action))
        np.testing.assert_allclose(
            exact.predict(transform_points(moved, x), turned), expected, atol=1e-12
        )

    def test_rotation_about_the_rod_s_axis_is_without_effect_to_first_order(self, exact):
        rod = held_rod(3)
        x = rod.state.positions
        _, jacobian = exact.predict_with_jacobian(x, BoundaryDisplacement.zero())
        first, last = x[1] - x[0], x[-1] - x[-2]
        assert np.abs(jacobian[:, :, 3:6] @ first / np.linalg.norm(first)).max() < 1e-9
        assert np.abs(jacobian[:, :, 9:] @ last / np.linalg.norm(last)).max() < 1e-9

    def test_similar_rods_are_alike(self, exact):
        """Lengths, and with them radius and Young's modulus, doubled: seen from nearer."""
        rod = held_rod(3)
        x, action = rod.state.positions, move(rod, 4)
        large = exact.for_rod(RodProperties(length=1.0, radius=0.006, youngs_modulus=2e6))
        scaled = vector(action.vector * np.tile([2.0, 2.0, 2.0, 1.0, 1.0, 1.0], 2))
        expected = 2.0 * exact.predict(x, action)
        np.testing.assert_allclose(large.predict(2.0 * x, scaled), expected, atol=1e-6)

    def test_what_a_rod_is_made_of_matters(self, exact):
        rod = held_rod(3)
        x, action = rod.state.positions, move(rod, 4)
        predicted = exact.predict(x, action)
        for change in (
            {"youngs_modulus": 5e6}, {"density": 3e3}, {"length": 0.55}, {"poisson_ratio": 0.1},
            {"rest_curvature": (3.0, 0.0, 0.0)},
        ):  # fmt: skip
            other = exact.for_rod(dataclasses.replace(exact.properties, **change))
            assert np.abs(other.predict(x, action) - predicted).max() > 1e-6

    def test_single_precision_is_enough(self, predictor, exact):
        rod = held_rod(5)
        x, action = rod.state.positions, move(rod, 6)
        np.testing.assert_allclose(
            predictor.predict(x, action), exact.predict(x, action), atol=1e-7
        )

    def test_ends_above_each_other_and_doubled_nodes_give_finite_shapes(self, predictor):
        x = np.zeros((51, 3))
        x[:, 2] = np.linspace(0.0, 0.4, 51)
        action = vector(np.full(12, 0.005))
        for centerline in (x, np.zeros((51, 3))):
            shape, jacobian = predictor.predict_with_jacobian(centerline, action)
            assert np.isfinite(shape).all()
            assert np.isfinite(jacobian).all()

    def test_the_input_is_left_alone(self, predictor):
        x = held_rod(0).state.positions
        before = x.copy()
        predictor.predict_with_jacobian(x, vector(np.full(12, 0.01)))
        np.testing.assert_array_equal(x, before)


class TestDerivatives:
    @pytest.mark.parametrize("action_size", [0.0, 1e-5, 0.2])
    def test_jacobian_against_finite_differences(self, exact, action_size):
        rod = held_rod(7)
        x, at = rod.state.positions, move(rod, 8, action_size).vector
        _, jacobian = exact.predict_with_jacobian(x, vector(at))
        step = 1e-7
        for i, direction in enumerate(np.eye(12)):
            ahead, behind = (exact.predict(x, vector(at + s * direction)) for s in (step, -step))
            difference = (ahead - behind) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, i], difference, atol=2e-6)

    def test_tangents_against_finite_differences(self, exact):
        rng = np.random.default_rng(9)
        rod = held_rod(9)
        x, at = rod.state.positions, move(rod, 10).vector
        dx, da = rng.standard_normal((51, 3, 6)), rng.standard_normal((12, 6))
        _, tangents = exact.predict_with_tangents(x, vector(at), dx, da)
        step = 1e-7
        for i in range(6):
            ahead, behind = (
                exact.predict(x + s * dx[:, :, i], vector(at + s * da[:, i])) for s in (step, -step)
            )
            difference = (ahead - behind) / (2 * step)
            scale = np.abs(difference).max()
            np.testing.assert_allclose(tangents[:, :, i], difference, atol=1e-5 * scale)

    def test_tangents_and_jacobian_agree(self, predictor):
        rng = np.random.default_rng(11)
        rod = held_rod(11)
        x, action = rod.state.positions, move(rod, 12)
        directions = rng.standard_normal((12, 4))
        shape, jacobian = predictor.predict_with_jacobian(x, action)
        same, tangents = predictor.predict_with_tangents(
            x, action, np.zeros((51, 3, 4)), directions
        )
        np.testing.assert_array_equal(shape, same)
        np.testing.assert_array_equal(shape, predictor.predict(x, action))
        np.testing.assert_allclose(tangents, jacobian @ directions, atol=1e-5)

    def test_moving_the_whole_world_moves_the_prediction_with_it(self, exact):
        rod = held_rod(13)
        x, action = rod.state.positions, move(rod, 14)
        z = np.array([0.0, 0.0, 1.0])
        shift = np.broadcast_to([0.3, -0.2, 0.1], (51, 3))
        dx = np.stack([shift, np.cross(z, x)], axis=-1)
        spin = np.cross(z, action.vector.reshape(4, 3)).ravel()
        da = np.stack([np.zeros(12), spin], axis=-1)
        shape, tangents = exact.predict_with_tangents(x, action, dx, da)
        np.testing.assert_allclose(tangents[:, :, 0], shift, atol=1e-12)
        np.testing.assert_allclose(tangents[:, :, 1], np.cross(z, shape), atol=1e-12)

    def test_jacobian_is_near_the_rod_s_sensitivity(self, predictor):
        errors, sizes = [], []
        for seed in range(8):
            rod = held_rod(seed)
            d3 = rod.state.boundary.left[:3, 2], rod.state.boundary.right[:3, 2]
            transverse = np.eye(12)
            transverse[3:6, 3:6] -= np.outer(d3[0], d3[0])
            transverse[9:, 9:] -= np.outer(d3[1], d3[1])
            _, jacobian = predictor.predict_with_jacobian(
                rod.state.positions, BoundaryDisplacement.zero()
            )
            truth = rod.sensitivity() @ transverse
            errors.append(np.linalg.norm(jacobian @ transverse - truth))
            sizes.append(np.linalg.norm(truth))
        assert np.median(np.divide(errors, sizes)) < 0.2


class TestBadInput:
    def test_one_arm_only(self, predictor):
        with pytest.raises(ValueError, match="both clamps"):
            predictor.predict(np.zeros((51, 3)), BoundaryDisplacement(np.zeros(6)))

    def test_another_number_of_nodes(self, predictor):
        with pytest.raises(ValueError, match=r"\(51, 3\), got shape \(41, 3\)"):
            predictor.predict(np.zeros((41, 3)), BoundaryDisplacement.zero())

    def test_nan(self, predictor):
        with pytest.raises(ValueError, match="finite"):
            predictor.predict(np.full((51, 3), np.nan), BoundaryDisplacement.zero())

    def test_tangents_of_other_shapes(self, predictor):
        x, still = held_rod(0).state.positions, BoundaryDisplacement.zero()
        with pytest.raises(ValueError, match="displacement_tangents"):
            predictor.predict_with_tangents(x, still, np.zeros((51, 3, 2)), np.zeros((10, 2)))
        with pytest.raises(ValueError, match="centerline_tangents"):
            predictor.predict_with_tangents(x, still, np.zeros((51, 3, 3)), np.zeros((12, 2)))
