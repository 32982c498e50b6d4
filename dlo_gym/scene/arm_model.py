"""What a UR5e with a two-finger gripper looks like, in primitives."""

# MuJoCo ships no type information.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from dlo_gym.geometry.se3 import Array, exp_so3, matrix_to_quaternion
from dlo_gym.scene.arms import TCP_DISTANCE
from dlo_gym.scene.ur5e import DH_A, DH_ALPHA, DH_D, JOINT_LIMIT

# name: (rgb, specular, shininess)
MATERIALS = {
    "aluminium": ((0.76, 0.77, 0.79), 0.45, 0.5),
    "housing": ((0.66, 0.68, 0.71), 0.5, 0.55),
    "ring": ((0.16, 0.17, 0.18), 0.3, 0.3),
    "cap": ((0.27, 0.55, 0.78), 0.5, 0.6),
    "gripper": ((0.12, 0.12, 0.135), 0.5, 0.5),
    "gripper_metal": ((0.46, 0.47, 0.49), 0.7, 0.7),
    "pad": ((0.20, 0.20, 0.21), 0.1, 0.1),
}

# Cylinders of each link in its DH frame: frame, from, to [m], radius [m], material.
CYLINDERS = (
    (0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.022), 0.0745, "ring"),
    (0, (0.0, 0.0, 0.022), (0.0, 0.0, 0.078), 0.064, "aluminium"),
    (0, (0.0, 0.0, 0.078), (0.0, 0.0, 0.086), 0.062, "ring"),
    # shoulder: y up, z along the second joint's axis
    (1, (0.0, -0.0765, 0.0), (0.0, 0.060, 0.0), 0.060, "housing"),
    (1, (0.0, 0.060, 0.0), (0.0, 0.071, 0.0), 0.058, "cap"),
    (1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.066), 0.0585, "housing"),
    (1, (0.0, 0.0, 0.066), (0.0, 0.0, 0.074), 0.058, "ring"),
    # upper arm
    (2, (0.425, 0.0, 0.074), (0.425, 0.0, 0.184), 0.060, "housing"),
    (2, (0.425, 0.0, 0.184), (0.425, 0.0, 0.198), 0.058, "cap"),
    (2, (0.425, 0.0, 0.138), (0.345, 0.0, 0.138), 0.055, "housing"),
    (2, (0.345, 0.0, 0.138), (0.337, 0.0, 0.138), 0.0535, "ring"),
    (2, (0.337, 0.0, 0.138), (0.085, 0.0, 0.138), 0.0495, "aluminium"),
    (2, (0.085, 0.0, 0.138), (0.077, 0.0, 0.138), 0.0535, "ring"),
    (2, (0.077, 0.0, 0.138), (0.0, 0.0, 0.138), 0.055, "housing"),
    (2, (0.0, 0.0, 0.070), (0.0, 0.0, 0.182), 0.057, "housing"),
    (2, (0.0, 0.0, 0.182), (0.0, 0.0, 0.196), 0.055, "cap"),
    # forearm
    (3, (0.3922, 0.0, 0.062), (0.3922, 0.0, 0.070), 0.055, "ring"),
    (3, (0.3922, 0.0, -0.040), (0.3922, 0.0, 0.062), 0.056, "housing"),
    (3, (0.3922, 0.0, -0.052), (0.3922, 0.0, -0.040), 0.054, "cap"),
    (3, (0.3922, 0.0, 0.007), (0.315, 0.0, 0.007), 0.0475, "housing"),
    (3, (0.315, 0.0, 0.007), (0.308, 0.0, 0.007), 0.046, "ring"),
    (3, (0.308, 0.0, 0.007), (0.065, 0.0, 0.007), 0.0400, "aluminium"),
    (3, (0.065, 0.0, 0.007), (0.059, 0.0, 0.007), 0.042, "ring"),
    (3, (0.059, 0.0, 0.007), (0.0, 0.0, 0.007), 0.0405, "housing"),
    (3, (0.0, 0.0, -0.038), (0.0, 0.0, 0.053), 0.043, "housing"),
    (3, (0.0, 0.0, -0.048), (0.0, 0.0, -0.038), 0.0415, "cap"),
    # wrist 1: y along its joint's axis, z along the next
    (4, (0.0, -0.080, 0.0), (0.0, -0.073, 0.0), 0.042, "ring"),
    (4, (0.0, -0.073, 0.0), (0.0, 0.036, 0.0), 0.043, "housing"),
    (4, (0.0, 0.036, 0.0), (0.0, 0.046, 0.0), 0.0415, "cap"),
    (4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.047), 0.0425, "housing"),
    (4, (0.0, 0.0, 0.047), (0.0, 0.0, 0.053), 0.042, "ring"),
    # wrist 2
    (5, (0.0, 0.0467, 0.0), (0.0, -0.036, 0.0), 0.043, "housing"),
    (5, (0.0, -0.036, 0.0), (0.0, -0.046, 0.0), 0.0415, "cap"),
    (5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.046), 0.0425, "housing"),
    (5, (0.0, 0.0, 0.046), (0.0, 0.0, 0.052), 0.042, "ring"),
    # wrist 3 and the gripper's coupling and palm
    (6, (0.0, 0.0, -0.0476), (0.0, 0.0, -0.008), 0.0405, "housing"),
    (6, (0.0, 0.0, -0.008), (0.0, 0.0, 0.0), 0.0375, "aluminium"),
    (6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.014), 0.0375, "gripper_metal"),
    (6, (0.0, 0.0, 0.014), (0.0, 0.0, 0.05), 0.0365, "gripper"),
)

# Boxes of the gripper in the flange frame: centre, half size [m], angle about y [rad], material.
# Fingers close along x; the second finger is the first one's mirror image.
_PALM = ((0.0, 0.0, 0.066), (0.046, 0.026, 0.024), 0.0, "gripper")
_PALM_STRIPE = ((0.0, 0.0, 0.076), (0.0468, 0.0268, 0.0025), 0.0, "gripper_metal")
_FINGER = (
    ((0.0395, 0.0, 0.101), (0.0075, 0.016, 0.021), -0.35, "gripper_metal"),
    ((0.0205, 0.0, 0.121), (0.0085, 0.0115, 0.017), -0.55, "gripper"),
)
FINGERTIP_LENGTH = 0.04
_PAD_THICKNESS = 0.0035
_FINGERTIP_THICKNESS = 0.009
_TIP_BEHIND_TCP = 0.002


def add_materials(spec: mujoco.MjSpec) -> None:
    for name, (rgb, specular, shininess) in MATERIALS.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=specular, shininess=shininess)


def add_arm(spec: mujoco.MjSpec, side: str, T_world_base: Array, rod_radius: float) -> None:
    """Adds one arm with its gripper closed on a rod; bodies are named ``<side>_link_<frame>``."""
    body = spec.worldbody.add_body(
        name=f"{side}_link_0",
        pos=T_world_base[:3, 3],
        quat=matrix_to_quaternion(T_world_base[:3, :3]),
    )
    links = [body]
    for i in range(6):
        R_parent_link = exp_so3([DH_ALPHA[i], 0.0, 0.0])
        offset = np.array([DH_A[i], 0.0, DH_D[i]])
        body = body.add_body(
            name=f"{side}_link_{i + 1}", pos=offset, quat=matrix_to_quaternion(R_parent_link)
        )
        # The joint turns the link about the previous DH frame's z axis.
        body.add_joint(
            name=f"{side}_joint_{i + 1}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            pos=-R_parent_link.T @ offset,
            axis=R_parent_link[2],
            range=[-JOINT_LIMIT, JOINT_LIMIT],
        )
        links.append(body)
    for frame, start, end, radius, material in CYLINDERS:
        links[frame].add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=[*start, *end],
            size=[radius, 0.0, 0.0],
            material=material,
        )
    _add_gripper(links[6], rod_radius)
    # Group 4 is not drawn.
    links[6].add_site(name=f"{side}_tcp", pos=[0.0, 0.0, TCP_DISTANCE], group=4)


def _add_gripper(flange: mujoco.MjsBody, rod_radius: float) -> None:
    tip_middle = TCP_DISTANCE - _TIP_BEHIND_TCP - FINGERTIP_LENGTH / 2
    pad_centre = rod_radius + _PAD_THICKNESS / 2
    tip_centre = rod_radius + _PAD_THICKNESS + _FINGERTIP_THICKNESS / 2
    fingertip = (
        (
            (pad_centre, 0.0, tip_middle + FINGERTIP_LENGTH / 8),
            (_PAD_THICKNESS / 2, 0.009, FINGERTIP_LENGTH * 3 / 8),
            0.0,
            "pad",
        ),
        (
            (tip_centre, 0.0, tip_middle),
            (_FINGERTIP_THICKNESS / 2, 0.011, FINGERTIP_LENGTH / 2),
            0.0,
            "gripper",
        ),
    )
    # The pads' groove ends where the rod does.
    shorter = rod_radius - _TIP_BEHIND_TCP
    groove = (rod_radius, 0.008, (FINGERTIP_LENGTH - shorter) / 2)
    _add_box(flange, (0.0, 0.0, tip_middle - shorter / 2), groove, 0.0, "pad")
    _add_box(flange, *_PALM)
    _add_box(flange, *_PALM_STRIPE)
    for (x, y, z), half_size, angle, material in (*_FINGER, *fingertip):
        for sign in (1.0, -1.0):
            _add_box(flange, (sign * x, y, z), half_size, sign * angle, material)


def _add_box(body: mujoco.MjsBody, centre, half_size, angle: float, material: str) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=centre,
        size=half_size,
        quat=[np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0],
        material=material,
    )
