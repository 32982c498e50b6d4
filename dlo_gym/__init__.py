"""Dual-arm shape control of deformable linear objects: cables, wires, hoses."""

from math import radians

from gymnasium.envs.registration import register

# The shape-control family: what each id asks for beside the defaults.
SHAPE_TASKS = {
    "": {},
    "Easy": {"goal_distance": (0.03, 0.08), "goal_moves": 1, "goal_rotation": radians(15.0)},
    "Medium": {"goal_distance": (0.08, 0.25), "goal_moves": 4, "goal_rotation": radians(60.0)},
    "Hard": {
        "goal_distance": (0.08, 0.35),
        "goal_translation": 0.2,
        "goal_rotation": radians(60.0),
        "straight_way": "blocked",
    },
    "Planar": {"planar": True},
    "OneArm": {
        "free_end": True,
        "start_height": 0.62,
        "goal_distance": (0.06, 0.35),
        "workspace": ((-0.4, -0.25, 0.56), (0.1, 0.25, 0.75)),
    },
    "Obstacle": {
        "obstacles": ("post", "box", "post"),
        "standing_obstacles": (1, 3),
        "goal_distance": (0.08, 0.35),
        "goal_translation": 0.2,
    },
}

for name, task in SHAPE_TASKS.items():
    register(
        id=f"dlo_gym/ShapeControl{name}-v0",
        entry_point="dlo_gym.envs.shape_env:ShapeControlEnv",
        vector_entry_point="dlo_gym.envs.vector_env:ShapeControlVectorEnv",
        max_episode_steps=100,
        kwargs=dict(task),
    )
    register(
        id=f"dlo_gym/ShapeControl{name}Tracked-v0",
        entry_point="dlo_gym.envs.shape_env:ShapeControlEnv",
        max_episode_steps=100,
        kwargs=task | {"observer": "tracking.observer:TrackerObserver"},
    )
    register(
        id=f"dlo_gym/ShapeControl{name}Images-v0",
        entry_point="dlo_gym.envs.shape_env:ShapeControlEnv",
        max_episode_steps=100,
        kwargs=task | {"observation_mode": "images"},
    )

for form, options in (
    ("", {}),
    (
        "Tracked",
        {
            "observer": "tracking.observer:TrackerObserver",
            "observer_options": {"predictor": "rod"},  # the network knows no obstacles
        },
    ),
    ("Images", {"observation_mode": "images"}),
):
    register(
        id=f"dlo_gym/WrapBar{form}-v0",
        entry_point="dlo_gym.envs.wrap_bar_env:WrapBarEnv",
        max_episode_steps=300,
        kwargs=options,
    )

register(
    id="dlo_gym/RobotShapeControl-v0",
    entry_point="sim2real.robot_env:RobotShapeEnv",
    max_episode_steps=100,
    nondeterministic=True,  # real time, from where the arms are
)
