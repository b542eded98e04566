"""MuJoCo bodies of a conveyor scene: belt, parts, and the Panda with its suction cups."""

# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchdyn_plan.envs.conveyor.panda import PANDA_FLANGE, PANDA_LINKS, TOOL_TURN
from torchdyn_plan.envs.servo_arm import add_hinge, add_servos, add_sky

if TYPE_CHECKING:
    from torchdyn_plan.envs.conveyor.scene import ConveyorScene

BELT_LENGTH = 20.0
"""Long enough for parts to start as far upstream as their feed times require [m]."""
BELT, PART = 1, 2
"""Collision groups."""
WHITE, GREY, DARK = (0.93, 0.93, 0.94, 1.0), (0.55, 0.57, 0.60, 1.0), (0.18, 0.19, 0.21, 1.0)
COLOURS = ((0.84, 0.38, 0.12, 1.0), (0.12, 0.47, 0.71, 1.0), (0.20, 0.60, 0.30, 1.0), (0.75, 0.60, 0.10, 1.0))
TOOL = "tool"


def add_look(spec: mujoco.MjSpec) -> None:
    """Sky, floor and light."""
    add_sky(spec)
    spec.worldbody.add_light(
        pos=[0.8, -0.4, 2.5],
        dir=[-0.2, 0.15, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.55] * 3,
        castshadow=True,
    )
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(type=plane, size=[30, 30, 0.1], rgba=[0.80, 0.81, 0.80, 1], contype=BELT, conaffinity=PART)


def add_belt(spec: mujoco.MjSpec, scene: ConveyorScene, speed: float) -> None:
    """A long box whose surface moves along y, with fixed stripes next to it."""
    box, half = mujoco.mjtGeom.mjGEOM_BOX, 0.5 * scene.belt_height
    spec.worldbody.add_geom(
        name="belt",
        type=box,
        size=[scene.belt_half_width, BELT_LENGTH, half],
        pos=[scene.belt_x, 0, half],
        surfacevel=[0, speed, 0, 0, 0, 0],
        friction=[1.0, 0.005, 0.0001],
        rgba=DARK,
        contype=BELT,
        conaffinity=PART,
    )
    for side in (-1, 1):
        place = [scene.belt_x + side * (scene.belt_half_width + 0.012), 0, half + 0.004]
        spec.worldbody.add_geom(
            type=box, size=[0.012, BELT_LENGTH, half + 0.004], pos=place, rgba=GREY, contype=0, conaffinity=0
        )


def add_parts(spec: mujoco.MjSpec, scene: ConveyorScene, count: int) -> None:
    """``count`` boxes, each with an inactive weld to the tool."""
    size = np.array(scene.part_size)
    for number in range(count):
        body = spec.worldbody.add_body(name=f"part{number}", pos=[scene.belt_x, -1.0 - number, scene.top])
        body.add_freejoint(name=f"part{number}")
        colour = COLOURS[number % len(COLOURS)]
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size / 2,
            mass=scene.part_mass,
            rgba=colour,
            contype=PART,
            conaffinity=BELT,
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[size[0] / 8, size[1] / 2 - 0.004, 0.0005],
            pos=[size[0] / 4, 0, size[2] / 2],
            rgba=WHITE,
            mass=0.0,
            contype=0,
            conaffinity=0,
        )
        weld = spec.add_equality(name=f"weld{number}", type=mujoco.mjtEq.mjEQ_WELD, active=False)
        weld.objtype = mujoco.mjtObj.mjOBJ_BODY
        weld.name1, weld.name2 = TOOL, f"part{number}"


def add_panda(spec: mujoco.MjSpec, scene: ConveyorScene) -> None:
    """Seven bodies with the joint frames of `PANDA_LINKS`, visual capsules, and the tool."""
    capsule, cylinder = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    look = {"contype": 0, "conaffinity": 0, "mass": 0.0}
    parent = spec.worldbody
    parent.add_geom(type=cylinder, size=[0.08, 0.07, 0], pos=[0, 0, 0.07], rgba=WHITE, **look)
    for number, link in enumerate(PANDA_LINKS, 1):
        offset = link.offset.numpy()
        turn = [math.cos(link.alpha / 2), math.sin(link.alpha / 2), 0.0, 0.0]
        body = parent.add_body(name=f"link{number}", pos=offset[:3, 3], quat=turn, gravcomp=1.0)
        add_hinge(body, f"panda_joint{number}", link)
        body.mass, body.ipos, body.explicitinertial = link.mass, [0, 0, 0], True
        body.inertia = [0.004 * link.mass] * 3
        for start, end, radius, colour in _SHELLS[number - 1]:
            body.add_geom(type=capsule, size=[radius, 0, 0], fromto=[*start, *end], rgba=colour, **look)
        parent = body
    joints = {f"panda_joint{number}": link for number, link in enumerate(PANDA_LINKS, 1)}
    add_servos(spec, joints, stiffness=scene.stiffness, damping=scene.damping)
    half = TOOL_TURN / 2
    tool = parent.add_body(
        name=TOOL,
        pos=[0, 0, PANDA_FLANGE + scene.tool_length],
        quat=[math.cos(half), 0, 0, math.sin(half)],
        gravcomp=1.0,
    )
    tool.mass, tool.ipos, tool.inertia, tool.explicitinertial = 0.4, [0, 0, -0.05], [4e-4] * 3, True
    length = scene.tool_length
    tool.add_geom(type=cylinder, size=[0.032, 0.012, 0], pos=[0, 0, 0.012 - length], rgba=GREY, **look)
    tool.add_geom(type=cylinder, size=[0.012, 0.5 * length - 0.02, 0], pos=[0, 0, -0.5 * length], rgba=GREY, **look)
    tool.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.036, 0.012, 0.006], pos=[0, 0, -0.022], rgba=GREY, **look)
    for side in (-1, 1):
        tool.add_geom(type=cylinder, size=[0.011, 0.009, 0], pos=[0.024 * side, 0, -0.009], rgba=DARK, **look)


_SHELLS = (
    (((0, 0, -0.192), (0, 0, 0), 0.062, WHITE),),
    (((0, -0.02, 0), (0, -0.17, 0), 0.062, WHITE), ((0, 0, -0.06), (0, 0, 0.06), 0.060, WHITE)),
    (((0, 0, -0.14), (0, 0, -0.02), 0.060, WHITE), ((0, 0, -0.02), (0.0825, 0, 0), 0.052, WHITE)),
    (((-0.0825, 0, 0), (-0.0825, 0.12, 0), 0.055, WHITE), ((0, 0, -0.05), (0, 0, 0.05), 0.055, WHITE)),
    (((0, 0, -0.26), (0, 0.03, -0.06), 0.052, WHITE), ((0, 0.02, -0.06), (0, 0, 0), 0.050, WHITE)),
    (((0, 0, -0.03), (0.088, 0, 0), 0.045, WHITE), ((0, 0, -0.04), (0, 0, 0.03), 0.047, WHITE)),
    (((0, 0, 0.0), (0, 0, 0.08), 0.040, WHITE), ((0, 0, 0.085), (0, 0, 0.10), 0.032, DARK)),
)
"""Capsules of each link in its joint's frame: start, end and radius [m], and colour."""
