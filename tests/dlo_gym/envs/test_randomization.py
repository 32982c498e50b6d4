import gymnasium as gym
import numpy as np
import pytest

import dlo_gym  # noqa: F401
from dlo_gym.envs.randomization import Randomization
from dlo_gym.exceptions import RenderingUnavailable

STATE_ID = "dlo_gym/ShapeControl-v0"
EVERYTHING = Randomization(
    youngs_modulus=(3e5, 3e6),
    radius=(0.002, 0.004),
    length=(0.48, 0.52),
    density=(900.0, 1500.0),
    rest_curvature=(-0.5, 0.5),
    rod_color=(0.1, 0.9),
    camera_translation=(0.001, 0.003),
    camera_rotation=(0.002, 0.005),
    camera_latency=(0, 2),
    arm_latency=(0, 2),
    clutter=(0, 3),
)


@pytest.fixture(scope="module")
def env():
    return gym.make(STATE_ID, randomization=EVERYTHING)


def test_samples_fill_their_ranges():
    rng = np.random.default_rng(0)
    cameras = gym.make(STATE_ID).unwrapped.cell.cameras
    samples = [EVERYTHING.sample(rng, cameras) for _ in range(300)]
    for name in ("youngs_modulus", "radius", "length", "density", "rest_curvature", "rod_color"):
        low, high = getattr(EVERYTHING, name)
        values = np.array([np.atleast_1d(sample[name])[:2] for sample in samples])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    for name in ("camera_latency", "arm_latency"):
        assert {sample[name] for sample in samples} == {0, 1, 2}
    for name in ("camera_translation", "camera_rotation"):
        low, high = getattr(EVERYTHING, name)
        sizes = np.linalg.norm([sample[name] for sample in samples], axis=-1)
        assert sizes.shape == (300, len(cameras))
        assert low <= sizes.min() < sizes.max() <= high


def test_the_modulus_is_sampled_in_proportion():
    rng = np.random.default_rng(0)
    moduli = [EVERYTHING.sample(rng, ())["youngs_modulus"] for _ in range(400)]
    assert np.median(moduli) == pytest.approx(np.sqrt(3e5 * 3e6), rel=0.2)


def test_every_reset_has_another_rod_and_says_so(env):
    radii = []
    for seed in range(3):
        _, info = env.reset(seed=seed)
        said, cell = info["randomization"], env.unwrapped.cell
        assert said.keys() == set(EVERYTHING.__dataclass_fields__) - {"friction"}
        for name in ("youngs_modulus", "radius", "length", "density"):
            assert getattr(cell.properties, name) == said[name]
        np.testing.assert_array_equal(cell.properties.rest_curvature, said["rest_curvature"])
        weight = cell.properties.linear_density * said["length"] * 9.81
        assert info["wrench_left"][2] + info["wrench_right"][2] == pytest.approx(weight, rel=0.05)
        radii.append(said["radius"])
    assert len(set(radii)) == 3


def test_one_seed_gives_one_rod_and_one_episode(env):
    other = gym.make(STATE_ID, randomization=EVERYTHING)
    other.reset(seed=1)
    steps = []
    for each in (env, other):
        observation, info = each.reset(seed=7)
        later, *_ = each.step(np.full(10, 0.3))
        steps.append((observation["observation"], later["observation"], info["randomization"]))
    np.testing.assert_array_equal(steps[0][0], steps[1][0])
    np.testing.assert_array_equal(steps[0][1], steps[1][1])
    np.testing.assert_equal(steps[0][2], steps[1][2])


def test_nothing_is_said_where_nothing_is_sampled():
    plain, empty = gym.make(STATE_ID), gym.make(STATE_ID, randomization=Randomization())
    first, info = plain.reset(seed=3)
    second, said = empty.reset(seed=3)
    assert "randomization" not in info
    assert said["randomization"] == {}
    np.testing.assert_array_equal(first["observation"], second["observation"])


def test_late_arms_move_later():
    env = gym.make(STATE_ID, randomization=Randomization(arm_latency=(2, 2)))
    env.reset(seed=0)
    up = np.array([0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0])
    lifts = [env.step(up if i == 0 else np.zeros(10))[4]["displacement"][2] for i in range(4)]
    np.testing.assert_allclose(lifts, [0.0, 0.0, 0.01, 0.0])


def test_a_vector_of_randomized_environments_is_each_of_them():
    vector = gym.make_vec(STATE_ID, 2, randomization=EVERYTHING)
    singles = [gym.make(STATE_ID, randomization=EVERYTHING) for _ in range(2)]
    observations, infos = vector.reset(seed=4)
    expected = [env.reset(seed=4 + i) for i, env in enumerate(singles)]
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 2, 10))
    for action in actions:
        observations = vector.step(action)[0]
        expected = [env.step(a)[0] for env, a in zip(singles, action, strict=True)]
    for i, own in enumerate(expected):
        np.testing.assert_array_equal(observations["observation"][i], own["observation"])
    for i, env in enumerate(singles):
        assert infos["randomization"]["radius"][i] == env.unwrapped.cell.properties.radius


def test_images_show_the_past_and_the_rods_look_and_no_model_is_built_again():
    late = Randomization(camera_latency=(1, 1), radius=(0.002, 0.006), rod_color=(0.0, 1.0))
    options = {"observation_mode": "images", "image_scale": 0.2}
    env = gym.make(STATE_ID, randomization=late, **options)
    try:
        start, _ = env.reset(seed=0)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    renderer = env.unwrapped.cell._renderer
    up = np.array([0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0])
    first, second = (env.step(up)[0]["image_side"] for _ in range(2))
    np.testing.assert_array_equal(first, start["image_side"])
    assert (second != first).any()
    other, _ = env.reset(seed=1)
    assert env.unwrapped.cell._renderer is renderer
    assert (other["image_side"] != start["image_side"]).any()
    env.close()


def test_every_setting_reaches_the_rod_and_the_compiled_model():
    options = {"observation_mode": "images", "image_scale": 0.1, "renderer": "raster"}
    env = gym.make(STATE_ID, randomization=EVERYTHING, **options)
    for seed in range(2):
        _, info = env.reset(seed=seed)
        said, cell = info["randomization"], env.unwrapped.cell
        rod, radius = cell.rod._arrays, said["radius"]
        inertia = np.pi / 4 * radius**4
        np.testing.assert_allclose(rod.bending[:, 0], said["youngs_modulus"] * inertia)
        weight = said["density"] * np.pi * radius**2 * said["length"] * 9.81
        assert -rod.forces[:, 2].sum() == pytest.approx(weight)
        assert rod.rest_length.sum() == pytest.approx(said["length"])
        np.testing.assert_allclose(
            rod.rest_curvature[1:-1], np.tile(said["rest_curvature"], (49, 1))
        )
        model = cell._renderer.model
        rod_geom = model.geom("rod_0").id
        assert model.geom_size[rod_geom, 0] == pytest.approx(radius)
        color = model.mat_rgba[model.geom_matid[rod_geom], :3]
        np.testing.assert_allclose(color, said["rod_color"], rtol=1e-6)
        for view, camera in zip(cell.views(), cell.cameras, strict=True):
            away = np.linalg.norm(view.camera.centre - camera.centre)
            index = cell.cameras.index(camera)
            assert away == pytest.approx(np.linalg.norm(said["camera_translation"][index]))
        assert len(env.unwrapped._commands) == said["arm_latency"]
        assert cell._past.maxlen == 1 + said["camera_latency"]
        lying = said["clutter"]
        for k in range(3):
            block, piece = (model.geom(f"clutter_{name}_{k}_0").id for name in ("block", "cable"))
            assert model.geom_rgba[block, 3] == np.isfinite(lying["blocks"][k, 6])
            assert model.geom_rgba[piece, 3] == np.isfinite(lying["cable_radii"][k])
            if np.isfinite(lying["blocks"][k, 6]):
                np.testing.assert_allclose(model.geom_pos[block], lying["blocks"][k, :3])
    env.close()


def test_clutter_is_seen_and_changes():
    options = {"observation_mode": "images", "image_scale": 0.1, "renderer": "raster"}
    env = gym.make(STATE_ID, randomization=Randomization(clutter=(2, 2)), **options)
    plain, _ = gym.make(STATE_ID, **options).reset(seed=0)
    first, _ = env.reset(seed=0)
    second, _ = env.reset(seed=1)
    assert (first["image_top"] != plain["image_top"]).any(axis=2).mean() > 0.005
    assert (first["image_top"] != second["image_top"]).any()
    env.close()


def test_observers_are_told_of_cameras_that_stand_a_little_elsewhere():
    error = Randomization(camera_translation=(0.01, 0.01))
    options = {"observation_mode": "images", "image_scale": 0.2}
    env = gym.make(STATE_ID, randomization=error, **options)
    try:
        env.reset(seed=0)
    except RenderingUnavailable as unavailable:
        pytest.skip(str(unavailable))
    cell = env.unwrapped.cell
    for view, camera in zip(cell.views(), cell.cameras, strict=True):
        assert np.linalg.norm(view.camera.centre - camera.centre) == pytest.approx(0.01)
    env.close()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"radius": (0.004, 0.002)}, "radius: expected"),
        ({"length": (0.0, 0.5)}, "length: expected positive"),
        ({"rod_color": (0.0, 2.0)}, "rod_color"),
        ({"arm_latency": (0, 1.5)}, "arm_latency: expected whole"),
        ({"camera_rotation": (-0.1, 0.1)}, "camera_rotation: expected non-negative"),
        ({"density": 3.0}, "density: expected"),
        ({"clutter": (0, 1.5)}, "clutter: expected whole numbers"),
        ({"friction": (-0.1, 0.1)}, "friction: expected non-negative"),
    ],
)
def test_wrong_ranges_are_named(wrong, said):
    with pytest.raises(ValueError, match=said):
        Randomization(**wrong)


def test_a_wrong_option_is_named():
    with pytest.raises(ValueError, match="randomization: expected Randomization"):
        gym.make(STATE_ID, randomization={"radius": (0.002, 0.004)})


@pytest.mark.parametrize(
    ("sampled", "message"),
    [
        ({"length": (0.2, 0.5)}, "start_distance: .* the shortest rod's length"),
        ({"radius": (0.002, 0.02)}, "radius: .*randomized or not, .* 0.01 m, got 0.02 m"),
    ],
)
def test_rods_that_no_episode_could_start_with_are_refused_at_once(sampled, message):
    with pytest.raises(ValueError, match=message):
        gym.make("dlo_gym/ShapeControl-v0", randomization=Randomization(**sampled))
