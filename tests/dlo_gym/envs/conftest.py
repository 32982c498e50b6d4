import warnings
from importlib.util import find_spec

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env


@pytest.fixture
def gym_check(tmp_path):
    """Gymnasium's checker on an environment ``(id, **options)``, its warnings as failures.

    It makes every render mode: the viewer's goes to a file, and is left out without rerun.
    """

    def check(name, **options):
        env = gym.make(name, render_file=tmp_path / "checked.rrd", **options)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env.unwrapped, skip_render_check=find_spec("rerun") is None)

    return check
