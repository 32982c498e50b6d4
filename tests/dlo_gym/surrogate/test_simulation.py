import dataclasses
import itertools

import numpy as np
import pytest

from dlo_gym.exceptions import DatasetError, RodDiverged
from dlo_gym.geometry.se3 import quaternion_to_matrix
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.surrogate import simulation as module
from dlo_gym.surrogate.evaluation import boundary
from dlo_gym.surrogate.simulation import RolloutSettings, plausible, simulate_rollout

TINY = RolloutSettings(n_rollouts=6, seed=1, n_actions=1, n_steps=2, n_elements=8, shard_size=2)


def test_states_are_equilibria_of_the_recorded_clamps(small_rollouts):
    for i in range(3):
        positions = small_rollouts.positions[i].astype(float)
        rod = CosseratRod(small_rollouts.properties(i), 50)
        for state in (0, 4, 10):
            held = boundary(positions[state], small_rollouts.clamps[i, state])
            settled = rod.settle(held, start=positions[state])
            np.testing.assert_allclose(settled.positions, positions[state], atol=2e-6)


def test_moves_stay_within_the_action_and_do_not_turn_the_rod_about_its_axis(
    small_rollouts, small_settings
):
    s = small_settings
    for positions, clamps in zip(small_rollouts.positions, small_rollouts.clamps, strict=True):
        held = [boundary(x, c) for x, c in zip(positions.astype(float), clamps, strict=True)]
        for before, after in itertools.pairwise(held):
            twists = before.displacement_to(after).vector.reshape(2, 2, 3)
            assert np.abs(twists[:, 0]).max() <= s.translation / s.n_steps + 1e-6
            assert np.linalg.norm(twists[:, 1], axis=1).max() <= (
                np.sqrt(2) * s.rotation / s.n_steps + 1e-5
            )
            for clamp, twist in zip((before.left, before.right), twists, strict=True):
                assert abs(clamp[:3, 2] @ twist[1]) < 1e-5


def test_an_action_is_divided_into_equal_steps(small_rollouts):
    ends = small_rollouts.positions[:, :, [0, -1]].astype(float)
    steps = np.diff(ends, axis=1).reshape(6, 2, 10, 2, 3)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[:, :, :1], steps.shape), atol=1e-6)


def test_lengths_and_clamp_distances_lie_in_their_ranges(small_rollouts):
    lengths = small_rollouts.lengths
    assert ((lengths >= 0.45) & (lengths <= 0.6)).all()
    chord = small_rollouts.positions[:, :, -1] - small_rollouts.positions[:, :, 0]
    ratio = np.linalg.norm(chord, axis=-1) / lengths[:, None]
    assert ratio.min() > 0.2
    assert ratio.max() < 0.99


def test_properties_lie_in_their_ranges_and_every_second_rod_is_straight():
    settings = dataclasses.replace(
        TINY, radius_min=0.002, radius_max=0.006, youngs_modulus_min=1e5, youngs_modulus_max=1e7,
        poisson_ratio_min=0.1, rest_curvature_max=4.0,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    rods = [settings.draw_rod(0.5, rng) for _ in range(400)]
    for name, low, high in (("radius", 0.002, 0.006), ("youngs_modulus", 1e5, 1e7)):
        place = np.log([getattr(rod, name) / low for rod in rods]) / np.log(high / low)
        assert 0.0 <= place.min() < 0.05
        assert 0.95 < place.max() <= 1.0
        assert abs(place.mean() - 0.5) < 0.05  # log-uniform
    assert all(0.1 <= rod.poisson_ratio <= 0.5 for rod in rods)
    bends = np.array([np.hypot(*rod.rest_curvature[:2]) for rod in rods])
    assert abs((bends == 0.0).mean() - 0.5) < 0.1
    assert 3.5 < bends.max() <= 4.0
    assert all(rod.rest_curvature[2] == 0.0 for rod in rods)


def test_other_materials_start_alike_and_are_asked_to_make_the_same_moves():
    stiff = dataclasses.replace(TINY, youngs_modulus_min=2e6, youngs_modulus_max=3e6)
    reference, other = simulate_rollout(TINY, 0), simulate_rollout(stiff, 0)
    ends = (slice(None), slice(None), [0, -1])
    np.testing.assert_array_equal(reference.positions[ends], other.positions[ends])
    assert np.abs(reference.positions - other.positions).max() > 1e-3
    assert 2e6 <= other.properties(0).youngs_modulus <= 3e6


def test_clamps_hold_the_first_and_last_element(small_rollouts):
    x = small_rollouts.positions.astype(float)
    elements = np.stack([x[:, :, 1] - x[:, :, 0], x[:, :, -1] - x[:, :, -2]], axis=2)
    elements /= np.linalg.norm(elements, axis=-1, keepdims=True)
    d3 = quaternion_to_matrix(small_rollouts.clamps)[..., 2]
    assert (elements * d3).sum(-1).min() > np.cos(0.05)


def test_a_rollout_depends_on_its_seed_and_index_alone():
    again = simulate_rollout(TINY, 4)
    np.testing.assert_array_equal(simulate_rollout(TINY, 4).positions, again.positions)
    other_seed = simulate_rollout(dataclasses.replace(TINY, seed=2), 4)
    assert np.abs(other_seed.positions - again.positions).max() > 1e-3
    assert np.abs(simulate_rollout(TINY, 5).positions - again.positions).max() > 1e-3


def test_an_action_that_the_rod_cannot_follow_is_drawn_again(monkeypatch):
    moves = []

    class Fragile(CosseratRod):
        def move(self, displacement):
            moves.append(displacement)
            if len(moves) == 4:
                raise RodDiverged("lost")
            return super().move(displacement)

    settings = dataclasses.replace(TINY, n_actions=1, n_steps=5)
    undisturbed = simulate_rollout(settings, 0)
    monkeypatch.setattr(module, "CosseratRod", Fragile)
    made = simulate_rollout(settings, 0)
    assert len(moves) == 9
    np.testing.assert_array_equal(made.positions[0, 0], undisturbed.positions[0, 0])
    ends = np.diff(made.positions[0][:, [0, -1]].astype(float), axis=0)
    np.testing.assert_allclose(ends, np.broadcast_to(ends[:1], ends.shape), atol=1e-6)


def test_a_rod_that_always_diverges_ends_in_an_error(monkeypatch):
    class Broken(CosseratRod):
        def settle(self, boundary, start=None):
            raise RodDiverged("lost")

    monkeypatch.setattr(module, "CosseratRod", Broken)
    with pytest.raises(DatasetError, match="rollout 3"):
        simulate_rollout(TINY, 3)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"n_rollouts": 0}, "n_rollouts"),
        ({"seed": -1}, "seed"),
        ({"n_elements": 2}, "n_elements"),
        ({"length_min": 0.7}, "length_min"),
        ({"translation": -0.1}, "translation"),
        ({"radius_min": 0.0}, "radius"),
        ({"radius_max": 0.001}, "radius_max"),
        ({"youngs_modulus_min": np.nan}, "youngs_modulus"),
        ({"poisson_ratio_max": 0.7}, "poisson_ratio"),
        ({"density": 0.0}, "density"),
        ({"rest_curvature_max": -1.0}, "rest_curvature_max"),
    ],
)
def test_settings_name_what_is_wrong(change, name):
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(TINY, **change)


def test_plausible_refuses_taut_touching_steep_and_folded(small_rollouts):
    held = boundary(small_rollouts.positions[0, 0].astype(float), small_rollouts.clamps[0, 0])
    along = (held.right[:3, 3] - held.left[:3, 3]) / held.distance
    assert plausible(held, 1.5 * held.distance)
    assert not plausible(held, 1.01 * held.distance)
    assert not plausible(held, 6.0 * held.distance)
    steep = dataclasses.replace(held, right=held.right.copy())
    steep.right[:3, 3] = held.left[:3, 3] + [0.01, 0.0, held.distance]
    assert not plausible(steep, 1.5 * held.distance)
    folded = dataclasses.replace(held, left=held.left.copy())
    folded.left[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ folded.left[:3, :3]
    folded.left[:3, 2] = -along
    assert not plausible(folded, 1.5 * held.distance)
