import dataclasses

import pytest

from dlo_gym.surrogate.simulation import Rollouts, RolloutSettings, simulate_rollout


@pytest.fixture(scope="session")
def small_settings() -> RolloutSettings:
    return RolloutSettings(n_rollouts=6, seed=3, n_actions=2, n_steps=10, shard_size=2)


@pytest.fixture(scope="session")
def small_rollouts(small_settings) -> Rollouts:
    return simulate_all(small_settings)


@pytest.fixture(scope="session")
def varied_rollouts(small_settings) -> Rollouts:
    """As the shipped weights were trained on."""
    return simulate_all(
        dataclasses.replace(
            small_settings,
            seed=4,
            length_min=0.3,
            length_max=0.8,
            radius_min=0.002,
            radius_max=0.006,
            youngs_modulus_min=1e5,
            youngs_modulus_max=1e7,
            poisson_ratio_min=0.0,
            rest_curvature_max=4.0,
        )
    )


def simulate_all(settings: RolloutSettings) -> Rollouts:
    return Rollouts.joined(simulate_rollout(settings, i) for i in range(settings.n_rollouts))
