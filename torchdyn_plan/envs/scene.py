# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""The Trapper scene: a UR5 with a box, a billiard table with eight pockets, and a ball, from one frozen dataclass."""

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass

import mujoco
import numpy as np

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.textures import felt, wood
from torchdyn_plan.envs.ur5_bodies import add_ur5
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.ur5 import UR5_LINKS

WORLD_BIT, BALL_BIT, ARM_BIT = 1, 2, 4
GRAVITY = 9.81
"""[m/s²]"""


@dataclass(frozen=True, kw_only=True)
class TrapperScene:
    """Geometry and physics of Trapper. Frame: z up, table surface at z = 0, table centre at the origin, arm at -y."""

    table_side: float = 1.59
    """Side of the square playing area, from cushion to cushion [m]."""
    rail_width: float = 0.12
    """[m]"""
    rail_height: float = 0.05
    """[m]"""
    pocket_gap: float = 0.22
    """Free width of a pocket between two rail segments [m]."""
    pocket_offset: float = 0.42
    """Distance of a pocket's middle from the middle of its wall [m]."""
    ball_radius: float = 0.042
    """[m]"""
    ball_mass: float = 6.0
    """[kg]"""
    rolling_resistance: float = 0.0001
    """Lever arm of the cloth's resistance to rolling [m]; deceleration is 5/7·g·lever/radius."""
    cloth_friction: float = 0.05
    """Sliding friction coefficient of ball on cloth."""
    cushion_stiffness: float = 70000.0
    """Stiffness of a cushion per effective mass, once pressed in by `cushion_nose` [1/s²]."""
    cushion_damping: float = 16.0
    """Damping of a cushion per effective mass, once pressed in by `cushion_nose` [1/s]."""
    cushion_nose: float = 0.02
    """Depth over which a cushion stiffens from the soft first touch [m]."""
    box_half_width: float = 0.065
    """Inner half-width of the box [m]."""
    box_wall: float = 0.004
    """[m]"""
    box_depth: float = 0.08
    """Inner depth of the box [m]."""
    box_mass: float = 0.25
    """[kg]"""
    base_setback: float = 0.06
    """Distance of the arm's base axis behind the cushion line [m]."""
    base_height: float = 0.05
    """Height of the arm's base above the table [m]."""
    home: tuple[float, float, float, float, float, float] = (-1.7537, -1.1269, 1.7746, -2.2185, -1.5708, -0.1829)
    """Initial joint angles [rad]."""
    servo_stiffness: tuple[float, ...] = (8000.0, 8000.0, 6000.0, 1200.0, 1200.0, 1200.0)
    """Position gain of each joint [N·m/rad]."""
    servo_damping: tuple[float, ...] = (400.0, 400.0, 300.0, 60.0, 60.0, 60.0)
    """Speed gain of each joint [N·m·s/rad]."""
    acceleration_limit: float = 75.0
    """Greatest change of a commanded joint speed [rad/s²]."""
    servo_speed: float = 0.95
    """Greatest speed that a servo strives for, as a share of the joint's limit; the other joints add to it."""
    substep: float = 0.002
    """Physics step [s]."""
    control_step: float = 0.004
    """[s]"""

    def __post_init__(self) -> None:
        lowest = {"base_height": -math.inf, "home": -math.inf, "rolling_resistance": 0.0}
        for field in dataclasses.fields(self):
            value, minimum = getattr(self, field.name), lowest.get(field.name, 1e-9)
            if not isinstance(field.default, tuple):
                check_number(field.name, value, minimum=minimum)
                continue
            if not isinstance(value, tuple) or len(value) != len(UR5_LINKS):
                raise InputError(f"{field.name} must be a tuple of {len(UR5_LINKS)} numbers, got {value!r}")
            for number in value:
                check_number(field.name, number, minimum=minimum)

    @property
    def half_side(self) -> float:
        """Half of the playing area's side [m]."""
        return self.table_side / 2

    @property
    def box_outer(self) -> float:
        """Outer half-width of the box [m]."""
        return self.box_half_width + self.box_wall

    @property
    def tool_length(self) -> float:
        """Distance of the box mouth from the arm's flange [m]."""
        return self.box_depth + self.box_wall

    @property
    def base_pos(self) -> tuple[float, float, float]:
        """Position of the arm's base frame, whose axes are the world's [m]."""
        return (0.0, -self.half_side - self.base_setback, self.base_height)

    def digest(self) -> str:
        """Hash of every number above: two scenes with one digest are one scene."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def spec(self, *, arm: bool = True) -> mujoco.MjSpec:
        """MuJoCo description of the scene; without ``arm`` the ball rolls alone (same ball physics, much cheaper)."""
        spec = mujoco.MjSpec()
        spec.modelname = "trapper"
        spec.compiler.degree = False
        option = spec.option
        option.timestep, option.gravity = self.substep, [0, 0, -GRAVITY]
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        _add_look(spec)
        _add_table(spec, self)
        _add_ball(spec, self)
        if arm:
            _add_arm(spec, self)
        return spec

    def compile(self, *, arm: bool = True, friction: float = 0.0) -> mujoco.MjModel:
        """Compiled model; ``friction`` is the friction loss on the ball's horizontal translation [N]."""
        check_number("friction", friction, minimum=0.0)
        model = self.spec(arm=arm).compile()
        first = int(model.jnt_dofadr[model.joint("ball").id])
        model.dof_frictionloss[first : first + 2] = friction
        return model


def _add_look(spec: mujoco.MjSpec) -> None:
    for name, image in (("wood", wood()), ("felt", felt())):
        spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=image.shape[1], height=image.shape[0],
            nchannel=3, data=image.ravel().tolist(),
        )  # fmt: skip
        material = spec.add_material(name=name, specular=0.2 if name == "wood" else 0.0, shininess=0.3)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.texrepeat = [1, 1] if name == "wood" else [3, 3]
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=256)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.88, 0.90, 0.93], [0.55, 0.58, 0.62]
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    visual.headlight.ambient, visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
    spec.worldbody.add_light(
        pos=[0.6, -0.4, 2.5], dir=[-0.2, 0.15, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.6] * 3, specular=[0.2] * 3, castshadow=True,
    )  # fmt: skip


def _add_table(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    """Slab, twelve rail segments and the pockets between them: a gap in the rails above nothing."""
    world, half, box = spec.worldbody, scene.half_side, mujoco.mjtGeom.mjGEOM_BOX
    fixed = {"contype": WORLD_BIT, "conaffinity": BALL_BIT | ARM_BIT}
    world.add_geom(
        name="cloth", type=box, size=[half, half, 0.03], pos=[0, 0, -0.03], material="felt", **fixed,
    )  # fmt: skip
    for wall in range(4):
        turn = np.array([[0, 1], [-1, 0]]) if wall % 2 else np.eye(2)
        sign = 1 if wall < 2 else -1
        for low, high in _segments(scene, corner=scene.rail_width if wall % 2 == 0 else 0.0):
            middle = turn @ [(low + high) / 2, 0.0] + sign * (turn @ [0.0, half + scene.rail_width / 2])
            extent = np.abs(turn @ [(high - low) / 2, scene.rail_width / 2])
            world.add_geom(
                type=box, size=[*extent, scene.rail_height / 2 + 0.03],
                pos=[*middle, scene.rail_height / 2 - 0.03], material="wood", condim=1, priority=3,
                # Soft at first touch: a full spring at once, met between two steps, would give energy to a ball.
                solref=[-scene.cushion_stiffness, -scene.cushion_damping],
                solimp=[0.1, 0.99, scene.cushion_nose, 0.5, 1],
                **fixed,
            )  # fmt: skip
        for side in (-1, 1):
            middle = turn @ [side * scene.pocket_offset, 0.0] + sign * (turn @ [0.0, half + scene.rail_width])
            extent = np.abs(turn @ [scene.pocket_gap / 2, 0.005])
            world.add_geom(
                type=box, size=[*extent, scene.rail_height / 2 + 0.05],
                pos=[*middle, scene.rail_height / 2 - 0.05], rgba=[0.05, 0.05, 0.05, 1], **fixed,
            )  # fmt: skip
    size = half + scene.rail_width
    world.add_geom(
        type=box, size=[size, size, 0.02], pos=[0, 0, -0.22], rgba=[0.08, 0.06, 0.05, 1], contype=0, conaffinity=0
    )


def _segments(scene: TrapperScene, *, corner: float) -> tuple[tuple[float, float], ...]:
    """A wall's three rail segments between its two pockets; ``corner`` is how far the outer ones reach past it."""
    inner, outer = scene.pocket_offset - scene.pocket_gap / 2, scene.pocket_offset + scene.pocket_gap / 2
    end = scene.half_side + corner
    return ((-end, -outer), (-inner, inner), (outer, end))


def _add_ball(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, scene.ball_radius])
    ball.add_joint(name="ball", type=mujoco.mjtJoint.mjJNT_FREE)
    # A contact as soft as the default: a stiffer one throws a sliding ball up (MuJoCo's convex friction dilates).
    ball.add_geom(
        name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[scene.ball_radius, 0, 0], mass=scene.ball_mass,
        rgba=[0.25, 0.26, 0.28, 1], condim=6, friction=[scene.cloth_friction, 0.0, scene.rolling_resistance],
        priority=1, contype=BALL_BIT, conaffinity=WORLD_BIT | ARM_BIT,
    )  # fmt: skip


def _add_arm(spec: mujoco.MjSpec, scene: TrapperScene) -> None:
    touching = {"contype": ARM_BIT, "conaffinity": WORLD_BIT | BALL_BIT}
    base = spec.worldbody.add_body(name="base", pos=scene.base_pos)
    base.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.075, 0.02, 0], pos=[0, 0, 0.02], rgba=[0.7, 0.72, 0.74, 1],
        contype=0, conaffinity=0,
    )  # fmt: skip
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
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, rgba=[0.95, 0.95, 0.92, 0.75],
            mass=scene.box_mass * part / sum(volume), friction=[0.3, 0, 0], solref=[0.006, 1.0], priority=2, **touching,
        )  # fmt: skip
