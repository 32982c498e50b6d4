"""One control step of the MPC beside the same problem given to IPOPT, and the environments."""

import time

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

import dlo_gym  # noqa: F401  (registers the environments)
from control.evaluate import gate_for, make_controller, make_env, run_episode


def control_steps(model: str) -> tuple[np.ndarray, float]:
    """Milliseconds of each control step of three episodes, and the mean final error [mm]."""
    env = make_env("dlo_gym/ShapeControl-v0", max_episode_steps=40)
    config = env.unwrapped.config
    gate = gate_for(config)
    controller = make_controller("mpc", gate.limits, config, model=model)
    times, errors = [], []
    for seed in range(3):
        steps = list(run_episode(env, controller, gate, seed=seed))
        times += [step.control_ms for step in steps if step.control_ms is not None]
        errors.append(1e3 * steps[-1].shape_error)
    env.close()
    return np.array(times), float(np.mean(errors))


def environment_steps(name: str, count: int, **options) -> float:
    """Steps per second of an environment under random actions."""
    env = gym.make(name, **options)
    env.reset(seed=0)
    env.action_space.seed(0)
    env.step(env.action_space.sample())
    began = time.perf_counter()
    for _ in range(count):
        _, _, terminated, truncated, _ = env.step(0.3 * env.action_space.sample())
        if terminated or truncated:
            env.reset()
    seconds = time.perf_counter() - began
    env.close()
    return count / seconds


def main() -> None:
    table = Table("MPC, 5 steps ahead", "median ms", "p99 ms", "final error mm")
    for model in ("surrogate", "rod"):
        times, error = control_steps(model)
        table.add_row(
            f"on the {model}",
            f"{np.median(times):.1f}",
            f"{np.percentile(times, 99):.1f}",
            f"{error:.2f}",
        )
    Console().print(table)
    table = Table("environment", "steps per second")
    table.add_row("state", f"{environment_steps('dlo_gym/ShapeControl-v0', 500):.0f}")
    for height in (360, 720):
        for renderer in ("opengl", "raster"):
            rate = environment_steps(
                "dlo_gym/ShapeControlTracked-v0",
                40,
                image_scale=height / 1080,
                n_occluders=1,
                renderer=renderer,
            )
            table.add_row(f"tracked, {height * 16 // 9}x{height}, {renderer}", f"{rate:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
