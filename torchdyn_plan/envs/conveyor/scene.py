"""The conveyor scene: a Panda, a belt, and parts on it, from one frozen dataclass."""

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
from torchdyn_plan.envs.conveyor.bodies import add_belt, add_look, add_panda, add_parts
from torchdyn_plan.errors import InputError

MOST_PARTS = 8
"""Most parts in an episode."""


@dataclass(frozen=True, kw_only=True)
class ConveyorScene:
    """Geometry and physics; the Panda stands at the world's origin, and the belt runs along y in front of it."""

    belt_x: float = 0.45
    """Middle of the belt [m]."""
    belt_half_width: float = 0.2
    """[m]"""
    belt_height: float = 0.1
    """Height of its surface [m]."""
    lane_half_width: float = 0.1
    """Parts lie within this of the belt's middle [m]."""
    part_size: tuple[float, float, float] = (0.09, 0.05, 0.04)
    """Length, width and height of a part [m]."""
    part_mass: float = 0.2
    """[kg]"""
    first_from: float = -1.0
    """The first part of an episode starts no farther upstream than this [m]."""
    first_to: float = -0.4
    """The first part of an episode starts no farther downstream than this [m]."""
    feed_from: float = 1.2
    """Shortest time between two parts [s]."""
    feed_to: float = 2.4
    """Longest time between two parts [s]."""
    gone_y: float = 0.65
    """A part this far downstream is gone [m]."""
    tool_length: float = 0.1
    """From the flange to the mouth of the suction cups [m]."""
    hold_distance: float = 0.012
    """The cups attach to a part if the centre of its top is within this distance of their mouth [m] …"""
    hold_speed: float = 0.1
    """… at most at this relative speed [m/s] …"""
    hold_angle: float = 10.0
    """… and aligned with the part within this angle, up to a half turn [deg] …"""
    hold_steps: int = 3
    """… for this many consecutive control steps."""
    lift_height: float = 0.08
    """A held part this far above the belt is taken [m]."""
    home: tuple[float, ...] = (0.0, -0.2550, 0.0, -2.4366, 0.0, 2.1816, 0.7854)
    """Initial joint angles [rad]."""
    stiffness: tuple[float, ...] = (9000.0, 9000.0, 7000.0, 7000.0, 3000.0, 2500.0, 1500.0)
    """Position gain of each servo [N·m/rad]."""
    damping: tuple[float, ...] = (500.0, 500.0, 350.0, 350.0, 120.0, 100.0, 50.0)
    """Speed gain of each servo [N·m·s/rad]."""
    substep: float = 0.002
    """Physics step [s]."""
    control_step: float = 0.02
    """Time between two actions [s]."""
    max_steps: int = 500
    """Control steps of an episode."""

    def __post_init__(self) -> None:
        lowest = {"belt_x": -math.inf, "first_from": -math.inf, "first_to": self.first_from, "gone_y": self.first_to}
        lowest |= {"feed_to": self.feed_from, "lane_half_width": 0.0}
        for one in dataclasses.fields(self):
            value = getattr(self, one.name)
            if isinstance(one.default, tuple):
                if not isinstance(value, tuple) or len(value) != len(one.default):
                    raise InputError(f"{one.name} must be a tuple of {len(one.default)} numbers, got {value!r}")
                for number in value:
                    check_number(one.name, number, minimum=-math.inf if one.name == "home" else 1e-9)
            else:
                check_number(one.name, value, minimum=lowest.get(one.name, 1e-9), integer=isinstance(one.default, int))

    @property
    def top(self) -> float:
        """Height of the tops of parts on the belt [m]."""
        return self.belt_height + self.part_size[2]

    def digest(self) -> str:
        """Hash of every number above: scenes with equal digests are equal."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def compile(self, *, speed: float, parts: int) -> mujoco.MjModel:
        """MuJoCo's model of the scene with a belt at ``speed`` [m/s] and ``parts`` parts."""
        check_number("speed", speed, minimum=0.0)
        check_number("parts", parts, minimum=1, maximum=MOST_PARTS, integer=True)
        spec = mujoco.MjSpec()
        spec.modelname = "conveyor"
        spec.compiler.degree = False
        option = spec.option
        option.timestep = self.substep
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        add_look(spec)
        add_belt(spec, self, speed)
        add_panda(spec, self)
        add_parts(spec, self, parts)
        return spec.compile()
