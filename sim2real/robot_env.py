"""The shape-control environment over the arms and cameras of a cell."""

import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.safety import SafetyGate
from dlo_gym.envs import tasks
from dlo_gym.envs.shape_env import ShapeControlEnv, check_goal, shape_observation
from dlo_gym.exceptions import DeviceError, SafetyStop, TrackLost, UnreachablePose
from dlo_gym.geometry.se3 import Array
from dlo_gym.overlay import draw_overlay
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.state import ShapeEstimate
from sim2real.cell import CellSample, RobotCell
from sim2real.config import CellConfig
from sim2real.goals import SAMPLED, env_config, make_goal
from sim2real.loop import TrackedCable, slowed
from sim2real.steps import BLEND

RESET_OPTIONS = ("start", "goal")
APPROACH_SPEED = 0.3  # of the speed limits, on the way to a start pose
ARRIVED = (5e-4, 5e-3)  # at the start pose [m], [rad]
PATIENCE, PROGRESS = 8, 0.1  # periods that may bring the start no nearer, than so many steps
SETTLING = 3  # control periods that the arms are given to come to rest
# What ends an episode, and what it is called.
TERMINATIONS = {
    "safety_stop": (SafetyStop, UnreachablePose),
    "device_error": (DeviceError,),
    "track_lost": (TrackLost,),
}


class RobotShapeEnv(gym.Env):
    """Two real (or emulated) arms hold the ends of a cable and bring it into a goal shape.

    ## Description
    The task of `dlo_gym/ShapeControlTracked-v0` on a cell: same actions, same observations, so a
    policy moves from one to the other unchanged. Steps keep the cell's control period: `step`
    returns when it is over. The cable is seen through the cell's cameras alone, and its shape is
    carried on to the commanded clamps, which makes up for the time that images and arms take.
    Every command passes the safety gate, and the safety monitor watches the arms while they move.
    A caller that takes long between two steps finds the arms standing where they were sent.

    ## Action Space
    That of `ShapeControlEnv`, from the commanded clamps: a `Box(-1, 1, (10,), float32)`.

    ## Observation Space
    That of `ShapeControlEnv` without images: `observation`, `achieved_goal`, `desired_goal`.

    ## Rewards
    Those of `ShapeControlEnv`, from the estimate; a cell knows no truth.

    ## Info
    | Key                     | Meaning                                                         |
    | ----------------------- | --------------------------------------------------------------- |
    | `success`, `is_success` | whether `shape_error <= control.success_threshold_m`            |
    | `shape_error`           | mean node distance of the estimate to the goal [m]              |
    | `displacement`          | (12,) from the former to the new command, as the arms accepted  |
    |                         | it [m, rad], world axes                                         |
    | `safety_cuts`           | names of the limits that the gate cut the command to            |
    | `late`                  | how long after its period the command went out; 0 in time [s]   |
    | `termination`           | why the episode ended early, or `""`                            |
    | `message`               | what was reported then, or `""`                                 |

    ## Starting State
    The arms stay where they are, or go slowly, in a straight line and through the safety gate, to
    `reset(options={"start": BoundaryPoses})`. The goal is `options["goal"]`, the file that `goal`
    names, or sampled among the shapes that the arms can reach from there.

    ## Episode End
    Truncation after 100 steps (`gym.make(..., max_episode_steps=...)`). Termination, with both
    arms told to stop and the reason in `info["termination"]`:

    | Reason         | Meaning                                                            |
    | -------------- | ------------------------------------------------------------------ |
    | `safety_stop`  | a limit was broken, or a controller reports a stop                 |
    | `device_error` | an arm or camera is gone or silent                                 |
    | `track_lost`   | the cable has not been seen for too long                           |

    The next `reset` makes the arms ready again where they then are, and raises where a person has
    to release them first. Success does not end an episode.

    ## Arguments
    * `cell`: the cell file, or a `CellConfig`.
    * `goal`: `"sampled"`, or a .npy file with a centerline (n_nodes, 3) in world [m].
    * `speed`: share of the cell's step and speed limits, from 0 to 1.
    * `reward`: `"dense"` or `"sparse"`.
    * `robot_cell`: devices in place of those that `cell` describes; `close` closes them.

    ## Version History
    * v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        cell: str | Path | CellConfig,
        goal: str = SAMPLED,
        speed: float = 1.0,
        reward: Literal["dense", "sparse"] = "dense",
        render_mode: str | None = None,
        *,
        robot_cell: RobotCell | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode: expected None or one of {self.metadata['render_modes']},"
                f" got {render_mode!r}"
            )
        self.cell_config = cell if isinstance(cell, CellConfig) else CellConfig.load(cell)
        self.config = replace(env_config(self.cell_config), reward=reward)
        self.limits = slowed(self.cell_config.safety_limits, speed)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.config.control_step)}
        # Its spaces are those of the simulated environment because they come from there.
        twin = ShapeControlEnv(
            **{f.name: getattr(self.config, f.name) for f in fields(self.config)}
        )
        self.clamp_action = twin.clamp_action
        self.action_space = twin.action_space
        self.observation_space = twin.observation_space
        self.cell = robot_cell or RobotCell(self.cell_config)
        self.cell_is_open = self.needs_recovery = False
        self._goal_spec = goal
        self._gate = SafetyGate(self.limits, self.cell_config.dual_arm)
        self._goal: Array | None = None
        self._estimate: ShapeEstimate | None = None
        self._sample: CellSample | None = None
        self._commanded: BoundaryPoses | None = None
        self._tick = 0.0

    @property
    def estimate(self) -> ShapeEstimate:
        """The cable's shape with the clamps where the last command sends them."""
        if self._estimate is None:
            raise gym.error.ResetNeeded("no estimate yet; call reset() first")
        return self._estimate

    @property
    def goal(self) -> Array:
        """(n_nodes, 3) goal centerline, world [m]."""
        if self._goal is None:
            raise gym.error.ResetNeeded("no goal yet; call reset() first")
        return self._goal

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Makes arms and cameras ready and starts an episode; see the class.

        Raises:
            ValueError: on a wrong option, or a start pose that the safety gate keeps the arms from.
            DeviceError, SafetyStop: if the cell cannot be made ready; the arms stand then.
        """
        super().reset(seed=seed)
        start, goal = self._checked(options or {})
        self._estimate = None
        try:
            self._make_ready()
            self.cell.refresh()
            if start is not None:
                self._approach(start)
            # Drawn even if not used, so that what follows does not depend on the options.
            goal_seed = int(self.np_random.integers(2**31))
            if goal is None:
                goal = make_goal(self._goal_spec, self.cell_config, self.cell.commanded, goal_seed)
            self._goal = goal
            self._warm_up()
        except BaseException:
            self._halt()
            raise
        self._tick = time.monotonic()
        return self._observation(), self._info(BoundaryDisplacement.zero())

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray], float, bool, bool, dict[str, Any]]:
        if self._estimate is None or self.needs_recovery:
            raise gym.error.ResetNeeded("call reset() before step()")
        assert self._commanded is not None
        boundary = self._commanded
        displacement = self.clamp_action.to_displacement(action, boundary)
        sent, cuts, late = BoundaryDisplacement.zero(), (), 0.0
        termination = message = ""
        try:
            late = self._lateness()
            decision = self._gate.check(displacement, boundary, self.cell.joint_angles)
            cuts = decision.reasons
            accepted = self.cell.send(decision.target, BLEND * self.config.control_step)
            sent = boundary.displacement_to(accepted)
            self._wait_for_tick()
            self._look()
        except BaseException as error:
            self._halt()
            termination, message = _termination(error), str(error)
            if not termination:
                raise
        observation = self._observation()
        info = self._info(sent, cuts, late, termination, message)
        reward = self.compute_reward(
            observation["achieved_goal"], observation["desired_goal"], info
        )
        return observation, float(reward), bool(termination), False, info

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: dict[str, Any] | Sequence[dict[str, Any]],
    ) -> Any:
        """Reward of flat centerlines (3 n,) or (batch, 3 n) [m]: a number, or (batch,)."""
        return tasks.compute_reward(
            achieved_goal,
            desired_goal,
            tasks.failures(info),
            kind=self.config.reward,
            success_threshold=self.config.success_threshold,
            termination_penalty=self.config.termination_penalty,
        )

    def render(self) -> NDArray[np.uint8] | None:
        """All views side by side, with goal and estimate drawn in, or None without render mode."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode; pass render_mode='rgb_array' to make"
            )
            return None
        estimate, sample = self.estimate, self._sample
        assert sample is not None
        images = [
            draw_overlay(
                view,
                estimate.centerline,
                visible=estimate.visible[index],
                goal=self.goal,
                caption=view.camera.name,
            )
            for index, view in enumerate(sample.views)
        ]
        height = min(len(image) for image in images)
        return np.hstack([image[:height] for image in images])

    def close(self) -> None:
        """Stops the arms and gives the cell back; a later ``reset`` opens it again."""
        self.cell.close()
        self.cell_is_open = False

    def _checked(self, options: dict[str, Any]) -> tuple[BoundaryPoses | None, Array | None]:
        unknown = [name for name in options if name not in RESET_OPTIONS]
        if unknown:
            raise ValueError(
                f"unknown reset option {', '.join(map(repr, unknown))};"
                f" valid options are: {', '.join(RESET_OPTIONS)}"
            )
        start, goal = options.get("start"), options.get("goal")
        if start is not None and (not isinstance(start, BoundaryPoses) or start.right is None):
            raise ValueError(f"start: expected BoundaryPoses of two clamps, got {start!r}")
        if goal is not None:
            goal = check_goal(goal, self.config)
        return start, goal

    def _make_ready(self) -> None:
        """Opens the cell, or recovers it after a stop; nothing moves."""
        if not self.cell_is_open:
            self.cell.open()
            self.cell.engage()
            self.cell_is_open = True
        elif self.needs_recovery:
            self.cell.recover()
        self.needs_recovery = False
        self._gate.reset()

    def _approach(self, start: BoundaryPoses) -> None:
        """Moves the clamps slowly to ``start``, in control periods.

        Raises:
            ValueError: if the safety gate does not let them get there.
        """
        limits = slowed(self.limits, APPROACH_SPEED)
        gate = SafetyGate(limits, self.cell_config.dual_arm)
        self._tick = time.monotonic()
        longest = (limits.max_translation_step, limits.max_rotation_step)
        away, patience = self.cell.commanded.displacement_to(start), PATIENCE
        while _size(away, ARRIVED) > 1.0:
            # One share for both arms: the distance between them goes over evenly.
            n_steps = _size(away, longest)
            decision = gate.check(
                away.scaled(1.0 / max(n_steps, 1.0)), self.cell.commanded, self.cell.joint_angles
            )
            self.cell.send(decision.target, BLEND * self.config.control_step)
            self._wait_for_tick()
            self.cell.sample()
            away = self.cell.commanded.displacement_to(start)
            patience -= n_steps - _size(away, longest) < PROGRESS
            if patience == 0:
                cuts = "; ".join(map(str, decision.cuts))
                raise ValueError(f"start: the arms cannot get there from where they are; {cuts}")
        for _ in range(SETTLING):
            self._wait_for_tick()
            self.cell.sample()

    def _warm_up(self) -> None:
        """Looks at the cable until the first step will take no longer than all others."""
        self._cable = TrackedCable(self.cell_config)
        self._gate.check(BoundaryDisplacement.zero(), self.cell.commanded, self.cell.joint_angles)
        self._gate.reset()
        self.cell.refresh()
        self._look()  # takes long: the cable is searched for
        self.cell.refresh()
        self._look()

    def _lateness(self) -> float:
        """How long ago the command should have gone out [s]; 0 if that is still to come."""
        late = max(0.0, time.monotonic() - (self._tick + self.config.control_step))
        if late > 0.0:  # the arms have stood since, and nobody looked
            self.cell.refresh()
        return late

    def _wait_for_tick(self) -> None:
        """Until the period is over; after a late command the next period starts at once."""
        period = self.config.control_step
        self._tick = max(self._tick + period, time.monotonic() - period)
        self.cell.wait_until(self._tick)

    def _look(self) -> None:
        """Follows the cable into new images, and carries it on to the commanded clamps."""
        self._sample = sample = self.cell.wait_for_sample()
        estimate = self._cable.follow(sample.views, sample.boundary, sample.stamp)
        self._commanded = self.cell.commanded
        ahead = self._cable.ahead(estimate.centerline, sample.boundary, self._commanded)
        self._estimate = replace(estimate, centerline=ahead)

    def _halt(self) -> None:
        self.needs_recovery = self.cell_is_open
        self.cell.halt()

    def _observation(self) -> dict[str, NDArray]:
        assert self._commanded is not None
        return shape_observation(self.estimate.centerline, self._commanded, self.goal)

    def _info(
        self,
        displacement: BoundaryDisplacement,
        cuts: tuple[str, ...] = (),
        late: float = 0.0,
        termination: str = "",
        message: str = "",
    ) -> dict[str, Any]:
        error = float(tasks.shape_error(self.estimate.centerline, self.goal))
        success = error <= self.config.success_threshold
        return {
            "success": success,
            "is_success": success,
            "shape_error": error,
            "displacement": displacement.vector,
            "safety_cuts": cuts,
            "late": late,
            "termination": termination,
            "message": message,
        }


def _termination(error: BaseException) -> str:
    """What the end of an episode by ``error`` is called; empty if it is none."""
    return next((name for name, kinds in TERMINATIONS.items() if isinstance(error, kinds)), "")


def _size(displacement: BoundaryDisplacement, unit: tuple[float, float]) -> float:
    """The largest translation or rotation of a clamp, in units of ``unit`` [m], [rad]."""
    ends = displacement.vector.reshape(-1, 2, 3)
    return float((np.linalg.norm(ends, axis=-1) / np.array(unit)).max())
