"""Steps per CPU second with contact: ``python -m benchmarks.bench_contact_envs``."""

from argparse import ArgumentParser
from time import process_time

import gymnasium as gym
import numpy as np

import dlo_gym  # noqa: F401
from dlo_gym.envs.wrap_bar_script import WrapScript

OBSTACLE = "dlo_gym/ShapeControlObstacle-v0"
TASKS = {
    "ShapeControl (none)": ("dlo_gym/ShapeControl-v0", {}),
    "Obstacle, forbidden": (OBSTACLE, {}),
    "Obstacle, allowed": (OBSTACLE, {"touch": "allowed"}),
    "the same, friction": (OBSTACLE, {"touch": "allowed", "friction": 0.3}),
}


def random_steps(env: gym.Env, n: int) -> tuple[list[float], list[float]]:
    """Times [s] of n steps by random actions, and of the resets between them."""
    rng = np.random.default_rng(0)
    steps, resets, over = [], [], True
    while len(steps) < n:
        if over:
            began = process_time()
            env.reset(seed=len(resets))
            resets.append(process_time() - began)
        action = rng.uniform(-1.0, 1.0, env.action_space.shape or ())
        began = process_time()
        *_, terminated, truncated, _ = env.step(action)
        steps.append(process_time() - began)
        over = terminated or truncated
    return steps, resets


def wrapping_steps(n_episodes: int) -> tuple[list[float], list[float], int]:
    """Times [s] of the scripted wrap's steps and resets, and how many episodes succeed."""
    env = gym.make("dlo_gym/WrapBar-v0")
    steps, resets, successes = [], [], 0
    for seed in range(n_episodes):
        began = process_time()
        _, info = env.reset(seed=seed)
        resets.append(process_time() - began)
        script, over = WrapScript(env.unwrapped), False  # type: ignore[arg-type]
        while not (over or info["success"]):
            began = process_time()
            *_, terminated, truncated, info = env.step(script.action())
            steps.append(process_time() - began)
            over = terminated or truncated
        successes += info["success"]
    return steps, resets, successes


def report(name: str, steps: list[float], resets: list[float], more: str = "") -> None:
    median, slow = np.median(steps), np.percentile(steps, 95)
    print(
        f"{name:20} {1 / median:6.0f} steps/s (median {1e3 * median:.2f} ms, 95 % within"
        f" {1e3 * slow:.1f} ms), reset median {1e3 * np.median(resets):.0f} ms{more}",
        flush=True,
    )


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--wraps", type=int, default=10, help="scripted episodes round the bar")
    arguments = parser.parse_args()
    for name, (env_id, options) in TASKS.items():
        env = gym.make(env_id, **options)
        random_steps(env, 30)  # compiles
        report(name, *random_steps(env, arguments.steps))
    steps, resets, successes = wrapping_steps(arguments.wraps)
    report("WrapBar, script", steps, resets, f", success {successes}/{arguments.wraps}")


if __name__ == "__main__":
    main()
