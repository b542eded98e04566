# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""What stands in a Trapper scene, as MuJoCo bodies: table, ball, and the arm with its box."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchdyn_plan.envs.trapper.textures import felt, wood
from torchdyn_plan.envs.trapper.ur5_bodies import add_ur5
from torchdyn_plan.kinematics.ur5 import UR5_LINKS

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene

WORLD_BIT, BALL_BIT, ARM_BIT = 1, 2, 4
"""Kinds of bodies that can touch one another."""


def add_look(spec: mujoco.MjSpec) -> None:
    """Materials, sky and light."""
    for name, image in (("wood", wood()), ("felt", felt())):
        spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=image.shape[1],
            height=image.shape[0],
            nchannel=3,
            data=image.ravel().tolist(),
        )
        material = spec.add_material(name=name, specular=0.2 if name == "wood" else 0.0, shininess=0.3)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.texrepeat = [1, 1] if name == "wood" else [3, 3]
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=256)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.88, 0.90, 0.93], [0.55, 0.58, 0.62]
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    visual.headlight.ambient, visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
    spec.worldbody.add_light(
        pos=[0.6, -0.4, 2.5],
        dir=[-0.2, 0.15, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.6] * 3,
        specular=[0.2] * 3,
        castshadow=True,
    )


def add_table(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    """Slab, twelve rail segments and the pockets between them: a gap in the rails above nothing."""
    world, half, box = spec.worldbody, scene.half_side, mujoco.mjtGeom.mjGEOM_BOX
    fixed = {"contype": WORLD_BIT, "conaffinity": BALL_BIT | ARM_BIT}
    world.add_geom(name="cloth", type=box, size=[half, half, 0.03], pos=[0, 0, -0.03], material="felt", **fixed)
    for wall in range(4):
        turn = np.array([[0, 1], [-1, 0]]) if wall % 2 else np.eye(2)
        outward = turn @ [0.0, 1.0 if wall < 2 else -1.0]
        _add_rails(world, scene, turn, outward, fixed, corner=scene.rail_width if wall % 2 == 0 else 0.0)
        _add_pockets(world, scene, turn, outward, fixed)
    size = half + scene.rail_width
    world.add_geom(
        type=box, size=[size, size, 0.02], pos=[0, 0, -0.22], rgba=[0.08, 0.06, 0.05, 1], contype=0, conaffinity=0
    )


def _add_rails(
    world: mujoco.MjsBody,
    scene: TrapperScene,
    turn: np.ndarray,
    outward: np.ndarray,
    fixed: dict[str, int],
    *,
    corner: float,
) -> None:
    """One wall's rail segments; ``turn`` (2, 2) turns the x axis along the wall, ``outward`` (2,) is its normal."""
    for low, high in _segments(scene, corner=corner):
        middle = turn @ [(low + high) / 2, 0.0] + outward * (scene.half_side + scene.rail_width / 2)
        extent = np.abs(turn @ [(high - low) / 2, scene.rail_width / 2])
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[*extent, scene.rail_height / 2 + 0.03],
            pos=[*middle, scene.rail_height / 2 - 0.03],
            material="wood",
            condim=1,
            priority=3,
            # Soft at first touch: a full spring at once, met between two steps, would give energy to a ball.
            solref=[-scene.cushion_stiffness, -scene.cushion_damping],
            solimp=[0.1, 0.99, scene.cushion_nose, 0.5, 1],
            **fixed,
        )


def _add_pockets(
    world: mujoco.MjsBody, scene: TrapperScene, turn: np.ndarray, outward: np.ndarray, fixed: dict[str, int]
) -> None:
    """The backs of one wall's pockets; arguments as of `_add_rails`."""
    for side in (-1, 1):
        middle = turn @ [side * scene.pocket_offset, 0.0] + outward * (scene.half_side + scene.rail_width)
        extent = np.abs(turn @ [scene.pocket_gap / 2, 0.005])
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[*extent, scene.rail_height / 2 + 0.05],
            pos=[*middle, scene.rail_height / 2 - 0.05],
            rgba=[0.05, 0.05, 0.05, 1],
            **fixed,
        )


def _segments(scene: TrapperScene, *, corner: float) -> tuple[tuple[float, float], ...]:
    """A wall's three rail segments between its two pockets; ``corner`` is how far the outer ones reach past it."""
    inner, outer = scene.pocket_offset - scene.pocket_gap / 2, scene.pocket_offset + scene.pocket_gap / 2
    end = scene.half_side + corner
    return ((-end, -outer), (-inner, inner), (outer, end))


def add_ball(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    """The ball, free to roll."""
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, scene.ball_radius])
    ball.add_joint(name="ball", type=mujoco.mjtJoint.mjJNT_FREE)
    # A contact as soft as the default: a stiffer one throws a sliding ball up (MuJoCo's convex friction dilates).
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[scene.ball_radius, 0, 0],
        mass=scene.ball_mass,
        rgba=[0.25, 0.26, 0.28, 1],
        condim=6,
        friction=[scene.cloth_friction, 0.0, scene.rolling_resistance],
        priority=1,
        contype=BALL_BIT,
        conaffinity=WORLD_BIT | ARM_BIT,
    )


def add_arm(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    """The UR5 with its servos, the box at its flange."""
    touching = {"contype": ARM_BIT, "conaffinity": WORLD_BIT | BALL_BIT}
    base = spec.worldbody.add_body(name="base", pos=scene.base_pos)
    base.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.075, 0.02, 0],
        pos=[0, 0, 0.02],
        rgba=[0.7, 0.72, 0.74, 1],
        contype=0,
        conaffinity=0,
    )
    flange = add_ur5(base, **touching)
    _add_box(flange, scene, touching)
    flange.add_site(name="tool", pos=[0, 0, scene.tool_length])
    for link, stiffness, damping in zip(UR5_LINKS, scene.servo_stiffness, scene.servo_damping, strict=True):
        actuator = spec.add_actuator(name=link.joint, target=link.joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = stiffness
        actuator.biasprm[:3] = [0.0, -stiffness, -damping]
        actuator.forcelimited, actuator.forcerange = True, [-link.torque_limit, link.torque_limit]


def _add_box(flange: mujoco.MjsBody, scene: TrapperScene, touching: dict[str, int]) -> None:
    """Open box, mouth along the flange's +z: a lid and four thin walls."""
    outer, wall, depth = scene.box_outer, scene.box_wall, scene.box_depth
    middle, offset = wall + depth / 2, scene.box_half_width + wall / 2
    lid = ([outer, outer, wall / 2], [0, 0, wall / 2])
    sides = [([wall / 2, outer, depth / 2], [s * offset, 0, middle]) for s in (-1, 1)]
    sides += [([scene.box_half_width, wall / 2, depth / 2], [0, s * offset, middle]) for s in (-1, 1)]
    volume = [8 * np.prod(size) for size, _ in (lid, *sides)]
    for (size, pos), part in zip((lid, *sides), volume, strict=True):
        flange.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=pos,
            rgba=[0.95, 0.95, 0.92, 0.75],
            mass=scene.box_mass * part / sum(volume),
            friction=[0.3, 0, 0],
            solref=[0.006, 1.0],
            priority=2,
            **touching,
        )
