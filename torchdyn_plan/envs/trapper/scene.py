# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""The Trapper scene: a UR5 with a box, a billiard table with eight pockets, and a ball, from one frozen dataclass."""

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass

import mujoco

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.envs.trapper.bodies import add_arm, add_ball, add_look, add_table
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.ur5 import UR5_LINKS, UR5_SPEED_LIMIT

GRAVITY = 9.81
"""[m/s²]"""
_LATER = ("arm_speed",)
"""Numbers of a scene that were added later."""


@dataclass(frozen=True, kw_only=True)
class TrapperScene:
    """Geometry and physics of Trapper; by default with the limits of a real UR5.

    Frame: z up, table surface at z = 0, table centre at the origin, arm at -y.
    """

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
    arm_speed: float = 1.0
    """Greatest speed of the joints, as a multiple of the real UR5's."""
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
    def joint_speed(self) -> float:
        """Greatest speed of each joint [rad/s]: an action of ±1."""
        return self.arm_speed * UR5_SPEED_LIMIT

    @property
    def half_side(self) -> float:
        """Half of the playing area's side [m]."""
        return self.table_side / 2

    @property
    def box_outer(self) -> float:
        """Outer half-width of the box [m]."""
        return self.box_half_width + self.box_wall

    @property
    def goal_on_table_below(self) -> float:
        """A goal at this height or below, a centimetre above a ball's centre, says *be here, box down* [m]."""
        return self.ball_radius + 0.01

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
        numbers = dataclasses.asdict(self)
        for name in _LATER:
            # Scenes that are older than this number keep their digest, and so all that belongs to them.
            if numbers[name] == getattr(TrapperScene, name):
                del numbers[name]
        text = json.dumps(numbers, sort_keys=True)
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
        add_look(spec)
        add_table(spec, self)
        add_ball(spec, self)
        if arm:
            add_arm(spec, self)
        return spec

    def compile(self, *, arm: bool = True, friction: float = 0.0) -> mujoco.MjModel:
        """Compiled model; ``friction`` is the friction loss on the ball's horizontal translation [N]."""
        check_number("friction", friction, minimum=0.0)
        model = self.spec(arm=arm).compile()
        first = int(model.jnt_dofadr[model.joint("ball").id])
        model.dof_frictionloss[first : first + 2] = friction
        return model


SCENES = {"ur5": TrapperScene(), "paper": TrapperScene(arm_speed=2.0, acceleration_limit=150.0, base_setback=0.01)}
"""Scenes by name: with the limits of a real UR5, and one in which the paper's planner comes near its figures."""


def trapper_scene(scene: TrapperScene | str | None = None) -> TrapperScene:
    """The scene of that name, the first one for None; a scene is returned as it is.

    Raises:
        InputError: there is no scene of that name; the message lists those there are.
    """
    if isinstance(scene, TrapperScene):
        return scene
    if scene is None:
        return next(iter(SCENES.values()))
    check_choice("scene", scene, SCENES)
    return SCENES[scene]
