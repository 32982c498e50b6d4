"""A cell without hardware: simulated arms, a rod that follows them, cameras that draw it."""

import threading
from types import SimpleNamespace

import numpy as np
import tomlkit

from dlo_gym.exceptions import RenderingUnavailable
from dlo_gym.rod.state import RodState
from dlo_gym.scene.builder import SceneConfig
from dlo_gym.scene.renderer import SceneRenderer
from sim2real.arm import SimulatedArm
from sim2real.cameras.rendered_camera import RenderedCamera
from sim2real.cell import RobotCell
from sim2real.config import TEMPLATES, CellConfig
from sim2real.emulator.held_rod import HeldRod
from sim2real.ur5e.setpoint import SetpointLimits

SIDES = ("left", "right")
# A busy machine draws late; what is tested here is not its speed.
UNHURRIED = {"max_image_age_s": 60.0, "max_pose_age_s": 5.0}


def write_cell(folder, **changes):
    """A cell file of simulated arms and small images; ``changes`` by dotted key with ``__``."""
    document = tomlkit.parse((TEMPLATES / "emulated.toml").read_text())
    del document["truth_url"]
    document["limits"] = dict(UNHURRIED)
    for side in SIDES:
        document["arms"][side]["driver"] = "simulated"
    for camera in document["cameras"].values():
        camera["rate_hz"] = 2.0  # so that views drawn one after the other count as one set
        camera["width_px"], camera["height_px"] = 320, 180
        camera["intrinsics_px"] = [233.3333333, 233.3333333, 159.5, 89.5]
    for key, value in changes.items():
        *sections, last = key.split("__")
        table = document
        for section in sections:
            table = table.setdefault(section, {})
        table[last] = value
    path = folder / "cell.toml"
    path.write_text(tomlkit.dumps(document))
    return path


def make_cell(config: CellConfig, *, moves: bool = True) -> RobotCell:
    """The injected cell.

    Images are drawn when they are asked for, so nothing runs meanwhile; of a cell whose arms never
    move they come by themselves, as they do from real cameras.
    """
    arms = {
        side: SimulatedArm(
            side,
            config.arms[side].home_rad,
            T_flange_tcp=config.arms[side].T_flange_tcp,
            limits=SetpointLimits(period=0.02),
        )
        for side in SIDES
    }
    drawing = threading.Lock()
    rod = HeldRod(config.rod.properties, config.tracker.n_nodes - 1)

    def state() -> RodState:
        # The cameras open before the arms are connected.
        joints = config.dual_arm.home
        if moves and all(arm._connected for arm in arms.values()):
            joints = np.stack([arm.reading().joint_angles for arm in arms.values()])
        with drawing:
            shape = rod.follow(config.dual_arm.forward_kinematics(joints))
        return SimpleNamespace(positions=shape.positions, boundary=shape.boundary)  # type: ignore[return-value]

    scene = SceneConfig(arms=config.dual_arm, n_nodes=config.tracker.n_nodes)
    cameras = {
        model.name: RenderedCamera(
            model, state, scene, rate_hz=None if moves else 10.0, timeout=30.0
        )
        for model in config.camera_models
    }
    return RobotCell(config, arms=arms, cameras=cameras)


def opengl_missing() -> str:
    """Why nothing can be drawn here; empty if it can."""
    try:
        SceneRenderer(SceneConfig()).close()
    except RenderingUnavailable as error:
        return str(error)
    return ""
