"""Many shape-control environments that step together."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dlo_gym.envs import tasks
from dlo_gym.envs.shape_env import ShapeControlEnv, flat_observation, two_clamps
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement
from dlo_gym.threads import Threads, n_cores

Observations = dict[str, NDArray]


class ShapeControlVectorEnv(VectorEnv):
    """``num_envs`` state-observing shape-control environments.

    Results are those of the single environment with the same seed, to the last bit; actions, arm
    kinematics, clearances, observations and rewards are worked out for all at once. Images and
    observers that look at them are left to Gymnasium's ``vectorization_mode="sync"`` and
    ``"async"``.

    Args:
        num_envs: how many.
        max_episode_steps: after which an episode is truncated; None for never.
        autoreset_mode: when an environment whose episode has ended starts the next one:
            ``"NextStep"`` with the next step, whose action it ignores, ``"SameStep"`` at once,
            with the last observation in ``info["final_obs"]``, or ``"Disabled"``: by
            ``reset(options={"reset_mask": ...})`` alone.
        threads: that move the rods and start episodes; one per processor core where None.
        render_mode, options: of each environment.

    Raises:
        ValueError: on a wrong argument, or options that ask for images.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: expected at least 1, got {num_envs}")
        if threads is not None and threads < 1:
            raise ValueError(f"threads: expected at least 1, or None, got {threads}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if render_mode == "human":
            raise ValueError(
                "render_mode: expected None or 'rgb_array' of many environments, got 'human'"
            )
        self.envs = [ShapeControlEnv(render_mode, **options) for _ in range(num_envs)]
        first = self.envs[0]
        self.config = first.config
        if self.config.uses_images:
            raise ValueError(
                "observer, observation_mode: the batched environment observes the simulator's state"
                ' alone; pass vectorization_mode="sync" or "async" to make_vec'
            )
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.metadata = first.metadata | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, num_envs)
        self.action_space = batch_space(first.action_space, num_envs)
        self._threads = Threads(min(threads or n_cores(), num_envs))
        self._max_steps = max_episode_steps
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._over: NDArray[np.bool_] | None = None  # whose episode has ended; None: no reset yet

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in all environments, or those of ``options["reset_mask"]`` (n,).

        ``seed`` is one per environment, or the first one's, and each next takes the next number.
        """
        options = dict(options or {})
        mask = _reset_mask(options.pop("reset_mask", None), self.num_envs)
        return self.reset_each(_seeds(seed, self.num_envs), [options] * self.num_envs, mask)

    def reset_each(
        self,
        seeds: Sequence[int | None],
        options: Sequence[dict[str, Any]],
        mask: NDArray[np.bool_],
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode where ``mask`` (n,) says so, each with a seed and options of its own."""
        if self._over is None and not mask.all():
            raise gym.error.ResetNeeded("reset_mask: expected all environments the first time")
        which = np.flatnonzero(mask).tolist()
        infos: dict[str, Any] = {}
        for i, info in zip(which, self._begin(which, seeds, options), strict=True):
            infos = self._add_info(infos, info, i)
        if self._over is None:
            self._over = np.zeros(self.num_envs, dtype=bool)
        self._steps[mask], self._over[mask] = 0, False
        return self._observations(), infos

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observations, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        if self._over is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        actions = self._checked(actions)
        starting = self._over
        if self.autoreset_mode is AutoresetMode.DISABLED and starting.any():
            raise gym.error.ResetNeeded(
                f"the episodes of environments {np.flatnonzero(starting).tolist()} have ended; call"
                ' reset(options={"reset_mask": ...}) first'
            )
        going = np.flatnonzero(~starting)
        started = np.flatnonzero(starting).tolist()
        beginnings = self._begin(started)
        reasons = np.full(self.num_envs, "", dtype=object)
        twists = np.zeros((self.num_envs, self.config.n_clamps, 6))
        if len(going):
            moving = [self.envs[i] for i in going]
            twists[going], reasons[going] = _advance(moving, actions[going], self._threads)
        self._steps[going] += 1
        self._steps[starting] = 0
        terminations = reasons != ""
        truncations = np.zeros(self.num_envs, dtype=bool)
        if self._max_steps is not None:
            truncations = (self._steps >= self._max_steps) & ~starting
        observations = self._observations()
        infos = self._infos(twists, reasons)
        rewards = tasks.compute_reward(
            observations["achieved_goal"],
            observations["desired_goal"],
            terminations,
            kind=self.config.reward,
            success_threshold=self.config.success_threshold,
            termination_penalty=self.config.termination_penalty,
        )
        rewards[starting] = 0.0
        for i, info in zip(started, beginnings, strict=True):
            infos = self._add_info(infos, info, i)
        self._over = over = terminations | truncations
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            observations, infos = self._start_over(observations, infos)
        return observations, rewards, terminations, truncations, infos

    def render(self) -> tuple[Any, ...]:
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        self._threads.close()
        for env in self.envs:
            env.close()

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """As a single environment's."""
        return self.envs[0].compute_reward(achieved_goal, desired_goal, info)

    def _begin(
        self,
        which: list[int],
        seeds: Sequence[int | None] | None = None,
        options: Sequence[dict[str, Any]] | None = None,
    ) -> list[dict[str, Any]]:
        """Start an episode in some of the environments; what each has to say."""

        def begin(i: int) -> dict[str, Any]:
            seed = None if seeds is None else seeds[i]
            return self.envs[i].reset(seed=seed, options=None if options is None else options[i])[1]

        return self._threads.map(begin, which)

    def _checked(self, actions: ArrayLike) -> Array:
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != self.action_space.shape or np.isnan(actions).any():
            raise ValueError(
                f"actions: expected numbers in [-1, 1] without NaN of shape"
                f" {self.action_space.shape}, got {actions}"
            )
        return actions

    def _observations(self) -> Observations:
        observations = flat_observation(
            np.stack([env.estimate.centerline for env in self.envs]),
            np.stack([env.cell.boundary.clamps for env in self.envs]),
            np.stack([env.goal for env in self.envs]),
        )
        if self.config.obstacles:
            observations["obstacles"] = np.stack([env.obstacle_numbers() for env in self.envs])
        return observations

    def _infos(self, twists: Array, reasons: NDArray[Any]) -> dict[str, Any]:
        states = [env.cell.rod_state for env in self.envs]
        errors = tasks.shape_error(
            np.stack([state.positions for state in states]),
            np.stack([env.goal for env in self.envs]),
        )
        success = errors <= self.config.success_threshold
        infos = {
            "success": success,
            "is_success": success.copy(),
            "shape_error": errors,
            "tracking_ptp3d": np.zeros(self.num_envs),
            "occlusion_ratio": np.zeros(self.num_envs),
            "wrench_left": np.stack([state.wrench_left for state in states]),
            "wrench_right": np.stack([state.wrench_right for state in states]),
            "displacement": two_clamps(twists.reshape(self.num_envs, -1)),
            "termination": reasons,
        }
        if self.config.obstacles:
            infos["touching"] = np.stack([env.touching() for env in self.envs])
        return infos | {f"_{key}": np.ones(self.num_envs, dtype=bool) for key in infos}

    def _start_over(
        self, observations: Observations, infos: dict[str, Any]
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin the next episode where one has ended; what it ended with goes into ``infos``."""
        assert self._over is not None
        over = np.flatnonzero(self._over).tolist()
        final: dict[str, Any] = {}
        for i in over:
            last = {key: values[i] for key, values in observations.items()}
            info = {key: _plain(values[i]) for key, values in infos.items() if key[0] != "_"}
            final = self._add_info(final, {"final_obs": last, "final_info": info}, i)
        for i, info in zip(over, self._begin(over), strict=True):
            infos = self._add_info(infos, info, i)
        self._steps[over] = 0
        self._over = np.zeros(self.num_envs, dtype=bool)
        return self._observations(), final | infos


def _advance(
    envs: Sequence[ShapeControlEnv], actions: Array, threads: Threads
) -> tuple[Array, list[str]]:
    """Step every cell; the motions made (n, k, 6) [m], [rad], and why episodes end."""
    cells = [env.cell for env in envs]
    clamps = np.stack([cell.boundary.clamps for cell in cells])
    before = [cell.boundary for cell in cells]
    twists = envs[0].clamp_action.to_twists(actions, clamps)
    if envs[0].config.randomization is not None:
        asked = (BoundaryDisplacement(*twist) for twist in twists)
        now = [env.delayed(twist) for env, twist in zip(envs, asked, strict=True)]
        twists = np.stack([twist.vector for twist in now]).reshape(twists.shape)
    reasons = tasks.advance_all(cells, twists, envs[0].config, threads.map)
    for env, twist, boundary in zip(envs, twists, before, strict=True):
        if env.cell.boundary is boundary:  # refused
            twist[:] = 0.0
        env.observe(BoundaryDisplacement(*twist))
    return twists, reasons


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _seeds(seed: int | Sequence[int | None] | None, n: int) -> Sequence[int | None]:
    if seed is None:
        return [None] * n
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(n)]
    if len(seed) != n:
        raise ValueError(f"seed: expected one per environment, {n}, got {len(seed)}")
    return seed


def _reset_mask(mask: Any, n: int) -> NDArray[np.bool_]:
    if mask is None:
        return np.ones(n, dtype=bool)
    mask = np.asarray(mask)
    if mask.shape != (n,) or mask.dtype != bool or not mask.any():
        raise ValueError(
            f"reset_mask: expected {n} booleans, at least one of them true, got {mask}"
        )
    return mask
