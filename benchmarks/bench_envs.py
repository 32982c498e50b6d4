"""What the servos and the MPC reach on each task: ``python -m benchmarks.bench_envs``."""

from argparse import ArgumentParser

import gymnasium as gym
import numpy as np

from control.controller import Controller
from control.evaluate import (
    episode_metrics,
    gate_for,
    make_controller,
    make_env,
    run_episode,
)
from control.safety import SafetyGate
from dlo_gym.envs.shape_env import ShapeControlEnv


def bare_episode(env: gym.Env, driver: Controller, seed: int) -> tuple[float, str]:
    """Error [mm] at the end and why it ended, where no gate stands between driver and arms."""
    inner: ShapeControlEnv = env.unwrapped  # type: ignore[assignment]
    _, info = inner.reset(seed=seed)
    for _ in range(100):
        command = driver.control(inner.estimate, inner.cell.boundary, inner.goal)
        *_, terminated, _, info = inner.step(inner.displacement_to_action(command))
        if terminated:
            break
    return 1e3 * info["shape_error"], info["termination"]


def final_metrics(
    env: gym.Env, driver: Controller, gate: SafetyGate, seed: int
) -> tuple[float, str]:
    """As ``bare_episode``, every command through the gate."""
    metrics = episode_metrics(list(run_episode(env, driver, gate, seed=seed)))
    return metrics["final_shape_error_mm"], metrics["termination"]


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument(
        "--tasks",
        nargs="+",
        default=["Easy", "", "Medium", "Hard", "Planar", "OneArm", "Obstacle"],
    )
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()
    for task in arguments.tasks:
        env = make_env(f"dlo_gym/ShapeControl{task}-v0")
        config = env.unwrapped.config  # type: ignore[attr-defined]
        gate = gate_for(config)
        over = ("over",) if config.obstacles else ()
        for name in ("bare servo", "servo", "mpc", *over):
            driver = make_controller(name.removeprefix("bare "), gate.limits, config)
            episodes = [
                bare_episode(env, driver, seed)
                if name == "bare servo"
                else final_metrics(env, driver, gate, seed)
                for seed in range(arguments.episodes)
            ]
            errors = [error for error, _ in episodes]
            print(
                f"{task or 'default':8} {name:10} success"
                f" {sum(error <= 5.0 and not end for error, end in episodes)}/{len(episodes)},"
                f" error at the end median {np.median(errors):.2f} worst {max(errors):.2f} mm,"
                f" ends {sorted({end or 'time' for _, end in episodes})}",
                flush=True,
            )
        env.close()


if __name__ == "__main__":
    main()
