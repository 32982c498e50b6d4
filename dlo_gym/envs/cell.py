"""The simulated work cell: a rod between two arms, cameras, moving occluders and a clock."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_gym.geometry.camera import CameraModel, View
from dlo_gym.geometry.se3 import Array
from dlo_gym.rod.boundary import BoundaryDisplacement, BoundaryPoses
from dlo_gym.rod.obstacles import Obstacle
from dlo_gym.rod.properties import RodProperties
from dlo_gym.rod.rod import CosseratRod
from dlo_gym.rod.state import RodState
from dlo_gym.scene.builder import SceneConfig
from dlo_gym.scene.clearance import obstacle_clearance
from dlo_gym.scene.furnishings import Clutter
from dlo_gym.scene.renderer import SceneRenderer


@dataclass(frozen=True, eq=False)
class OccluderPath:
    """A body that swings to and fro.

    Attributes:
        centre: (3,) middle of the path, world [m].
        swing: (3,) from the middle to one end [m].
        period: of one swing to and fro [s].
        phase: at time zero [rad].
    """

    centre: Array
    swing: Array
    period: float
    phase: float

    def position(self, stamp: float) -> Array:
        """(3,) where the body is at time ``stamp`` [s]."""
        return self.centre + self.swing * np.sin(2.0 * np.pi * stamp / self.period + self.phase)


@dataclass(frozen=True, eq=False)
class Appearance:
    """How this cell differs from what its scene says.

    Attributes:
        rod_color: RGB in [0, 1]; the scene's where None.
        cameras: the scene's, as who looks at the images knows them; exactly where None.
        camera_latency: how many control steps old the images are.
        clutter: on the table.
    """

    rod_color: Array | None = None
    cameras: tuple[CameraModel, ...] | None = None
    camera_latency: int = 0
    clutter: Clutter | None = None


@dataclass(frozen=True, eq=False)
class CellState:
    """What a cell returns to: the rod, the arms' joint angles (2, 6) [rad], the time [s]."""

    rod: RodState
    joint_angles: Array | None
    stamp: float


class SimulatedCell:
    """A rod held by two arms in front of cameras.

    The renderer is built when the first image is asked for, so a cell that is never looked at
    needs no OpenGL.

    Args:
        properties: of the rod.
        n_elements: of the rod.
        scene: what the cameras see.
        check_arms: whether every clamp pose must be in the arms' reach.
        control_step: how far the clock goes on with every move [s].
        self_contact: whether the rod can touch itself.
        friction: Coulomb's coefficient between rod and obstacles.
    """

    def __init__(
        self,
        properties: RodProperties,
        n_elements: int = 50,
        *,
        scene: SceneConfig,
        check_arms: bool = True,
        control_step: float = 0.1,
        self_contact: bool = False,
        friction: float = 0.0,
    ) -> None:
        self._contact_options = {"self_contact": self_contact, "friction": friction}
        self.rod = CosseratRod(properties, n_elements, **self._contact_options)
        self.scene = scene
        self.arms = scene.arms if check_arms else None
        self.control_step = control_step
        self.stamp = 0.0
        self.joint_angles: Array | None = None
        self._occluders: tuple[OccluderPath, ...] = ()
        self._rod_state: RodState | None = None
        self._renderer: SceneRenderer | None = None
        self._posed = False
        self._furnished = False
        self._shown_obstacles: tuple[Obstacle, ...] = ()
        self._views: tuple[View, ...] | None = None
        self._visibility: NDArray[np.bool_] | None = None
        self._appearance = Appearance()
        self._past: deque[CellState] = deque(maxlen=1)

    def replace_rod(
        self, properties: RodProperties, appearance: Appearance, friction: float | None = None
    ) -> None:
        """Another rod of as many elements, looked at in another way, from the next reset on; with
        other ``friction`` if given."""
        if friction is not None:
            self._contact_options["friction"] = friction
        self.rod = CosseratRod(properties, self.rod.n_elements, **self._contact_options)
        self._appearance = appearance
        self._furnished = False
        self._past = deque(maxlen=1 + appearance.camera_latency)

    @property
    def properties(self) -> RodProperties:
        return self.rod.properties

    @property
    def rod_radius(self) -> float:
        """The rod's largest [m]."""
        radius = self.properties.radius
        return radius if isinstance(radius, float) else float(np.max(radius))

    @property
    def n_nodes(self) -> int:
        return self.rod.n_nodes

    @property
    def cameras(self) -> tuple[CameraModel, ...]:
        return tuple(self.scene.cameras)

    @property
    def rod_color(self) -> tuple[int, int, int]:
        """RGB of the rod, 0 to 255."""
        color = self._appearance.rod_color
        red, green, blue = self.scene.rod_color if color is None else color
        return round(255 * red), round(255 * green), round(255 * blue)

    @property
    def rod_state(self) -> RodState:
        """The true state of the rod."""
        if self._rod_state is None:
            raise ValueError("the cell holds no rod yet; call reset(boundary) first")
        return self._rod_state

    @property
    def boundary(self) -> BoundaryPoses:
        """The clamp poses that hold the rod."""
        return self.rod_state.boundary

    def copy_of_rod(self) -> CosseratRod:
        """Another rod like the cell's, in the same state among the same obstacles."""
        rod = CosseratRod(self.properties, self.rod.n_elements, **self._contact_options)
        rod.restore(self.rod_state)
        return rod

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """What stands in the cell for the rod to touch."""
        if self._rod_state is None or self._rod_state.contact is None:
            return ()
        return self._rod_state.contact.obstacles

    @property
    def touching(self) -> NDArray[np.bool_]:
        """(m,) which of the obstacles the rod touches."""
        contact = self.rod_state.contact
        if contact is None:
            return np.zeros(0, dtype=bool)
        return contact.gaps.min(axis=1) < 0.0

    def reset(self, boundary: BoundaryPoses, occluders: Sequence[OccluderPath] = ()) -> RodState:
        """Settle the rod between ``boundary``, among no obstacles, and set the clock to zero.

        Raises:
            ValueError: if the clamps are too far apart, or there is another number of occluders
                than in the scene.
            UnreachablePose: if an arm cannot hold its clamp there.
            RodDiverged: if the rod finds no equilibrium.
        """
        if len(occluders) != self.scene.n_occluders:
            raise ValueError(
                f"occluders: expected the path of each of {self.scene.n_occluders},"
                f" got {len(occluders)}"
            )
        joint_angles = self._reach(boundary, None)
        if self.obstacles:
            self.rod = CosseratRod(self.properties, self.rod.n_elements, **self._contact_options)
        self._rod_state = self.rod.settle(boundary)
        self.joint_angles = joint_angles
        self._occluders = tuple(occluders)
        self._past.clear()
        self._show(0.0)
        return self._rod_state

    def place_obstacles(self, obstacles: Sequence[Obstacle]) -> RodState:
        """Put obstacles into the cell, in place of those that stand there; the rod settles among
        them from where it is.

        Raises:
            ValueError: on more obstacles than the scene has colours for, or a clamp inside one.
            RodDiverged: if the rod finds no equilibrium among them.
        """
        places = len(self.scene.obstacle_colors)
        if len(obstacles) > places:
            raise ValueError(f"obstacles: expected at most {places}, got {len(obstacles)}")
        self.rod.set_obstacles(obstacles)
        self._rod_state = self.rod.state
        self._past.clear()
        self._show(self.stamp)
        return self._rod_state

    def move(
        self, displacement: BoundaryDisplacement, joint_angles: Array | None = None
    ) -> RodState:
        """Move the clamps, let the rod follow and the clock go on.

        Nothing has changed if this raises.

        Args:
            displacement: of the clamps.
            joint_angles: (2, 6) [rad] that hold the moved clamps, where they are known already.

        Raises:
            ValueError: if the clamps would be further apart than the rod is long.
            UnreachablePose: if an arm cannot follow.
            RodDiverged: if the rod's equilibrium was lost.
        """
        if joint_angles is None:
            joint_angles = self._reach(self.boundary.displaced(displacement), self.joint_angles)
        self._rod_state = self.rod.move(displacement)
        self.joint_angles = joint_angles
        self._show(self.stamp + self.control_step)
        return self._rod_state

    def save(self) -> CellState:
        return CellState(self.rod_state, self.joint_angles, self.stamp)

    def restore(self, state: CellState) -> None:
        """Return to a saved state exactly."""
        self.rod.restore(state.rod)
        self._rod_state = state.rod
        self.joint_angles = state.joint_angles
        self._past.clear()
        self._show(state.stamp)

    def start_clock(self) -> None:
        """Set the clock to zero, as if nothing had moved before."""
        self._past.clear()
        self._show(0.0)

    def arms_at_obstacle(self) -> bool:
        """Whether an arm or gripper touches an obstacle."""
        if self.arms is None or self.joint_angles is None or not self.obstacles:
            return False
        gaps = obstacle_clearance(self.arms.T_world_base, self.joint_angles, self.obstacles)
        return bool((gaps < 0.0).any())

    def clamps_at_obstacle(self, ends: Array) -> bool:
        """Whether the rod would overlap an obstacle at clamps in ``ends`` (k, 3) [m]."""
        contact = self.rod_state.contact
        if contact is None or not contact.obstacles:
            return False
        moved = np.linalg.norm(ends - contact.points[[0, -1]][: len(ends)], axis=1)
        if (contact.gaps[:, [0, -1]][:, : len(ends)] > moved).all():
            return False
        radius = self.rod_radius
        return any((body.signed_distance(ends) < radius).any() for body in contact.obstacles)

    def views(self) -> tuple[View, ...]:
        """One image per camera of the cell as it is now, or was ``camera_latency`` steps ago."""
        if self._views is None:
            views = self._posed_renderer().views(self._past[0].stamp)
            known = self._appearance.cameras or self.cameras
            self._views = tuple(
                View(view.image, camera, view.stamp)
                for view, camera in zip(views, known, strict=True)
            )
        return self._views

    def visibility(self) -> NDArray[np.bool_]:
        """(n_views, n_nodes) which nodes each camera truly sees, hidden by nothing."""
        if self._visibility is None:
            renderer = self._posed_renderer()
            self._visibility = np.array(
                [renderer.visibility(camera.name) for camera in self.cameras]
            )
        return self._visibility

    def close(self) -> None:
        """Give back the renderer; the cell builds another one when it is looked at again."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None
        self._posed = self._furnished = False

    def _reach(self, boundary: BoundaryPoses, guess: Array | None) -> Array | None:
        return None if self.arms is None else self.arms.inverse_kinematics(boundary, guess)

    def _show(self, stamp: float) -> None:
        self.stamp = stamp
        self._posed = False
        if self.obstacles is not self._shown_obstacles:
            self._shown_obstacles = self.obstacles
            self._furnished = False
        self._views = self._visibility = None
        self._past.append(CellState(self.rod_state, self.joint_angles, stamp))

    def _posed_renderer(self) -> SceneRenderer:
        if self._renderer is None:
            self._renderer = SceneRenderer(self.scene)
        if not self._furnished:
            self._renderer.furnish(self.obstacles, self._appearance.clutter)
            self._furnished = True
        if not self._posed:
            seen = self._past[0]
            occluders = np.array([path.position(seen.stamp) for path in self._occluders])
            self._renderer.dress_rod(self.rod_radius, self._appearance.rod_color)
            self._renderer.update(
                seen.rod.positions,
                seen.rod.boundary,
                occluder_positions=occluders if len(occluders) else None,
                joint_angles=seen.joint_angles,
            )
            self._posed = True
        return self._renderer


def sample_occluder_paths(
    rng: np.random.Generator, cameras: Sequence[CameraModel], n_occluders: int
) -> tuple[OccluderPath, ...]:
    """Paths across the lines of sight of the cameras, in turn, to the middle of the cell."""
    paths = []
    for index in range(n_occluders):
        camera = cameras[index % len(cameras)]
        target = np.array([rng.uniform(-0.12, 0.12), 0.0, 0.3])
        centre = camera.centre + rng.uniform(0.5, 0.65) * (target - camera.centre)
        across = camera.T_world_camera[:3, 0] * rng.choice([-1.0, 1.0])
        paths.append(
            OccluderPath(
                centre=centre,
                swing=rng.uniform(0.12, 0.2) * across,
                period=float(rng.uniform(6.0, 10.0)),
                phase=float(rng.uniform(0.0, 2.0 * np.pi)),
            )
        )
    return tuple(paths)
