"""The scene of catch: a UR10 on a stand, the cup at its tool, and a ball that is thrown, from one frozen dataclass."""

# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass

import mujoco

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.catch.bodies import add_ball, add_look, add_ur10
from torchdyn_plan.errors import InputError

GRAVITY = (0.0, 0.0, -9.81)
"""[m/s²]"""
AIR = 1.2
"""Density [kg/m³]."""
ANYTHING = ("home", "aim_low", "aim_high")
"""Tuples of numbers of any sign."""


@dataclass(frozen=True, kw_only=True)
class CatchScene:
    """Geometry and physics; the UR10 stands above the world's origin, and balls come from along x."""

    base_height: float = 0.6
    """Of the arm's base above the floor [m]."""
    ball_radius: float = 0.033
    """A tennis ball's [m]."""
    ball_mass: float = 0.058
    """[kg]"""
    cup_radius: float = 0.075
    """Of the cup, inside [m]."""
    cup_depth: float = 0.14
    """From its mouth to its bottom [m]."""
    cup_wall: float = 0.012
    """Thickness of wall and bottom [m]."""
    cup_mass: float = 0.5
    """[kg]"""
    softness: float = 0.01
    """Time in which a contact of ball and cup comes to rest, critically damped: foam [s]."""
    hold_steps: int = 25
    """A ball that has been in the cup for so many control steps on end is caught."""
    throw_from: float = 2.5
    """Throws start no nearer to the arm's axis than this [m] …"""
    throw_to: float = 4.0
    """… and no farther away [m] …"""
    throw_angle: float = 25.0
    """… within this of the x axis, seen from above [deg] …"""
    throw_low: float = 1.0
    """… no lower than this [m] …"""
    throw_high: float = 1.8
    """… and no higher [m]."""
    aim_low: tuple[float, float, float] = (0.45, -0.8, 0.7)
    """Balls fly through a place in a box: its least coordinates [m, world] …"""
    aim_high: tuple[float, float, float] = (0.95, 0.8, 1.6)
    """… and its greatest ones [m, world]."""
    flight_spread: float = 0.2
    """The time of flight to that place differs by so much at most from the mean [s]."""
    home: tuple[float, ...] = (2.81, -1.15, 2.16, 1.40, -1.32, 0.0)
    """Initial joint angles [rad]: the cup looks where balls come from."""
    stiffness: tuple[float, ...] = (20000.0, 20000.0, 15000.0, 5000.0, 4000.0, 2000.0)
    """Position gain of each servo [N·m/rad]."""
    damping: tuple[float, ...] = (1200.0, 1200.0, 700.0, 150.0, 120.0, 60.0)
    """Speed gain of each servo [N·m·s/rad]."""
    substep: float = 0.002
    """Physics step [s]."""
    control_step: float = 0.008
    """Time between two actions [s]: the UR10's own 125 Hz."""
    max_steps: int = 220
    """Control steps of an episode."""

    def __post_init__(self) -> None:
        lowest = {"throw_to": self.throw_from, "throw_high": self.throw_low, "flight_spread": 0.0, "throw_angle": 0.0}
        for one in dataclasses.fields(self):
            value = getattr(self, one.name)
            if isinstance(one.default, tuple):
                if not isinstance(value, tuple) or len(value) != len(one.default):
                    raise InputError(f"{one.name} must be a tuple of {len(one.default)} numbers, got {value!r}")
                for number in value:
                    check_number(one.name, number, minimum=-math.inf if one.name in ANYTHING else 1e-9)
            else:
                check_number(one.name, value, minimum=lowest.get(one.name, 1e-9), integer=isinstance(one.default, int))
        if any(low > high for low, high in zip(self.aim_low, self.aim_high, strict=True)):
            raise InputError(f"aim_low must be below aim_high along each axis, got {self.aim_low!r}")
        if self.ball_radius >= self.cup_radius:
            raise InputError(f"ball_radius must be below cup_radius = {self.cup_radius:g}, got {self.ball_radius!r}")

    @property
    def tool_length(self) -> float:
        """From the flange to the middle of the cup's mouth [m]."""
        return self.cup_depth + self.cup_wall

    def digest(self) -> str:
        """Hash of every number above: two scenes with one digest are one scene."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def compile(self, *, drag: float) -> mujoco.MjModel:
        """MuJoCo's model of the scene with a ball whose drag is k = ``drag``: deceleration over speed squared [1/m]."""
        check_number("drag", drag, minimum=0.0)
        spec = mujoco.MjSpec()
        spec.modelname = "catch"
        spec.compiler.degree = False
        option = spec.option
        option.timestep, option.gravity, option.density = self.substep, GRAVITY, AIR
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        add_look(spec)
        add_ur10(spec, self)
        add_ball(spec, self, drag * self.ball_mass / (AIR * math.pi * self.ball_radius**2))
        return spec.compile()
