"""What a policy is trained on: a shape-control environment, reduced to what the policy reads."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from control.policy import N_CLAMPS, N_POINTS, sample_points
from dlo_gym.envs import tasks
from dlo_gym.geometry.se3 import Array

REWARD_UNIT = 0.02  # mean point error that costs 1 per step [m]
FAILURE_COST = 20.0


class PolicyObservation(gym.Wrapper):
    """What a policy reads of a shape-control environment: some points and the clamps.

    The reward is the dense one over these points, in finer units.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        points = spaces.Box(-2.0, 2.0, (3 * N_POINTS,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-2.0, 2.0, (N_CLAMPS,), np.float32),
                "achieved_goal": points,
                "desired_goal": points,
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray], dict[str, Any]]:
        observation, _ = self.env.reset(seed=seed, options=options)
        return self._select(observation), {}

    def step(self, action: Any) -> tuple[dict[str, NDArray], float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        selected = self._select(observation)
        # The replay buffer copies the info with every transition; it needs no more than this.
        info = {"termination": info["termination"], "is_success": info["is_success"]}
        reward = self.compute_reward(selected["achieved_goal"], selected["desired_goal"], info)
        return selected, float(reward), terminated, truncated, info

    def compute_reward(
        self, achieved_goal: NDArray, desired_goal: NDArray, info: dict | Sequence[dict]
    ) -> Array:
        error = tasks.shape_error(achieved_goal, desired_goal)
        return -error / REWARD_UNIT - FAILURE_COST * tasks.failures(info)

    def _select(self, observation: dict[str, NDArray]) -> dict[str, NDArray]:
        return {
            "observation": observation["observation"][-N_CLAMPS:],
            "achieved_goal": sample_points(observation["achieved_goal"].reshape(-1, 3)).astype(
                np.float32
            ),
            "desired_goal": sample_points(observation["desired_goal"].reshape(-1, 3)).astype(
                np.float32
            ),
        }
