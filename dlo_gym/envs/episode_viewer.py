"""Episodes as the rerun viewer shows them: what ``render_mode="human"`` is."""

from collections.abc import Mapping
from pathlib import Path

from dlo_gym.envs.cell import SimulatedCell
from dlo_gym.geometry.se3 import Array
from dlo_gym.overlay import GOAL, SEEN
from dlo_gym.rod.state import ShapeEstimate
from dlo_gym.scene.viewer import SceneViewer


class EpisodeViewer:
    """Shows a cell episode after episode, one behind the other in time.

    Args:
        cell: to show.
        save: an .rrd file to write instead of opening the viewer.

    Raises:
        MissingExtra, RenderingUnavailable, FileExistsError: as ``SceneViewer``.
    """

    def __init__(self, cell: SimulatedCell, save: Path | None = None) -> None:
        self._cell = cell
        names = [camera.name for camera in cell.cameras]
        self._viewer = SceneViewer(names, cell.scene.arms, ("progress",), save=save)
        self._began = self._now = 0.0
        self._episodes = 0

    def begin(self, goal: Array | None) -> None:
        """An episode, with its goal (n, 3) [m] where that is a shape."""
        if self._episodes:
            self._began = self._now + self._cell.control_step
        self._episodes += 1
        self._set_time()
        self._viewer.note(f"episode {self._episodes}", level="INFO")
        if self._cell.obstacles:
            self._viewer.show_obstacles(self._cell.obstacles)
        for view in self._cell.views():
            self._viewer.show_camera(view.camera)
        if goal is not None:
            self._viewer.show_curve("goal", goal, GOAL)
            for view in self._cell.views():
                self._viewer.show_drawn("goal", view.camera, goal, GOAL)

    def show(
        self, estimate: ShapeEstimate, progress: Mapping[str, float], termination: str
    ) -> None:
        """The cell as it is now, with what the observer made of it, and numbers to plot."""
        viewer, cell = self._viewer, self._cell
        self._set_time()
        radius = cell.rod_radius
        viewer.show_curve("cable", cell.rod_state.positions, cell.rod_color, radius=radius)
        for view in cell.views():
            viewer.show_image(view)
        if len(estimate.visible):
            viewer.show_curve("estimate", estimate.centerline, SEEN, radius=0.5 * radius)
            for view in cell.views():
                viewer.show_drawn("estimate", view.camera, estimate.centerline, SEEN)
        viewer.show_clamps(cell.boundary)
        if cell.joint_angles is not None:
            viewer.show_arms(cell.joint_angles)
        viewer.show_numbers({f"progress/{name}": value for name, value in progress.items()})
        if termination:
            viewer.note(f"ended by {termination}")

    def close(self) -> None:
        """Hands over what is left; the viewer stays open. Closing twice does no harm."""
        self._viewer.close()

    def _set_time(self) -> None:
        self._now = self._began + self._cell.stamp
        self._viewer.set_time(self._now)
