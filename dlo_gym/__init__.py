"""Dual-arm shape control of deformable linear objects: cables, wires, hoses."""

from gymnasium.envs.registration import register

register(
    id="dlo_gym/ShapeControl-v0",
    entry_point="dlo_gym.envs.shape_env:ShapeControlEnv",
    vector_entry_point="dlo_gym.envs.vector_env:ShapeControlVectorEnv",
    max_episode_steps=100,
)
register(
    id="dlo_gym/ShapeControlTracked-v0",
    entry_point="dlo_gym.envs.shape_env:ShapeControlEnv",
    max_episode_steps=100,
    kwargs={"observer": "tracking.observer:TrackerObserver"},
)
register(
    id="dlo_gym/RobotShapeControl-v0",
    entry_point="sim2real.robot_env:RobotShapeEnv",
    max_episode_steps=100,
    nondeterministic=True,  # real time, from where the arms are
)
