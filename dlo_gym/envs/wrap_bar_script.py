"""A scripted solution of the wrap-bar task: shows that there is one, and makes demonstrations."""

import numpy as np

from dlo_gym.envs.wrap_bar_env import WrapBarEnv
from dlo_gym.geometry.se3 import Array

AROUND = 0.13  # from the bar's axis [m]
INSIDE = 0.13  # y between the bar's free end and its stand [m]
PAST_THE_TIP = 0.11  # in front of the bar's free end: half a gripper and something to spare [m]
TAKE_UP = (
    0.2  # by how much the left clamp rises, so that a cable under the bar has little slack [m]
)
CLOSE = 1e-3  # to a waypoint [m]


def waypoints(env: WrapBarEnv) -> Array:
    """(k, 2, 3) places of both clamps [m]: the right one goes down and under the bar, past its free
    end, up, and back over it to a little below it, so that the cable leaves in line. For a negative
    winding it goes the other way round, and the left clamp rises first."""
    right = _round_the_bar(env.config.bar_span[0])
    left = env.cell.boundary.clamps[0, :3, 3].copy()
    if env.config.winding < 0:
        right = right[:-1] * [1.0, 1.0, -1.0]
        left[2] += TAKE_UP
    right = right + env.bar.pose[:3, 3] * [1.0, 0.0, 1.0]
    return np.stack([np.tile(left, (len(right), 1)), right], axis=1)


def _round_the_bar(tip: float) -> Array:
    """(9, 3) ways from the bar's axis [m], y in the world, for a free end at y = ``tip`` [m]."""
    r, outside = AROUND, tip - PAST_THE_TIP
    return np.array(
        [
            [0.18, INSIDE - 0.04, -0.12],
            [-0.06, INSIDE, -r],
            [-r, INSIDE, -r],
            [-r, outside, -r],
            [-r, outside, r],
            [-r, INSIDE, r],
            [0.1, INSIDE, r],
            [0.22, INSIDE, 0.03],
            [0.2, INSIDE, -0.09],
        ]
    )


class WrapScript:
    """Takes the clamps from waypoint to waypoint, then holds still.

    For one turn. It knows the true clamps and bar. A cable that starts under the bar, for a
    negative winding, slips off the free end in about half of the episodes.
    """

    def __init__(self, env: WrapBarEnv) -> None:
        self._env = env
        self._ahead = list(waypoints(env))

    def action(self) -> Array:
        """(10,) the next action."""
        clamps = self._env.cell.boundary.clamps[:, :3, 3]
        while self._ahead and np.abs(self._ahead[0] - clamps).max() < CLOSE:
            self._ahead.pop(0)
        action = np.zeros((2, 5))
        if self._ahead:
            way = self._ahead[0] - clamps
            action[:, :3] = way / max(self._env.config.max_translation_step, np.abs(way).max())
        return action.ravel()
