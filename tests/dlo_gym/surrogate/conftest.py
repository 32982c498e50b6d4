import numpy as np
import pytest

from dlo_gym.surrogate.simulation import Rollouts, RolloutSettings, simulate_rollout


@pytest.fixture(scope="session")
def small_settings() -> RolloutSettings:
    return RolloutSettings(n_rollouts=6, seed=3, n_actions=2, n_steps=10, shard_size=2)


@pytest.fixture(scope="session")
def small_rollouts(small_settings) -> Rollouts:
    made = [simulate_rollout(small_settings, i) for i in range(small_settings.n_rollouts)]
    return Rollouts(*(np.concatenate(parts) for parts in zip(*made, strict=True)))
