"""The rod's neural surrogate: rollouts, training, prediction."""
