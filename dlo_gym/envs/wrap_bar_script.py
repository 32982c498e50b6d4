"""A scripted solution of the wrap-bar task: shows that there is one, and makes demonstrations."""

import numpy as np

from dlo_gym.envs.wrap_bar_env import WrapBarEnv
from dlo_gym.geometry.se3 import Array

AROUND = 0.13  # from the bar's axis [m]
PAST_THE_TIP = 0.11  # in front of the bar's free end: half a gripper and something to spare [m]
CLOSE = 1e-3  # to a waypoint [m]


def waypoints(env: WrapBarEnv) -> Array:
    """(9, 3) places of the right clamp [m]: down and under the bar, past its free end, up, and back
    over it; a little below it at last, so that the cable leaves in line."""
    x, _, z = env.bar.pose[:3, 3]
    inside, outside = 0.13, env.config.bar_span[0] - PAST_THE_TIP
    r = AROUND
    return np.array(
        [
            [x + 0.18, inside - 0.04, z - 0.12],
            [x - 0.06, inside, z - r],
            [x - r, inside, z - r],
            [x - r, outside, z - r],
            [x - r, outside, z + r],
            [x - r, inside, z + r],
            [x + 0.1, inside, z + r],
            [x + 0.22, inside, z + 0.03],
            [x + 0.2, inside, z - 0.09],
        ]
    )


class WrapScript:
    """Takes the right clamp from waypoint to waypoint, then holds still.

    For positive windings of one turn. It knows the true clamps and bar.
    """

    def __init__(self, env: WrapBarEnv) -> None:
        self._env = env
        self._left = list(waypoints(env))

    def action(self) -> Array:
        """(10,) the next action."""
        right = self._env.cell.boundary.clamps[1, :3, 3]
        while self._left and np.abs(self._left[0] - right).max() < CLOSE:
            self._left.pop(0)
        action = np.zeros(10)
        if self._left:
            way = self._left[0] - right
            action[5:8] = way / max(self._env.config.max_translation_step, np.abs(way).max())
        return action
