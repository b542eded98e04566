"""What stands in a catch scene, as MuJoCo bodies: the UR10 on its stand, the cup at its flange, and the ball."""

# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from torchdyn_plan.envs.catch.ur10 import UR10_LINKS, UR10Link
from torchdyn_plan.envs.servo_arm import add_hinge, add_servos, add_sky

if TYPE_CHECKING:
    from torchdyn_plan.envs.catch.scene import CatchScene

FLOOR, CUP, BALL = 1, 2, 4
"""Kinds of things that can touch one another: the ball touches the others, and nothing else touches anything."""
SILVER, BLUE, GREY = (0.73, 0.75, 0.77, 1.0), (0.33, 0.53, 0.70, 1.0), (0.45, 0.47, 0.50, 1.0)
FELT, FOAM = (0.75, 0.85, 0.10, 1.0), (0.84, 0.38, 0.12, 0.45)
STAVES = 16
"""Boxes of which the cup's wall is made."""
TOOL = "tool"


def add_look(spec: mujoco.MjSpec) -> None:
    """Sky, floor and light."""
    add_sky(spec)
    sun: dict[str, Any] = {"type": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, "castshadow": True}
    spec.worldbody.add_light(pos=[1.5, -1.0, 4.0], dir=[-0.2, 0.15, -1], diffuse=[0.55] * 3, **sun)
    chequered = {"type": mujoco.mjtTexture.mjTEXTURE_2D, "builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER}
    spec.add_texture(name="floor", width=256, height=256, rgb1=[0.80] * 3, rgb2=[0.74] * 3, **chequered)
    floor = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [30, 30, 0.1], "material": "floor"}
    spec.worldbody.add_geom(name="floor", contype=FLOOR, conaffinity=BALL, **plane)


def add_ball(spec: mujoco.MjSpec, scene: CatchScene, drag: float) -> None:
    """A free ball that the air slows down by ``drag`` · ρ A v²: MuJoCo's own fluid model, its other terms left out."""
    body = spec.worldbody.add_body(name="ball", pos=[scene.throw_from, 0.0, scene.throw_low])
    body.add_freejoint(name="ball")
    body.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[scene.ball_radius, 0, 0],
        mass=scene.ball_mass,
        rgba=FELT,
        friction=[0.6, 0.01, 0.001],
        condim=6,
        solref=[scene.softness, 1.0],
        contype=BALL,
        conaffinity=FLOOR | CUP,
        fluid_ellipsoid=1,
        fluid_coefs=[drag, 0.0, 0.0, 0.0, 0.0],
    )


def add_ur10(spec: mujoco.MjSpec, scene: CatchScene) -> None:
    """Six bodies whose joint frames are those of `UR10_LINKS`, with capsules for looks, and the cup."""
    look = {"contype": 0, "conaffinity": 0, "mass": 0.0}
    half = 0.5 * scene.base_height
    stand = {"size": [0.11, half, 0], "pos": [0, 0, half], "rgba": GREY}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, **stand, **look)
    parent, offset = spec.worldbody.add_body(name="base", pos=[0, 0, scene.base_height]), np.eye(4)
    for number, link in enumerate(UR10_LINKS, 1):
        body = parent.add_body(name=f"link{number}", pos=offset[:3, 3], quat=_quaternion(offset), gravcomp=1.0)
        add_hinge(body, f"joint{number}", link)
        offset = link.transform.numpy()
        _add_inertia(body, link, offset)
        for start, end, radius, colour in _SHELLS[number - 1]:
            shape = mujoco.mjtGeom.mjGEOM_CAPSULE
            body.add_geom(type=shape, size=[radius, 0, 0], fromto=[*start, *end], rgba=colour, **look)
        parent = body
    joints = {f"joint{number}": link for number, link in enumerate(UR10_LINKS, 1)}
    add_servos(spec, joints, stiffness=scene.stiffness, damping=scene.damping)
    mouth = offset.copy()
    mouth[:3, 3] += scene.tool_length * mouth[:3, 2]
    _add_cup(parent.add_body(name=TOOL, pos=mouth[:3, 3], quat=_quaternion(mouth), gravcomp=1.0), scene)


def _add_cup(tool: mujoco.MjsBody, scene: CatchScene) -> None:
    """Bottom and wall of boxes, open along z; the frame is in the middle of the mouth."""
    depth, wall, radius = scene.cup_depth, scene.cup_wall, scene.cup_radius
    tool.mass, tool.ipos, tool.explicitinertial = scene.cup_mass, [0, 0, -0.5 * depth], True
    tool.inertia = [scene.cup_mass * (0.5 * radius**2 + depth**2 / 12)] * 2 + [scene.cup_mass * radius**2]
    touch = {"contype": CUP, "conaffinity": BALL, "mass": 0.0, "rgba": FOAM, "solref": [scene.softness, 1.0]}
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    tool.add_geom(type=cylinder, size=[radius + wall, 0.5 * wall, 0], pos=[0, 0, -depth - 0.5 * wall], **touch)
    # Each box is a little wider than its share of the wall: there is no gap between two.
    width = (radius + wall) * math.tan(math.pi / STAVES)
    for number in range(STAVES):
        angle = 2.0 * math.pi * number / STAVES
        across = radius + 0.5 * wall
        tool.add_geom(
            type=box,
            size=[0.5 * wall, width, 0.5 * depth],
            pos=[across * math.cos(angle), across * math.sin(angle), -0.5 * depth],
            quat=[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)],
            **touch,
        )


def _add_inertia(body: mujoco.MjsBody, link: UR10Link, offset: np.ndarray[Any, Any]) -> None:
    """Published mass and centre; the inertia is that of a solid rod of the link's length, or of a short cylinder."""
    radius, length = 0.06 if link.torque > 100 else 0.045, max(abs(link.a), 0.12)
    across, along = link.mass * (3 * radius**2 + length**2) / 12, link.mass * radius**2 / 2
    body.mass, body.explicitinertial = link.mass, True
    body.ipos = offset[:3, :3] @ np.array(link.centre) + offset[:3, 3]
    body.inertia = [along, across, across] if link.a else [across, across, along]


def _quaternion(transform: np.ndarray[Any, Any]) -> list[float]:
    """Unit quaternion wxyz of a rotation about x, the only kind that stands between DH joints."""
    angle = math.atan2(transform[2, 1], transform[1, 1])
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]


_SHELLS = (
    (((0, 0, -0.10), (0, 0, 0.02), 0.075, SILVER), ((0, 0.02, 0.1273), (0, -0.08, 0.1273), 0.072, SILVER)),
    (
        ((0, 0, 0.12), (0, 0, 0.23), 0.072, SILVER),
        ((0, 0, 0.176), (-0.612, 0, 0.176), 0.058, SILVER),
        ((-0.612, 0, 0.10), (-0.612, 0, 0.23), 0.062, BLUE),
    ),
    (
        ((0, 0, -0.03), (0, 0, 0.07), 0.058, SILVER),
        ((0, 0, 0.04), (-0.5723, 0, 0.04), 0.046, SILVER),
        ((-0.5723, 0, 0.0), (-0.5723, 0, 0.08), 0.047, BLUE),
    ),
    (((0, 0, 0.09), (0, 0, 0.17), 0.044, SILVER), ((0, -0.05, 0.164), (0, 0.05, 0.164), 0.043, SILVER)),
    (((0, 0, 0.04), (0, 0, 0.12), 0.044, SILVER), ((0, 0.05, 0.1157), (0, -0.04, 0.1157), 0.043, SILVER)),
    (((0, 0, 0.04), (0, 0, 0.075), 0.043, GREY),),
)
"""Capsules of each link in its joint's frame: start, end and radius [m], and colour."""
