"""The wrap-bar environment."""

from collections.abc import Sequence
from math import pi, tau
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from dlo_gym.envs import tasks
from dlo_gym.envs.cell import sample_occluder_paths
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.envs.shape_env import ShapeControlEnv, shape_observation
from dlo_gym.envs.wrap_bar_config import CROSSING, WrapBarConfig
from dlo_gym.exceptions import RodDiverged, UnreachablePose
from dlo_gym.geometry.curves import swept_angle
from dlo_gym.geometry.se3 import Array, pose
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.rod.obstacles import Box, Capsule

TOUCH_COST = 0.1  # per step in which the cable does not touch the bar, in turns
ABOVE = 0.5  # the bar, in lengths of the cable: where it starts before it is laid on the bar
LAID = 0.05  # height of the clamps above the bar's axis at the start [m]


class WrapBarEnv(ShapeControlEnv):
    """Two arms wind a cable once round a horizontal bar, as in the tracking paper's Real Exp 4.

    ## Description
    The bar reaches from a stand towards the cameras and ends free. The cable is an elastic rod in
    quasi-static equilibrium with weight, friction on the bar, and contact with itself. It lies
    across the bar, an end in either gripper. Grippers cannot pass through the bar, but one can take
    its end down, under the bar, past the bar's free end, up, and back over the bar.
    `dlo_gym/WrapBarTracked-v0` observes the cable through the multi-view tracker,
    `dlo_gym/WrapBarImages-v0` adds the views to the observation.

    ## Action Space
    As `ShapeControlEnv`: a `Box(-1, 1, (10,), float32)`, or `(12,)` with `axial_rotation=True`; a
    step translates a clamp by up to `max_translation_step` 0.02 m along each axis.

    ## Observation Space
    A flat `Dict` of float32 arrays, with n = 51 nodes:

    | Key              | Shape       | Meaning                                                   |
    | ---------------- | ----------- | --------------------------------------------------------- |
    | `observation`    | (3 n + 18,) | estimated centerline and clamps, as `ShapeControlEnv`     |
    | `achieved_goal`  | (2,)        | estimated winding angle [rad]; 1 if the estimate touches  |
    |                  |             | the bar to within `touch_tolerance`, else 0               |
    | `desired_goal`   | (2,)        | `winding` [rad]; 1                                        |
    | `obstacles`      | (30,)       | bar and stand, rows as in `ShapeControlEnv`               |
    | `image_<camera>` | (h, w, 3)   | uint8 RGB; only with `observation_mode="images"`          |

    The winding angle is what the centerline sweeps about the bar's axis from clamp to clamp, less
    the half turn of a cable that lies straight across. It is positive right-handed about the axis
    from the free end to the stand.

    ## Rewards
    With `reward="dense"` minus the turns that are missing, and minus 0.1 while the cable does not
    touch the bar; with `reward="sparse"` 0 if nothing is missing and it touches, else -1. The step
    that ends an episode early costs `termination_penalty` on top.

    ## Info
    As `ShapeControlEnv` without `shape_error`, and:

    | Key                     | Meaning                                                         |
    | ----------------------- | --------------------------------------------------------------- |
    | `success`, `is_success` | whether the true cable has been wound and touching the bar for  |
    |                         | `hold_steps` steps up to now                                    |
    | `winding`               | the true cable's winding angle [rad]                            |
    | `held_steps`            | for how many steps it has been wound and touching               |
    | `touching`              | (2,) whether the cable touches bar and stand                    |

    ## Starting State
    The bar stands somewhere within `bar_noise`; the cable has been lowered onto it, at positions
    and tilts of the clamps within `start_noise`. For a negative `winding` it hangs under the bar.

    ## Episode End
    Truncation after 300 steps. Termination as in `ShapeControlEnv`: arms and grippers may touch
    neither bar nor stand, the cable not the stand. Success does not end an episode.

    ## Arguments
    Every field of `WrapBarConfig`, e.g. `gym.make("dlo_gym/WrapBar-v0", winding=-6.28)`.

    ## Version History
    * v0: first version.
    """

    CONFIG: ClassVar[type[ShapeEnvConfig]] = WrapBarConfig
    RESET_OPTIONS: ClassVar[tuple[str, ...]] = ()
    config: WrapBarConfig

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(render_mode, **options)
        self._held_steps = 0

    @property
    def bar(self) -> Capsule:
        """The bar, as it stands in this episode."""
        if not self.cell.obstacles:
            raise gym.error.ResetNeeded("no bar yet; call reset() first")
        bar = self.cell.obstacles[0]
        assert isinstance(bar, Capsule)
        return bar

    def winding(self, centerline: Array) -> float:
        """Angle [rad] by which a centerline (n, 3) [m] is wound round the bar."""
        swept = swept_angle(centerline, self.bar.pose[:3, 3], self.bar.pose[:3, 2])
        return swept - np.sign(self.config.winding) * pi

    def observe(self, displacement: BoundaryDisplacement) -> bool:
        wound = self._wound()
        self._held_steps = self._held_steps + 1 if wound else 0
        return super().observe(displacement)

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: dict[str, Any] | Sequence[dict[str, Any]],
    ) -> Any:
        """Reward of (2,) or (batch, 2) winding angles [rad] and touches: a number, or (batch,)."""
        missing = np.asarray(desired_goal, np.float64) - np.asarray(achieved_goal, np.float64)
        turns = np.maximum(np.sign(self.config.winding) * missing[..., 0] / tau, 0.0)
        apart = np.maximum(missing[..., 1], 0.0)
        if self.config.reward == "dense":
            cost = turns + TOUCH_COST * apart
        else:
            cost = ((turns > 0) | (apart > 0)).astype(float)
        return -cost - self.config.termination_penalty * tasks.failures(info)

    def _begin(self, options: dict[str, Any]) -> None:
        config, rng = self.config, self.np_random
        occluders = sample_occluder_paths(rng, self.cell.cameras, config.n_occluders)
        for _ in range(tasks.ATTEMPTS):
            x, dz = rng.uniform(-1.0, 1.0, 2) * config.bar_noise
            bar = (float(x), config.bar_height + float(dz))
            start = tasks.level_clamps((bar[0], CROSSING, bar[1] + LAID), rng, config)
            above = ABOVE * self.cell.properties.length if config.winding > 0 else 0.0
            lift = BoundaryDisplacement(*np.tile([0.0, 0.0, above, 0.0, 0.0, 0.0], (2, 1)))
            try:
                self.cell.reset(start.displaced(lift), occluders)
                self.cell.place_obstacles(_bar_and_stand(bar, config))
            except (UnreachablePose, RodDiverged, ValueError):
                continue
            n_steps = 1 + round(above / config.max_translation_step)
            step = lift.scaled(-1.0 / n_steps)
            if any(tasks.advance(self.cell, step, config) for _ in range(n_steps)):
                continue
            lies = config.winding < 0 or self.touching()[0]
            if lies and abs(self.winding(self.cell.rod_state.positions)) < pi / 2:
                break
        else:
            raise ValueError(
                f"no start found in {tasks.ATTEMPTS} attempts for bar_height={config.bar_height},"
                f" bar_span={config.bar_span}, start_distance={config.start_distance},"
                f" start_noise={config.start_noise}"
            )
        self.cell.start_clock()
        self._held_steps = 0

    def _wound(self) -> bool:
        sign = np.sign(self.config.winding)
        winding = self.winding(self.cell.rod_state.positions)
        return bool(sign * winding >= abs(self.config.winding) and self.touching()[0])

    def _make_observation_space(self) -> spaces.Dict:
        entries = dict(super()._make_observation_space().spaces)
        # No more turns than the cable has lengths of the bar's girth.
        most = abs(self.config.winding) + self.config.rod_length[1] / self.config.bar_radius
        limit = np.array([tau + most, 1.0], dtype=np.float32)
        goal = spaces.Box(-limit, limit, dtype=np.float32)
        return spaces.Dict(entries | {"achieved_goal": goal, "desired_goal": goal})

    def _observation(self) -> dict[str, NDArray]:
        centerline = self.estimate.centerline
        shape = shape_observation(centerline, self.cell.boundary, centerline)
        between = 0.5 * (centerline[1:] + centerline[:-1])
        gaps = self.bar.signed_distance(np.concatenate([centerline, between]))
        radius = self.cell.rod_radius
        touching = gaps.min() < radius + self.config.touch_tolerance
        achieved = np.array([self.winding(centerline), touching], dtype=np.float32)
        return self._and_the_rest(
            {
                "observation": shape["observation"],
                "achieved_goal": achieved,
                "desired_goal": np.array([self.config.winding, 1.0], dtype=np.float32),
            }
        )

    def _info(self, displacement: BoundaryDisplacement, termination: str) -> dict[str, Any]:
        success = self._held_steps >= self.config.hold_steps
        info = {
            "success": success,
            "is_success": success,
            "winding": self.winding(self.cell.rod_state.positions),
            "held_steps": self._held_steps,
        }
        return info | self._info_of_cell(displacement, termination)

    def _progress(self, info: dict[str, Any]) -> dict[str, float]:
        return {"turns": info["winding"] / tau}


def _bar_and_stand(bar: tuple[float, float], config: WrapBarConfig) -> tuple[Capsule, Box]:
    x, z = bar
    tip, foot = config.bar_span
    top = z + 2.0 * config.bar_radius
    axis = Capsule.between([x, tip, z], [x, foot, z], config.bar_radius)
    half_size = (1.5 * config.bar_radius, config.bar_radius, 0.5 * top)
    return axis, Box(pose(np.eye(3), [x, foot, 0.5 * top]), half_size)
