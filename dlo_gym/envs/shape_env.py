"""The shape-control environment."""

from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from dlo_gym.envs import goals, tasks
from dlo_gym.envs.actions import ClampAction
from dlo_gym.envs.cell import Appearance, SimulatedCell, sample_occluder_paths
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.envs.episode_viewer import EpisodeViewer
from dlo_gym.envs.observers import make_observer
from dlo_gym.envs.obstacle_course import sample_course
from dlo_gym.envs.obstacle_rows import ROW, obstacle_rows
from dlo_gym.envs.randomization import believed_cameras, randomized_properties
from dlo_gym.exceptions import TrackLost
from dlo_gym.geometry.curves import arc_length
from dlo_gym.geometry.se3 import Array
from dlo_gym.metrics import occlusion_ratio, ptp_3d
from dlo_gym.overlay import draw_overlay
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.obstacles import Obstacle
from dlo_gym.rod.state import ShapeEstimate
from dlo_gym.scene.builder import SceneConfig, default_cameras
from dlo_gym.scene.furnishings import Clutter

OBSTACLE_COLORS = {"forbidden": (0.90, 0.62, 0.08), "allowed": (0.55, 0.60, 0.66)}  # RGB
LONGEST_GOAL = 1.05  # of a given goal, in lengths of the rod: what its weight may stretch and noise


class ShapeControlEnv(gym.Env):
    """Two arms hold the ends of a cable and bring it into a goal shape.

    ## Description
    The cable is an elastic rod (bending, twist, shear, stretch, weight) in quasi-static
    equilibrium between two clamps. Both arms move their clamp a little in every step; the whole
    centerline shall come to lie on the goal's. `dlo_gym/ShapeControl-v0` observes the simulator's
    own state, `dlo_gym/ShapeControlTracked-v0` renders two views in every step and observes the
    cable through the multi-view tracker, `dlo_gym/ShapeControlImages-v0` adds the views to the
    observation. So do the tasks `ShapeControlEasy`, `Medium` and `Hard` (the arms would collide on
    the straight way to the goal), `Planar` (in the vertical plane), `OneArm` (the right end free)
    and `Obstacle` (posts and boxes stand in the straight way), e.g.
    `dlo_gym/ShapeControlHardTracked-v0`; `docs/environments.md` compares them.

    ## Action Space
    A `Box(-1, 1, (10,), float32)`, or `(12,)` with `axial_rotation=True`. Larger values are
    clipped; NaN and wrong shapes raise `ValueError`.

    | Num | Action                                   | Full scale                     |
    | --- | ---------------------------------------- | ------------------------------ |
    | 0-2 | left clamp: translation along world x y z | `max_translation_step` 0.01 m |
    | 3-4 | left clamp: rotation about its d1, d2    | `max_rotation_step` 4.5 deg    |
    | 5-7 | right clamp: translation                 | as left                        |
    | 8-9 | right clamp: rotation about its d1, d2   | as left                        |

    With `axial_rotation` each clamp has one more number, the rotation about d3 (the cable's axis).
    `planar=True` leaves translation along x and z and rotation about d1; `free_end=True` leaves
    the left clamp.

    ## Observation Space
    A flat `Dict` of float32 arrays, with n = 51 nodes:

    | Key              | Shape       | Meaning                                                   |
    | ---------------- | ----------- | --------------------------------------------------------- |
    | `observation`    | (3 n + 18,) | estimated centerline [m]; then of the left and the right  |
    |                  |             | clamp the position [m], d1 and d3 (zeros where the right  |
    |                  |             | end is free)                                              |
    | `achieved_goal`  | (3 n,)      | estimated centerline, world [m], node 0 at the left clamp |
    | `desired_goal`   | (3 n,)      | goal centerline, world [m]                                |
    | `obstacles`      | (15 m,)     | only with m `obstacles`: a row for each that may stand,   |
    |                  |             | zeros if it does not: 1; 1 if the cable may touch it;     |
    |                  |             | position [m], d1, d3; half edges of a box, by how much it |
    |                  |             | is rounded [m] (a post is a rounded line)                 |
    | `image_<camera>` | (h, w, 3)   | uint8 RGB; only with `observation_mode="images"`          |

    ## Rewards
    With `reward="dense"` minus the mean node distance of achieved to desired goal in decimetres;
    with `reward="sparse"` 0 if that distance is at most `success_threshold`, else -1. The step
    that ends an episode early costs `termination_penalty` on top. `compute_reward(achieved_goal,
    desired_goal, info)` takes single values or batches with a sequence of infos.

    ## Info
    | Key                           | Meaning                                                   |
    | ----------------------------- | --------------------------------------------------------- |
    | `success`, `is_success`       | whether `shape_error <= success_threshold`                |
    | `shape_error`                 | mean node distance of the true rod to the goal [m]        |
    | `tracking_ptp3d`              | mean node distance of the estimate to the true rod [m]    |
    | `occlusion_ratio`             | share of nodes truly hidden, over all views; 0 if the     |
    |                               | environment uses no images                                |
    | `wrench_left`, `wrench_right` | (6,) force [N] and torque [N m] of each clamp on the rod, |
    |                               | world axes                                                |
    | `displacement`                | (12,) how the clamps really moved [m, rad], world axes    |
    | `touching`                    | (m,) which obstacles the cable touches; with `obstacles`  |
    | `randomization`               | at reset, with `randomization` only: what was sampled     |
    | `termination`                 | why the episode ended early, or `""`                      |

    ## Starting State
    The clamps are about 0.4 m apart and 0.34 m above the table, moved and tilted at random within
    `start_noise`. The goal is the shape that the cable takes after `goal_moves` random motions
    from there, every step of which this environment allows: it can be reached, but it was reached
    on another than the straight way. `reset(options={"start": BoundaryPoses, "goal": centerline})`
    sets either; an overstretched goal is refused.

    With `obstacles`, all or some of them (`standing_obstacles`) stand in new places: the first one
    where the cable would touch it if its clamps went straight to the goal, the others nearby. The
    way round them was simulated: neither arms nor cable touch what they must not. Where touching is
    allowed the goal may lean on an obstacle. `options` takes `"obstacles"`, a sequence of `Box`,
    `Capsule` and `Sphere`, together with `"goal"`.

    ## Episode End
    Truncation after 100 steps (`gym.make(..., max_episode_steps=...)`). Termination, with the
    reason in `info["termination"]`; a motion that cannot be made leaves the cable where it was:

    | Reason             | Meaning                                                          |
    | ------------------ | ---------------------------------------------------------------- |
    | `overstretch`      | the clamps would be further apart than `max_stretch` rod lengths |
    | `collision`        | the grippers or arms touch each other, the table or an obstacle  |
    | `unreachable`      | an arm cannot take its clamp pose                                |
    | `table_contact`    | the cable touches the table                                      |
    | `obstacle_contact` | the cable touches an obstacle that it must not touch             |
    | `rod_diverged`     | no equilibrium of the rod was found                              |
    | `track_lost`       | the observer has not seen the cable for too long                 |

    Success does not end an episode.

    ## Arguments
    Every field of `ShapeEnvConfig`, e.g.
    `gym.make("dlo_gym/ShapeControl-v0", goal_distance=(0.06, 0.1), reward="sparse")`.

    ## Rendering
    `render_mode="rgb_array"`: `render()` returns the views side by side, the goal drawn in;
    `"rgb_array_list"` (by `gym.make`): those since the last call. `"human"`: every step appears in
    the rerun viewer (`pip install 'dlo-gym[view]'`): cable, goal, arms, cameras with their images;
    with `render_file="episodes.rrd"` it goes to a file for the viewer, which needs no display.

    ## Version History
    * v0: first version.
    """

    CONFIG: ClassVar[type[ShapeEnvConfig]] = ShapeEnvConfig
    RESET_OPTIONS: ClassVar[tuple[str, ...]] = ("start", "goal", "obstacles")
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode: expected None or one of {self.metadata['render_modes']},"
                f" got {render_mode!r}"
            )
        self.config = config = self.CONFIG.from_options(options)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1.0 / config.control_step)}
        self.cell = SimulatedCell(
            config.properties,
            config.n_elements,
            scene=_scene_config(config),
            check_arms=config.check_arms,
            control_step=config.control_step,
            self_contact=config.self_contact,
            friction=config.friction,
        )
        self._observer = make_observer(config.observer, config.observer_options)
        self._viewer: EpisodeViewer | None = None
        self._estimate: ShapeEstimate | None = None
        self._goal: Array | None = None
        self._commands: deque[BoundaryDisplacement] = deque()
        self.clamp_action = ClampAction(
            config.max_translation_step,
            config.max_rotation_step,
            config.axial_rotation,
            config.planar,
            config.n_clamps,
        )
        self.action_space = spaces.Box(-1.0, 1.0, (self.clamp_action.size,), np.float32)
        self.observation_space = self._make_observation_space()

    @property
    def estimate(self) -> ShapeEstimate:
        """What the observer knows of the rod's shape since the last step."""
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
        super().reset(seed=seed)
        options = options or {}
        unknown = [name for name in options if name not in self.RESET_OPTIONS]
        if unknown:
            raise ValueError(
                f"unknown reset option {', '.join(map(repr, unknown))};"
                f" valid options are: {', '.join(self.RESET_OPTIONS)}"
            )
        randomized = self._randomize() if self.config.randomization is not None else None
        self._begin(options)
        self._estimate = self._observer.reset(self.cell)
        info = self._info(BoundaryDisplacement.zero(self.config.n_clamps), "")
        if randomized is not None:
            info["randomization"] = randomized
        if self.render_mode == "human":
            self._viewer = self._viewer or EpisodeViewer(self.cell, self.config.render_file)
            self._viewer.begin(self._goal)
            self._viewer.show(self.estimate, self._progress(info), "")
        return self._observation(), info

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray], float, bool, bool, dict[str, Any]]:
        if self._estimate is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        displacement = self.delayed(self.action_to_displacement(action))
        before = self.cell.boundary
        termination = tasks.advance(self.cell, displacement, self.config)
        if self.cell.boundary is before:  # refused
            displacement = BoundaryDisplacement.zero(self.config.n_clamps)
        if not self.observe(displacement):
            termination = termination or "track_lost"
        observation = self._observation()
        info = self._info(displacement, termination)
        reward = self.compute_reward(
            observation["achieved_goal"], observation["desired_goal"], info
        )
        if self._viewer is not None:
            self._viewer.show(self.estimate, self._progress(info), termination)
        return observation, float(reward), bool(termination), False, info

    def _begin(self, options: dict[str, Any]) -> None:
        """Pose the cell for a new episode, and choose its goal."""
        config, rng = self.config, self.np_random
        start, goal, obstacles = (options.get(name) for name in ("start", "goal", "obstacles"))
        if start is not None and (
            not isinstance(start, BoundaryPoses) or len(start.clamps) != config.n_clamps
        ):
            held = "one clamp" if config.free_end else "two clamps"
            raise ValueError(f"start: expected BoundaryPoses of {held}, got {start!r}")
        if goal is not None:
            goal = check_goal(goal, config, self.cell.properties.length)
        if config.obstacles and (goal is None) != (obstacles is None):
            raise ValueError(
                "goal, obstacles: expected both or neither, for a way must lead round the obstacles"
                f" to the goal; got goal={goal!r}, obstacles={obstacles!r}"
            )
        occluders = sample_occluder_paths(rng, self.cell.cameras, config.n_occluders)
        if start is not None:
            self.cell.reset(start, occluders)
        else:
            tasks.reset_to_random_start(self.cell, rng, config, occluders)
        if obstacles is not None:
            self._place_obstacles(obstacles)
        if goal is None:
            sample = sample_course if config.obstacles else goals.sample_goal
            goal = sample(self.cell, rng, config).centerline
        self._goal = goal

    def _place_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        self.cell.place_obstacles(obstacles)
        if self.cell.arms_at_obstacle():
            raise ValueError("obstacles: expected clear of the arms at the start")
        if tasks.forbidden_touch(self.cell, self.config):
            touched = np.flatnonzero(self.cell.touching).tolist()
            raise ValueError(
                f"obstacles: expected clear of the cable at the start, got {touched} touching it"
            )

    def delayed(self, displacement: BoundaryDisplacement) -> BoundaryDisplacement:
        """The motion that the arms make now that ``displacement`` is asked of them."""
        self._commands.append(displacement)
        return self._commands.popleft()

    def observe(self, displacement: BoundaryDisplacement) -> bool:
        """Look at the cell after its clamps have moved; False if the rod is lost from sight."""
        try:
            self._estimate = self._observer.update(self.cell, displacement)
        except TrackLost:
            return False
        return True

    def obstacle_numbers(self) -> NDArray[np.float32]:
        """(15 m,) the obstacles as the observation carries them, a row for each that may stand."""
        config = self.config
        return obstacle_rows(self.cell.obstacles, config.touches, len(config.obstacles))

    def touching(self) -> NDArray[np.bool_]:
        """(m,) which of the obstacles that may stand the cable touches."""
        touching = np.zeros(len(self.config.obstacles), dtype=bool)
        touching[: len(self.cell.obstacles)] = self.cell.touching
        return touching

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

    def action_to_displacement(self, action: ArrayLike) -> BoundaryDisplacement:
        """The motion of the clamps, world axes, that ``action`` (10,) or (12,) stands for."""
        return self.clamp_action.to_displacement(action, self.cell.boundary)

    def displacement_to_action(self, displacement: BoundaryDisplacement) -> NDArray[np.float32]:
        """The action closest to ``displacement`` within the step limits."""
        action = self.clamp_action.to_action(displacement, self.cell.boundary)
        return action.astype(np.float32)

    def render(self) -> NDArray[np.uint8] | None:
        """All views side by side, with goal and estimate drawn in.

        None without render mode, and in mode ``"human"``, where every step shows itself.
        """
        if self.render_mode == "human":
            return None
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode; pass render_mode='rgb_array' to make"
            )
            return None
        estimate = self.estimate
        images = []
        for index, view in enumerate(self.cell.views()):
            visible = estimate.visible[index] if len(estimate.visible) else None
            images.append(
                draw_overlay(
                    view,
                    estimate.centerline if visible is not None else None,
                    visible=visible,
                    goal=self._goal,
                    caption=f"{view.camera.name}  {self.cell.stamp:.1f} s",
                )
            )
        height = min(len(image) for image in images)
        return np.hstack([image[:height] for image in images])

    def close(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
        self._viewer = None
        self._observer.close()
        self.cell.close()

    def _randomize(self) -> dict[str, Any]:
        """Sample what ``randomization`` has ranges of, and set the cell up so."""
        assert self.config.randomization is not None
        values = self.config.randomization.sample(self.np_random, self.cell.cameras)
        self.cell.replace_rod(
            randomized_properties(self.config.properties, values),
            Appearance(
                values.get("rod_color"),
                believed_cameras(self.cell.cameras, values),
                values.get("camera_latency", 0),
                Clutter(**values["clutter"]) if "clutter" in values else None,
            ),
            values.get("friction"),
        )
        still = [BoundaryDisplacement.zero(self.config.n_clamps)] * values.get("arm_latency", 0)
        self._commands = deque(still)
        return values

    def _make_observation_space(self) -> spaces.Dict:
        n_nodes = self.config.n_nodes
        # No point of a cable in reach of the arms is further than 2 m from the origin.
        entries: dict[str, spaces.Space] = {
            "observation": spaces.Box(-2.0, 2.0, (3 * n_nodes + 18,), np.float32),
            "achieved_goal": spaces.Box(-2.0, 2.0, (3 * n_nodes,), np.float32),
            "desired_goal": spaces.Box(-2.0, 2.0, (3 * n_nodes,), np.float32),
        }
        if self.config.obstacles:
            n_numbers = ROW * len(self.config.obstacles)
            entries["obstacles"] = spaces.Box(-2.0, 2.0, (n_numbers,), np.float32)
        if self.config.observation_mode == "images":
            for camera in self.cell.cameras:
                shape = (camera.height, camera.width, 3)
                entries[f"image_{camera.name}"] = spaces.Box(0, 255, shape, np.uint8)
        return spaces.Dict(entries)

    def _observation(self) -> dict[str, NDArray]:
        observation = shape_observation(self.estimate.centerline, self.cell.boundary, self.goal)
        return self._and_the_rest(observation)

    def _and_the_rest(self, observation: dict[str, NDArray]) -> dict[str, NDArray]:
        """``observation`` with obstacles and images, where there are any."""
        if self.config.obstacles:
            observation["obstacles"] = self.obstacle_numbers()
        if self.config.observation_mode == "images":
            for view in self.cell.views():
                observation[f"image_{view.camera.name}"] = view.image.copy()
        return observation

    def _info(self, displacement: BoundaryDisplacement, termination: str) -> dict[str, Any]:
        state = self.cell.rod_state
        error = float(tasks.shape_error(state.positions, self.goal))
        success = error <= self.config.success_threshold
        info = {"success": success, "is_success": success, "shape_error": error}
        return info | self._info_of_cell(displacement, termination)

    def _progress(self, info: dict[str, Any]) -> dict[str, float]:
        """What the viewer plots."""
        return {"goal_distance_mm": 1e3 * info["shape_error"]}

    def _info_of_cell(self, displacement: BoundaryDisplacement, termination: str) -> dict[str, Any]:
        """What there is to know whatever the task."""
        state = self.cell.rod_state
        hidden = occlusion_ratio(self.cell.visibility()) if self.config.uses_images else 0.0
        info = {
            "tracking_ptp3d": float(ptp_3d(self.estimate.centerline, state.positions).mean()),
            "occlusion_ratio": hidden,
            "wrench_left": state.wrench_left.copy(),
            "wrench_right": state.wrench_right.copy(),
            "displacement": two_clamps(displacement.vector),
            "termination": termination,
        }
        if self.config.obstacles:
            info["touching"] = self.touching()
        return info


def shape_observation(
    centerline: Array, boundary: BoundaryPoses, goal: Array
) -> dict[str, NDArray]:
    """The observation of a centerline (n, 3) [m] held at ``boundary``, for a goal (n, 3) [m]."""
    return flat_observation(centerline, boundary.clamps, goal)


def two_clamps(vectors: Array) -> Array:
    """Motions (..., 12) of both clamps, of (..., 12) or those of the left one alone (..., 6)."""
    both = np.zeros((*vectors.shape[:-1], 12))
    both[..., : vectors.shape[-1]] = vectors
    return both


def flat_observation(centerlines: Array, clamps: Array, goals: Array) -> dict[str, NDArray]:
    """Observations of centerlines (..., n, 3) [m] held at clamps (..., k, 4, 4), for goals
    (..., n, 3) [m]."""
    batch = centerlines.shape[:-2]
    points = centerlines.reshape(*batch, -1)
    held = np.zeros((*batch, 18))  # of a free right end nothing
    numbers = clamps[..., :3, [3, 0, 2]].swapaxes(-1, -2).reshape(*batch, -1)
    held[..., : numbers.shape[-1]] = numbers
    return {
        "observation": np.concatenate([points, held], axis=-1).astype(np.float32),
        "achieved_goal": points.astype(np.float32),
        "desired_goal": goals.reshape(*batch, -1).astype(np.float32),
    }


def check_goal(goal: ArrayLike, config: ShapeEnvConfig, length: float | None = None) -> Array:
    """``goal`` as a centerline (n_nodes, 3) that the rod of ``config`` can take, or one of another
    ``length`` [m].

    Raises:
        ValueError: on a wrong shape, a value that is not finite, or an overstretched goal.
    """
    goal = np.array(goal, dtype=np.float64)
    if goal.shape != (config.n_nodes, 3) or not np.isfinite(goal).all():
        raise ValueError(
            f"goal: expected a finite centerline of shape ({config.n_nodes}, 3),"
            f" got shape {goal.shape}"
        )
    length = config.properties.length if length is None else length
    span, along = float(np.linalg.norm(goal[-1] - goal[0])), float(arc_length(goal)[-1])
    if (
        span > config.max_stretch * length and not config.free_end
    ) or along > LONGEST_GOAL * length:
        raise ValueError(
            f"goal: overstretched: its ends are {span:.4f} m apart and it is {along:.4f} m long,"
            f" for a rod of {length:.4f} m with max_stretch {config.max_stretch}"
        )
    return goal


def _scene_config(config: ShapeEnvConfig) -> SceneConfig:
    cameras = config.cameras or default_cameras()
    clutter = None if config.randomization is None else config.randomization.clutter
    return SceneConfig(
        cameras=tuple(camera.scaled(config.image_scale) for camera in cameras),
        rod_radius=float(np.max(config.properties.radius)),
        n_nodes=config.n_nodes,
        clutter=config.clutter,
        n_distractor_cables=config.n_distractor_cables,
        n_occluders=config.n_occluders,
        obstacle_colors=tuple(OBSTACLE_COLORS[touch] for touch in config.touches),
        n_clutter=0 if clutter is None else int(clutter[1]),
        occluder_size=config.occluder_size,
        renderer=config.renderer,
        quality=config.quality,
    )
