# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""The UR5 as MuJoCo bodies, made from the same table as its kinematic chain."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from torchdyn_plan.kinematics.ur5 import UR5_LINKS, Link, link_transform

SILVER = (0.73, 0.75, 0.77, 1.0)
BLUE = (0.33, 0.53, 0.70, 1.0)
ARMATURE = 0.1
"""Inertia of a motor behind its gear [kg·m²], as in MuJoCo Menagerie's UR models."""


@dataclass(frozen=True)
class Shell:
    """A cylinder (or, for tubes, a capsule that can touch things) of a link, in the link's joint frame [m]."""

    radius: float
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    colour: tuple[float, float, float, float] = SILVER
    tube: bool = False


_SHELLS: dict[str, tuple[Shell, ...]] = {
    "shoulder": (
        Shell(0.060, (0.0, 0.0, 0.0), (0.0, 0.0, 0.150)),
        Shell(0.059, (0.0, -0.075, 0.089), (0.0, 0.062, 0.089)),
        Shell(0.056, (0.0, 0.062, 0.089), (0.0, 0.074, 0.089), BLUE),
    ),
    "upper_arm": (
        Shell(0.058, (0.0, 0.0, 0.075), (0.0, 0.0, 0.190)),
        Shell(0.055, (0.0, 0.0, 0.190), (0.0, 0.0, 0.203), BLUE),
        Shell(0.044, (0.0, 0.0, 0.136), (-0.425, 0.0, 0.136), tube=True),
        Shell(0.050, (-0.425, 0.0, 0.072), (-0.425, 0.0, 0.188)),
        Shell(0.047, (-0.425, 0.0, 0.188), (-0.425, 0.0, 0.200), BLUE),
    ),
    "forearm": (
        Shell(0.048, (0.0, 0.0, -0.032), (0.0, 0.0, 0.074)),
        Shell(0.045, (0.0, 0.0, -0.044), (0.0, 0.0, -0.032), BLUE),
        Shell(0.036, (0.0, 0.0, 0.0165), (-0.39225, 0.0, 0.0165), tube=True),
        Shell(0.038, (-0.39225, 0.0, -0.025), (-0.39225, 0.0, 0.058)),
        Shell(0.035, (-0.39225, 0.0, -0.036), (-0.39225, 0.0, -0.025), BLUE),
    ),
    "wrist_1": (
        Shell(0.038, (0.0, 0.0, 0.058), (0.0, 0.0, 0.109)),
        Shell(0.036, (0.0, -0.040, 0.109), (0.0, 0.050, 0.109), tube=True),
        Shell(0.035, (0.0, 0.084, 0.109), (0.0, 0.092, 0.109), BLUE),
    ),
    "wrist_2": (
        Shell(0.036, (0.0, 0.0, 0.040), (0.0, 0.0, 0.0947), tube=True),
        Shell(0.038, (0.0, 0.040, 0.0947), (0.0, -0.040, 0.0947)),
        Shell(0.035, (0.0, 0.040, 0.0947), (0.0, 0.051, 0.0947), BLUE),
    ),
    "wrist_3": (Shell(0.036, (0.0, 0.0, 0.045), (0.0, 0.0, 0.0823)),),
}


def add_ur5(base: mujoco.MjsBody, *, contype: int, conaffinity: int) -> mujoco.MjsBody:
    """Hang the UR5's six bodies below ``base`` and return a body fixed to its flange (z axis out of the flange).

    Joint frames coincide with those of `ur5_urdf`. Tubes can touch the scene; masses come from the table alone.
    """
    parent, offset = base, np.eye(4)
    for link in UR5_LINKS:
        body = parent.add_body(name=link.name, pos=offset[:3, 3], quat=_quaternion(offset), gravcomp=1.0)
        body.add_joint(
            name=link.joint,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            range=link.range,
            limited=True,
            armature=ARMATURE,
            actfrclimited=True,
            actfrcrange=[-link.torque_limit, link.torque_limit],
            actgravcomp=True,
        )
        offset = link_transform(link).numpy()
        _add_inertia(body, link, offset)
        for shell in _SHELLS[link.name]:
            shape = mujoco.mjtGeom.mjGEOM_CAPSULE if shell.tube else mujoco.mjtGeom.mjGEOM_CYLINDER
            body.add_geom(
                type=shape,
                size=[shell.radius, 0, 0],
                fromto=[*shell.start, *shell.end],
                rgba=shell.colour,
                mass=0.0,
                contype=contype if shell.tube else 0,
                conaffinity=conaffinity if shell.tube else 0,
            )
        parent = body
    return parent.add_body(name="flange", pos=offset[:3, 3], quat=_quaternion(offset), gravcomp=1.0)


def _add_inertia(body: mujoco.MjsBody, link: Link, offset: np.ndarray) -> None:
    """Mass, centre and inertia: a solid rod of the link's length where it has one, else a short cylinder."""
    radius = 0.06 if link.torque_limit > 100 else 0.04
    length = max(abs(link.a), 0.1)
    across, along = link.mass * (3 * radius**2 + length**2) / 12, link.mass * radius**2 / 2
    body.mass = link.mass
    body.ipos = offset[:3, :3] @ np.array(link.centre_of_mass) + offset[:3, 3]
    body.inertia = [along, across, across] if link.a else [across, across, along]
    body.explicitinertial = True


def _quaternion(transform: np.ndarray) -> list[float]:
    """Unit quaternion wxyz of a rotation about x, the only kind that stands between DH joints."""
    angle = math.atan2(transform[2, 1], transform[1, 1])
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]
