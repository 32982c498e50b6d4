"""Steps per second with resets in the count, and what a reset costs, per task:
``python -m benchmarks.bench_env_speed``."""

import time
from argparse import ArgumentParser

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

import dlo_gym

BATCH = 16


def reset_ms(env: gym.Env, episodes: int) -> tuple[float, float]:
    """Median and 90th percentile of a reset's processor time [ms]."""
    env.reset(seed=0)
    times = []
    for seed in range(1, episodes + 1):
        began = time.process_time()
        env.reset(seed=seed)
        times.append(1e3 * (time.process_time() - began))
    return float(np.median(times)), float(np.percentile(times, 90))


def single_rate(env: gym.Env, steps: int) -> float:
    """Steps per second of processor time under random actions, resets included."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, *(env.action_space.shape or ())))
    began = time.process_time()
    for action in actions:
        *_, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return steps / (time.process_time() - began)


def batch_rates(task: str, steps: int, threads: int | None) -> tuple[float, float]:
    """Steps per second of a batch by processor time and by the clock, resets included."""
    envs = gym.make_vec(
        f"dlo_gym/ShapeControl{task}-v0", BATCH, autoreset_mode="SameStep", threads=threads
    )
    envs.reset(seed=0)
    shape = (steps, *(envs.action_space.shape or ()))
    actions = np.random.default_rng(0).uniform(-1, 1, shape)
    began = time.process_time(), time.perf_counter()
    for action in actions:
        envs.step(action)
    cpu, wall = time.process_time() - began[0], time.perf_counter() - began[1]
    envs.close()
    return steps * BATCH / cpu, steps * BATCH / wall


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(dlo_gym.SHAPE_TASKS))
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--steps", type=int, default=300, help="of a batch")
    parser.add_argument("--threads", type=int, help="of a batch; one per core by default")
    arguments = parser.parse_args()
    table = Table(
        "task", "reset ms", "90 % within", "one env", f"batch of {BATCH}", "by the clock",
        title="steps per second of processor time, resets included",
    )  # fmt: skip
    for task in arguments.tasks:
        env = gym.make(f"dlo_gym/ShapeControl{task}-v0")
        median, most = reset_ms(env, arguments.episodes)
        rate = single_rate(env, 4 * arguments.steps)
        cpu, wall = batch_rates(task, arguments.steps, arguments.threads)
        table.add_row(
            task or "default", f"{median:.1f}", f"{most:.1f}", f"{rate:.0f}", f"{cpu:.0f}",
            f"{wall:.0f}",
        )  # fmt: skip
        env.close()
    Console().print(table)


if __name__ == "__main__":
    main()
