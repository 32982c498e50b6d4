"""Goal shapes for a cell: from a file, or sampled among those its arms can make."""

from pathlib import Path

import numpy as np

from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.envs.goals import sample_goal
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.builder import SceneConfig
from dlo_gym.scene.ur5e import wrist_angle
from sim2real.config import CellConfig

SAMPLED = "sampled"
ATTEMPTS = 50
WRIST_RESERVE = 2.0  # times the limit, that a goal keeps from the wrists' singularity


def env_config(config: CellConfig) -> ShapeEnvConfig:
    """The simulated environment that is closest to a cell: same cable, arms' space and steps."""
    return ShapeEnvConfig(
        properties=config.rod.properties,
        n_elements=config.tracker.n_nodes - 1,
        control_step=config.control.period_s,
        max_translation_step=config.control.max_translation_step_m,
        max_rotation_step=config.control.max_rotation_step_rad,
        success_threshold=config.control.success_threshold_m,
        start_distance=0.8 * config.rod.length_m,
        goal_translation=0.24 * config.rod.length_m,
        goal_distance=(0.12 * config.rod.length_m, 0.25 * config.rod.length_m),
        max_stretch=config.limits.max_stretch - 0.005,
        min_gripper_distance=config.limits.min_gripper_distance_m,
        workspace=config.limits.workspace_m,
        cameras=config.camera_models,
    )


def make_goal(spec: str, config: CellConfig, start: BoundaryPoses, seed: int = 0) -> Array:
    """A goal centerline (n_nodes, 3), world [m].

    Args:
        spec: "sampled", or the name of a .npy file with such an array.
        config: of the cell.
        start: clamp poses that a sampled goal must be reachable from.
        seed: of the sampling.

    Raises:
        ValueError: if the file holds something else, or a goal the cable cannot take.
    """
    goal = _sampled(config, start, seed) if spec == SAMPLED else _from_file(Path(spec), config)
    span = float(np.linalg.norm(goal[-1] - goal[0]))
    longest = config.safety_limits.max_gripper_distance
    if span > longest:
        raise ValueError(
            f"goal {spec}: its ends are {span:.4f} m apart, the limit for this cable is"
            f" {longest:.4f} m"
        )
    return goal


def _sampled(config: CellConfig, start: BoundaryPoses, seed: int) -> Array:
    settings = env_config(config)
    scene = SceneConfig(cameras=config.camera_models, arms=config.dual_arm)
    cell = SimulatedCell(settings.properties, settings.n_elements, scene=scene)
    cell.reset(start)
    rng, arms = np.random.default_rng(seed), config.dual_arm
    now, bound = arms.inverse_kinematics(start), config.limits.min_wrist_angle_rad
    for _ in range(ATTEMPTS):
        goal = sample_goal(cell, rng, settings)
        joint_angles = arms.inverse_kinematics(goal.boundary, now)
        clear = arms.clearance(joint_angles).minimum > config.limits.min_arm_clearance_m
        wrists = np.sign(wrist_angle(now)) * wrist_angle(joint_angles)  # negative: beyond it
        if clear and wrists.min() > WRIST_RESERVE * bound:
            return goal.centerline
    raise ValueError(
        f"goal: none of {ATTEMPTS} sampled goals leaves the arms"
        f" {config.limits.min_arm_clearance_m} m of clearance (limits.min_arm_clearance_m) and the"
        f" wrists {WRIST_RESERVE * bound:.3g} rad from their singularity"
    )


def _from_file(file: Path, config: CellConfig) -> Array:
    expected = (config.tracker.n_nodes, 3)
    try:
        goal = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(
            f"goal: expected '{SAMPLED}' or a .npy file of shape {expected}, got {file}: {error}"
        ) from error
    if not isinstance(goal, np.ndarray) or goal.shape != expected or not np.isfinite(goal).all():
        got = getattr(goal, "shape", type(goal).__name__)
        raise ValueError(f"goal {file}: expected finite values of shape {expected}, got {got}")
    return goal.astype(np.float64)
