"""The same rod as a MuJoCo flex (discrete elastic rod), held by two mocap bodies.

MuJoCo's rod neither stretches nor shears and bends by 2 tan(angle / 2) between edges; the end edges
are clamped, as with ``CosseratRod(clamp="element")``. So a rod that hardly stretches agrees with it
up to discretisation.
"""

import mujoco
import numpy as np

from dlo_gym.geometry.curves import parallel_transport
from dlo_gym.geometry.se3 import Array, log_so3, matrix_to_quaternion
from dlo_gym.rod import BoundaryDisplacement, BoundaryPoses, RodProperties, RodState

TIME_STEP = 2e-3


class MujocoFlexRod:
    """A flex rod that starts at ``state`` and follows ``displacement`` of its clamps.

    Args:
        duration: of the motion [s]; afterwards the clamps hold still.
        damping: uniform damping constant [1/s].
        time_step: of the "discrete" integrator [s].
    """

    def __init__(
        self,
        properties: RodProperties,
        state: RodState,
        displacement: BoundaryDisplacement,
        *,
        duration: float,
        damping: float = 5.0,
        time_step: float = TIME_STEP,
    ) -> None:
        n = state.n_nodes - 1
        mass = properties.linear_density * properties.length / n
        self._model = mujoco.MjModel.from_xml_string(_xml(properties, n, time_step))
        self._data = mujoco.MjData(self._model)
        self._start, self._displacement, self._duration = state.boundary, displacement, duration
        self._hold(state.boundary)
        straight = np.linspace(0.0, properties.length, n + 1)[2:-2, None] * [0.0, 0.0, 1.0]
        self._data.qpos[:] = np.concatenate(
            [(state.positions[2:-2] - straight).ravel(), _twist_angles(state)[1:-1]]
        )
        mujoco.mj_forward(self._model, self._data)
        # Every degree of freedom is a point mass's slide or a hinge on its own.
        inertia = np.repeat([mass, 0.5 * mass * properties.radius**2], [3 * (n - 3), n - 2])
        self._damping = damping * inertia

    def advance(self, seconds: float) -> None:
        for _ in range(round(seconds / self._model.opt.timestep)):
            done = (self._data.time + self._model.opt.timestep) / self._duration
            self._hold(self._start.displaced(self._displacement.scaled(min(1.0, done))))
            self._data.qfrc_applied[:] = -self._damping * self._data.qvel
            mujoco.mj_step(self._model, self._data)

    @property
    def positions(self) -> Array:
        """(n_nodes, 3) centerline [m]."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_flex(self._model, self._data)
        return self._data.flexvert_xpos.copy()

    @property
    def speed(self) -> float:
        """The fastest node's [m/s]."""
        sliding = self._data.qvel[: 3 * (len(self._data.flexvert_xpos) - 4)]
        return float(np.linalg.norm(sliding.reshape(-1, 3), axis=1).max())

    def _hold(self, boundary: BoundaryPoses) -> None:
        assert boundary.right is not None
        for side, clamp in enumerate((boundary.left, boundary.right)):
            self._data.mocap_pos[side] = clamp[:3, 3]
            self._data.mocap_quat[side] = matrix_to_quaternion(clamp[:3, :3])


def _twist_angles(state: RodState) -> Array:
    """(n_elements,) angle of each material frame about its tangent, from the first one's carried
    along the rod without twist [rad]."""
    directors = state.directors
    carried = parallel_transport(directors[:, :, 2], directors[0])
    return np.unwrap(log_so3(np.swapaxes(carried, 1, 2) @ directors)[:, 2])


def _xml(properties: RodProperties, n: int, time_step: float) -> str:
    """A straight rod along z of n edges: the end edges in two mocap bodies, nodes with three slides
    between, and a hinge per free edge for its twist."""
    spacing = properties.length / n
    mass = properties.linear_density * spacing
    spin = 0.5 * mass * properties.radius**2
    nodes = "".join(
        f"""
        <body name="node_{i}" pos="0 0 {i * spacing}">
          <inertial pos="0 0 0" mass="{mass}" diaginertia="{spin} {spin} {spin}"/>
          <joint type="slide" axis="1 0 0"/>
          <joint type="slide" axis="0 1 0"/>
          <joint type="slide" axis="0 0 1"/>
        </body>"""
        for i in range(2, n - 1)
    )
    twists = "".join(
        f"""
        <body name="rod_twist_{e}">
          <inertial pos="0 0 0" mass="1e-9" diaginertia="{spin} {spin} {spin}"/>
          <joint name="rod_twist_{e}" axis="1 0 0"/>
        </body>"""
        for e in range(1, n - 1)
    )
    bodies = " ".join(["left", "left", *(f"node_{i}" for i in range(2, n - 1)), "right", "right"])
    vertices = " ".join(
        ["0 0 0", f"0 0 {spacing}", *["0 0 0"] * (n - 3), f"0 0 {-spacing}", "0 0 0"]
    )
    edges = " ".join(f"{e} {e + 1}" for e in range(n))
    return f"""
    <mujoco>
      <option integrator="discrete" timestep="{time_step}" tolerance="1e-10"/>
      <worldbody>
        <body name="left" mocap="true"/>
        <body name="right" mocap="true" pos="0 0 {properties.length}"/>{nodes}{twists}
      </worldbody>
      <deformable>
        <flex name="rod" dim="1" radius="{properties.radius}" body="{bodies}"
              vertex="{vertices}" element="{edges}">
          <contact contype="0" conaffinity="0" selfcollide="none"/>
          <elasticity young="{properties.youngs_modulus}" shear="{properties.shear_modulus}"/>
        </flex>
      </deformable>
      <equality>
        <flex flex="rod" solref="1e-4 1"/>
      </equality>
    </mujoco>"""
