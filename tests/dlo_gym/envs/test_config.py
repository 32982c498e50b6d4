import numpy as np
import pytest

from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.rod import RodProperties


def test_defaults_are_valid():
    config = ShapeEnvConfig()
    assert config.n_nodes == 51
    assert not config.uses_images


def test_images_are_needed_by_image_mode_and_by_every_other_observer():
    assert ShapeEnvConfig(observation_mode="images").uses_images
    assert ShapeEnvConfig(observer="tracking.observer:TrackerObserver").uses_images


def test_an_unknown_option_is_named_and_the_valid_ones_are_listed():
    with pytest.raises(ValueError, match="goal_distnace.*valid options are.*goal_distance"):
        ShapeEnvConfig.from_options({"goal_distnace": (0.06, 0.1)})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("observer", "no_colon"),
        ("observation_mode", "pixels"),
        ("properties", 0.5),
        ("n_elements", 2),
        ("n_elements", 10.5),
        ("control_step", 0.0),
        ("max_translation_step", -0.01),
        ("max_rotation_step", float("nan")),
        ("max_rotation_step", "much"),
        ("reward", "shaped"),
        ("success_threshold", 0.0),
        ("start_noise", (0.1,)),
        ("start_distance", 0.49),
        ("start_distance", 0.04),
        ("goal_moves", 0),
        ("goal_distance", (0.2, 0.1)),
        ("goal_distance", (-0.2, 0.1)),
        ("max_stretch", 1.0),
        ("workspace", ((0.4, 0.0, 0.2), (-0.4, 0.1, 0.5))),
        ("workspace", (0.4, 0.5)),
        ("clutter", "office"),
        ("n_occluders", -1),
        ("renderer", "vulkan"),
        ("quality", "best"),
        ("cameras", ("side",)),
    ],
)
def test_a_bad_value_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        ShapeEnvConfig.from_options({name: value})


def test_start_distance_is_judged_by_the_rods_own_length():
    with pytest.raises(ValueError, match="start_distance"):
        ShapeEnvConfig(properties=RodProperties(length=0.38))
    assert np.isclose(ShapeEnvConfig(properties=RodProperties(length=0.6)).start_distance, 0.4)


def test_the_rasteriser_has_one_quality():
    with pytest.raises(ValueError, match='quality: expected "fast" with renderer "raster"'):
        ShapeEnvConfig(renderer="raster", quality="high")
