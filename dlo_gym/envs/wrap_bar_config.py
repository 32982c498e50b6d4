"""The options of the wrap-bar environment."""

from dataclasses import dataclass, field, fields
from math import tau
from typing import ClassVar

import numpy as np

from dlo_gym.envs.config import ShapeEnvConfig
from dlo_gym.rod.properties import RodProperties

# Options about goal shapes, and clamps that a bar leaves no room for.
NOT_HERE = (
    "obstacles", "standing_obstacles", "planar", "free_end", "success_threshold", "start_height",
    "goal_moves", "goal_translation", "goal_rotation", "goal_distance", "straight_way",
)  # fmt: skip
CROSSING = 0.1  # y at which the cable lies across the bar [m]


@dataclass(frozen=True)
class WrapBarConfig(ShapeEnvConfig):
    """Every option that ``gym.make`` takes for ``dlo_gym/WrapBar-v0``: those of
    ``ShapeEnvConfig`` without the ones about goal shapes, and more.

    Attributes:
        winding: the angle to wind the cable round the bar, beyond just lying across it [rad];
            right-handed about the bar's axis, which points from its free end to its stand.
        hold_steps: for how many steps in a row the cable must stay wound and touching.
        bar_radius: [m].
        bar_height: of the bar's axis above the table [m].
        bar_noise: half-range of the bar's position across its axis [m].
        bar_span: y of the bar's free end and of its stand [m].
        touch_tolerance: gap between cable and bar that an observation counts as touching [m].

    Raises:
        ValueError: naming the option, what was expected and what came.
    """

    properties: RodProperties = field(default_factory=lambda: RodProperties(length=0.7))
    max_translation_step: float = 0.02
    start_distance: float = 0.44
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-0.4, -0.25, 0.15),
        (0.4, 0.25, 0.7),
    )
    obstacles: tuple[str, ...] = ("bar", "stand")
    touch: str | tuple[str, ...] = ("allowed", "forbidden")
    friction: float = 0.3
    self_contact: bool = True
    winding: float = tau
    hold_steps: int = 5
    bar_radius: float = 0.02
    bar_height: float = 0.34
    bar_noise: float = 0.02
    bar_span: tuple[float, float] = (-0.02, 0.3)
    touch_tolerance: float = 0.002

    OBSTACLE_KINDS: ClassVar[tuple[str, ...]] = ("bar", "stand")

    def __post_init__(self) -> None:
        defaults = {option.name: option.default for option in fields(type(self))}
        for name in NOT_HERE:
            if getattr(self, name) != defaults[name]:
                raise ValueError(
                    f"{name}: expected none, for the cable is wound round a bar, got"
                    f" {getattr(self, name)!r}"
                )
        super().__post_init__()
        if not self.self_contact:
            raise ValueError(
                "self_contact: expected True, for a cable that is wound meets itself, got False"
            )
        if self.touches[0] != "allowed":
            raise ValueError(
                f'touch: expected "allowed" for the bar that is to be wrapped, got {self.touch!r}'
            )
        for name in ("bar_radius", "bar_height", "touch_tolerance"):
            self._check_number(name, positive=True)
        self._check_number("bar_noise")
        if not (np.isfinite(self.winding) and self.winding != 0):
            raise ValueError(f"winding: expected an angle other than 0 [rad], got {self.winding}")
        if not isinstance(self.hold_steps, int | np.integer) or self.hold_steps < 1:
            raise ValueError(
                f"hold_steps: expected an integer of at least 1, got {self.hold_steps!r}"
            )
        if np.shape(self.bar_span) != (2,) or not self.bar_span[0] < CROSSING < self.bar_span[1]:
            raise ValueError(
                f"bar_span: expected the free end's y below {CROSSING} m, where the cable lies, and"
                f" the stand's above it, got {self.bar_span}"
            )
        round_it = (abs(self.winding) + np.pi) * (self.bar_radius + self.thickest_rod)
        if round_it > 0.8 * self.rod_length[0]:
            raise ValueError(
                f"winding: expected a cable longer than the way round the bar: {self.winding:.4g}"
                f" rad take {round_it:.4g} m of a cable of {self.rod_length[0]:.4g} m"
            )
