"""What a straight servo and the MPC reach on each task: ``python -m benchmarks.bench_envs``."""

from argparse import ArgumentParser

import numpy as np

from control.controller import ControlDiagnostics, Controller
from control.evaluate import (
    episode_metrics,
    gate_for,
    make_controller,
    make_env,
    run_episode,
)
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, RodProperties
from dlo_gym.rod.state import ShapeEstimate


class StraightServo:
    """Moves both clamps straight to the goal's ends and tangents, blind to what is in between."""

    diagnostics = ControlDiagnostics()

    def reset(self, goal: Array, boundary: BoundaryPoses, properties: RodProperties) -> None:
        pass

    def control(
        self, estimate: ShapeEstimate, boundary: BoundaryPoses, goal: Array
    ) -> BoundaryDisplacement:
        ends = ((goal[0], goal[1] - goal[0]), (goal[-1], goal[-1] - goal[-2]))
        twists = []
        for clamp, (position, tangent) in zip(boundary.clamps, ends, strict=False):
            turn = np.cross(clamp[:3, 2], tangent / np.linalg.norm(tangent))
            twists.append(np.concatenate([position - clamp[:3, 3], turn]))
        largest = max(np.abs(twist[:3]).max() for twist in twists)
        return BoundaryDisplacement(*twists).scaled(0.01 / max(largest, 0.01))


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["Easy", "", "Medium", "Hard"])
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()
    for task in arguments.tasks:
        env = make_env(f"dlo_gym/ShapeControl{task}-v0")
        config = env.unwrapped.config  # type: ignore[attr-defined]
        gate = gate_for(config)
        for name in ("servo", "mpc"):
            driver: Controller = StraightServo()
            if name == "mpc":
                driver = make_controller("mpc", gate.limits, config)
            episodes = [
                episode_metrics(list(run_episode(env, driver, gate, seed=seed)))
                for seed in range(arguments.episodes)
            ]
            errors = [episode["final_shape_error_mm"] for episode in episodes]
            print(
                f"{task or 'default':8} {name:5} success"
                f" {sum(episode['success'] for episode in episodes)}/{len(episodes)},"
                f" error at the end median {np.median(errors):.2f} worst {max(errors):.2f} mm,"
                f" ends {sorted({episode['termination'] or 'time' for episode in episodes})}",
                flush=True,
            )
        env.close()


if __name__ == "__main__":
    main()
