"""Cameras and bases from synthetic samples of known noise."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_gym.geometry.se3 import exp_so3, pose
from sim2real.calibration.adjustment import CellGeometry, _Problem, _State, adjust
from sim2real.calibration.board import Detection
from sim2real.calibration.closed_form import METHODS
from sim2real.calibration.hand_eye import Degenerate, board_pose, rms_px, solve_eye_to_hand
from sim2real.calibration.normal_equations import Noise
from sim2real.calibration.solve import calibrate_cell
from sim2real.calibration.verify import verify
from tests.sim2real.calibration_data import (
    BASES,
    BOARD,
    T_TCP_BOARD,
    apart,
    cell_cameras,
    synthetic_samples,
    views_by_hand,
)

CAMERAS = cell_cameras()
# As measured by tape: the right base, and where the cameras are, matter little to the start.
ROUGH_BASES = BASES | {
    "right": BASES["right"] @ pose(exp_so3([0.0, 0.02, 0.1]), [0.03, 0.0, -0.02])
}


def rough(cameras):
    return {
        name: replace(
            c, T_world_camera=c.T_world_camera @ pose(exp_so3([0.3, 0.1, 0]), [0.2, 0, 0])
        )
        for name, c in cameras.items()
    }


def spoil(sample, shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    return replace(sample, T_base_tcp=sample.T_base_tcp @ pose(exp_so3(turn), shift))


def solve(samples, cameras=CAMERAS, seed=0, **options):
    return calibrate_cell(
        BOARD, samples, rough(cameras), ROUGH_BASES, np.random.default_rng(seed), **options
    )


@pytest.fixture(scope="module")
def samples():
    return synthetic_samples(CAMERAS, np.random.default_rng(5), 15)


@pytest.fixture(scope="module")
def found(samples):
    return solve(samples)


def test_cameras_and_the_right_base_are_found(found):
    for name, camera in CAMERAS.items():
        mm, deg = apart(found.geometry.cameras[name].T_world_camera, camera.T_world_camera)
        assert mm <= 1.0
        assert deg <= 0.1
    mm, deg = apart(found.geometry.T_world_base["right"], BASES["right"])
    assert mm <= 1.0
    assert deg <= 0.1
    np.testing.assert_array_equal(found.geometry.T_world_base["left"], BASES["left"])
    for side in BASES:
        mm, deg = apart(found.geometry.T_tcp_board[side], T_TCP_BOARD)
        assert mm < 0.5
        assert deg < 0.1
    assert found.verdict == "good"
    assert found.reasons == ()


def test_the_noises_are_told_apart(found):
    noise = found.adjustment.noise
    assert noise.corner_px == pytest.approx(0.2, rel=0.1)
    assert noise.position_m == pytest.approx(5e-5, rel=0.4)
    assert noise.rotation_rad == pytest.approx(np.radians(0.01), rel=0.5)


def test_errors_are_as_large_as_the_deviations_say():
    ratios = []
    for seed in range(4):
        found = solve(synthetic_samples(CAMERAS, np.random.default_rng(20 + seed), 12))
        for name, camera in CAMERAS.items():
            off = apart(found.geometry.cameras[name].T_world_camera, camera.T_world_camera)
            ratios.append(np.array(off) / found.adjustment.deviations[f"camera/{name}"])
    assert 0.4 < np.sqrt(np.square(ratios).mean()) < 2.0


def test_every_closed_form_is_near_the_refined_result(found):
    for (side, name), hand_eye in found.hand_eyes.items():
        assert set(hand_eye.by_method) == set(METHODS)
        refined = found.geometry.cameras[name].T_world_camera
        for method, T_base_camera in hand_eye.by_method.items():
            mm, deg = apart(found.geometry.T_world_base[side] @ T_base_camera, refined)
            assert mm < 25.0, (method, side, name)
            assert deg < 0.8, (method, side, name)
            truth = BASES[side] @ T_base_camera
            assert apart(truth, CAMERAS[name].T_world_camera)[0] < 25.0


def test_refinement_is_better_than_the_closed_forms(found):
    for (side, name), hand_eye in found.hand_eyes.items():
        truth = CAMERAS[name].T_world_camera
        refined = apart(found.geometry.cameras[name].T_world_camera, truth)[0]
        best = min(apart(BASES[side] @ T, truth)[0] for T in hand_eye.by_method.values())
        assert refined < max(best, 0.3)


def test_wrong_poses_and_wrong_detections_are_rejected(samples):
    spoilt = list(samples)
    spoilt[2] = spoil(samples[2], shift=(0.0, 0.006, 0.0))
    spoilt[5] = spoil(samples[5], turn=(0.03, 0.0, 0.0))
    spoilt[8] = replace(samples[8], T_base_tcp=samples[9].T_base_tcp)
    spoilt[20] = spoil(samples[20], shift=(0.05, 0.02, 0.0))
    jumbled = {
        name: Detection(d.ids, d.corners[::-1].copy()) for name, d in samples[24].detections.items()
    }
    spoilt[24] = replace(samples[24], detections=jumbled)
    found = solve(spoilt)
    rejected = {view.sample for view in found.views if not view.kept}
    assert rejected == {2, 5, 8, 20, 24}
    for name, camera in CAMERAS.items():
        mm, deg = apart(found.geometry.cameras[name].T_world_camera, camera.T_world_camera)
        assert mm <= 1.0
        assert deg <= 0.1


def test_good_samples_lose_nothing(found):
    assert all(view.kept for view in found.views)


def test_unknown_intrinsics_are_refined_with_the_rest():
    rng = np.random.default_rng(1)
    taken = synthetic_samples(CAMERAS, rng, 25, corner_px=0.1)
    by_hand = {name: views_by_hand(c, rng, 20, 0.1) for name, c in CAMERAS.items()}
    wrong = {
        name: replace(c, K=c.K * [[1.01], [1.01], [1.0]], distortion=np.zeros(5))
        for name, c in CAMERAS.items()
    }
    found = solve(taken, wrong, refine_intrinsics=True, lens_views=by_hand)
    for name, camera in CAMERAS.items():
        mm, deg = apart(found.geometry.cameras[name].T_world_camera, camera.T_world_camera)
        assert mm <= 1.0
        assert deg <= 0.1
        off = found.geometry.cameras[name].K - camera.K
        assert np.abs(off[[0, 1], [0, 1]]).max() < 2.0
        assert np.abs(off[:2, 2]).max() < 2.0
    assert all(len(d) == 9 for d in found.adjustment.intrinsics_deviations.values())


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_turns_about_one_axis_only_are_refused_with_the_axis_to_add(axis):
    side = {"side": CAMERAS["side"], "top": CAMERAS["top"]}
    taken = synthetic_samples(side, np.random.default_rng(0), 12, sides=("left",), axis=axis)
    with pytest.raises(Degenerate, match="about a second axis.* add poses turned by 25 to 35") as e:
        solve(taken)
    text = str(e.value).split("degrees about")[-1]
    wanted = np.array([float(x) for x in text.split("[")[1].split("]")[0].split(",")])
    assert abs(wanted @ axis) < 0.2
    assert np.linalg.norm(wanted) == pytest.approx(1.0, abs=0.02)


def test_too_few_poses_and_an_unseeing_camera_are_named(samples):
    with pytest.raises(Degenerate, match="camera 'side'.*at least 5 are needed"):
        solve(samples[:3])
    blind = [
        replace(s, detections={"side": s.detections["side"], "top": Detection.nothing()})
        for s in samples
    ]
    with pytest.raises(Degenerate, match="camera 'top' cannot be calibrated.*saw the board in 0"):
        solve(blind)


def test_one_arm_alone_leaves_the_other_base(samples):
    found = solve([sample for sample in samples if sample.side == "right"])
    assert found.anchor == "right"
    assert set(found.adjustment.deviations) == {"camera/side", "camera/top", "board/right"}
    np.testing.assert_array_equal(found.geometry.T_world_base["right"], ROUGH_BASES["right"])


def test_arms_that_no_camera_sees_both_of_are_not_tied_together(samples):
    def only(sample, name):
        return replace(sample, detections={name: sample.detections[name]})

    apart_samples = [only(s, "side" if s.side == "left" else "top") for s in samples]
    found = solve(apart_samples)
    assert "base/right" not in found.adjustment.deviations
    assert any("no camera saw the board in both grippers" in reason for reason in found.reasons)


def test_the_same_samples_and_seed_give_the_same_numbers(samples, found):
    again = solve(samples)
    for name in CAMERAS:
        np.testing.assert_array_equal(
            again.geometry.cameras[name].T_world_camera, found.geometry.cameras[name].T_world_camera
        )


def test_a_rattling_board_gets_no_good_verdict():
    taken = synthetic_samples(
        CAMERAS, np.random.default_rng(0), 12, position_m=2e-3, rotation_deg=0.5
    )
    found = solve(taken)
    assert found.verdict == "bad"
    assert any("firm in the gripper" in reason for reason in found.reasons)


def test_poses_of_boards_are_exact_without_noise():
    camera = CAMERAS["side"]
    taken = synthetic_samples(
        CAMERAS, np.random.default_rng(3), 6, corner_px=0.0, position_m=0.0, rotation_deg=0.0
    )
    for sample in taken:
        detection = sample.detections["side"]
        if not len(detection):
            continue
        T = board_pose(camera, BOARD, detection)
        expected = camera.T_camera_world @ BASES[sample.side] @ sample.T_base_tcp @ T_TCP_BOARD
        assert apart(T, expected)[0] < 1e-3
        assert rms_px(camera, BOARD, expected, detection) < 1e-9


def test_half_the_poses_may_nearly_be_wrong():
    rng = np.random.default_rng(7)
    taken = synthetic_samples({"side": CAMERAS["side"]}, rng, 20, sides=("left",))
    wrong = range(0, 14, 2)
    for k in wrong:
        taken[k] = spoil(
            taken[k], shift=rng.uniform(-0.05, 0.05, 3), turn=rng.uniform(-0.1, 0.1, 3)
        )
    hand_eye = solve_eye_to_hand(
        CAMERAS["side"],
        BOARD,
        np.stack([sample.T_base_tcp for sample in taken]),
        [sample.detections["side"] for sample in taken],
        rng,
    )
    assert not hand_eye.inliers[list(wrong)].any()
    assert hand_eye.inliers.sum() == 13
    truth = CAMERAS["side"].T_world_camera
    assert apart(BASES["left"] @ hand_eye.T_base_camera, truth)[0] < 5.0


@pytest.mark.parametrize("fixed", [False, True])
def test_normal_equations_are_the_derivative_of_the_residuals(fixed):
    rng = np.random.default_rng(0)
    taken = synthetic_samples(CAMERAS, rng, 3, corner_px=0.5)
    start = CellGeometry(
        dict(CAMERAS),
        dict(BASES),
        {side: T_TCP_BOARD @ pose(exp_so3([0.01, 0, 0]), [0, 1e-3, 0]) for side in BASES},
    )
    by_hand = {} if fixed else {"top": views_by_hand(CAMERAS["top"], rng, 2)}
    problem = _Problem(BOARD, taken, start, ("right",), 0 if fixed else 15, by_hand)
    state = _State(start, 1e-4 * rng.standard_normal((len(taken) + len(problem.by_hand), 6)))
    # Corners far from their places count linearly, which is flat enough only for the gradient.
    noise = Noise(20.0, 1e-3, 1e-3)
    normal = problem.linearise(state, noise)
    zero, zero_c = np.zeros(problem.size), np.zeros_like(state.corrections)
    for j in range(problem.size):
        step = zero.copy()
        step[j] = 1e-6
        costs = [
            problem.linearise(problem.moved(state, s, zero_c), noise).cost for s in (step, -step)
        ]
        slope = (costs[0] - costs[1]) / 4e-6
        assert slope == pytest.approx(normal.b[j], rel=1e-3, abs=1e-4 * np.abs(normal.b).max())
    for k in range(len(zero_c)):
        for j in range(6):
            step = zero_c.copy()
            step[k, j] = 1e-6
            costs = [
                problem.linearise(problem.moved(state, zero, s), noise).cost for s in (step, -step)
            ]
            slope = (costs[0] - costs[1]) / 4e-6
            assert slope == pytest.approx(
                normal.b_c[k, j], rel=2e-3, abs=1e-3 * np.abs(normal.b_c).max()
            )


def test_fixed_cameras_stay_and_the_board_is_found(samples):
    start = CellGeometry(
        dict(CAMERAS),
        dict(BASES),
        {side: T_TCP_BOARD @ pose(exp_so3([0.02, 0.0, 0.01]), [0.004, 0.0, 0.0]) for side in BASES},
    )
    result = adjust(BOARD, samples, start, fixed_cameras=True)
    for name, camera in CAMERAS.items():
        assert result.geometry.cameras[name] is camera
    assert apart(result.geometry.T_tcp_board["left"], T_TCP_BOARD)[0] < 0.2
    with pytest.raises(ValueError, match="fixed_cameras"):
        adjust(BOARD, samples, start, fixed_cameras=True, refine_intrinsics=True)


class TestVerify:
    fresh = synthetic_samples(CAMERAS, np.random.default_rng(40), 8)

    def check(self, cameras, bases=BASES, samples=None):
        return verify(BOARD, samples or self.fresh, cameras, bases, np.random.default_rng(0))

    def test_what_still_holds_is_good(self):
        result = self.check(CAMERAS)
        assert result.verdict == "good"
        assert result.residuals["all"].mm < 0.5
        assert all(by.mm < 1.0 for by in result.moved.values())

    @pytest.mark.parametrize("direction", np.eye(3))
    def test_a_camera_moved_by_three_millimetres_is_bad_and_named(self, direction):
        moved = CAMERAS["side"].T_world_camera.copy()
        moved[:3, 3] += 3e-3 * direction
        result = self.check(CAMERAS | {"side": replace(CAMERAS["side"], T_world_camera=moved)})
        assert result.verdict == "bad"
        assert result.moved["camera/side"].mm == pytest.approx(3.0, abs=0.8)
        assert result.moved["camera/top"].mm < 1.0
        assert any("camera side seems to have moved by" in reason for reason in result.reasons)
        assert not any("camera top seems" in reason for reason in result.reasons)

    def test_a_moved_base_is_named(self):
        bases = BASES | {"right": BASES["right"] @ pose(np.eye(3), [0.0, 0.004, 0.0])}
        result = self.check(CAMERAS, bases)
        assert result.verdict == "bad"
        assert result.moved["base/right"].mm == pytest.approx(4.0, abs=0.8)

    def test_a_few_samples_already_show_a_camera_that_was_knocked(self):
        knocked = CAMERAS["side"].T_world_camera @ pose(exp_so3([0.0, 0.01, 0.0]), np.zeros(3))
        few = [s for s in self.fresh if s.side == "left"][:4]
        cameras = CAMERAS | {"side": replace(CAMERAS["side"], T_world_camera=knocked)}
        assert self.check(cameras, samples=few).verdict == "bad"

    def test_too_few_samples_are_refused(self):
        with pytest.raises(ValueError, match="at least 3 of the left arm"):
            self.check(CAMERAS, samples=self.fresh[:2])
