"""The Panda as one frozen table, from which its kinematic chain and its simulated bodies are both made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.joint import Joint


@dataclass(frozen=True, kw_only=True)
class PandaLink:
    """One link in Craig's convention: Rx(α) Tx(a) Rz(q) Tz(d) from the frame before, and the joint that moves it."""

    a: float
    """[m]"""
    d: float
    """[m]"""
    alpha: float
    """[rad]"""
    range: tuple[float, float]
    """Joint limits [rad]."""
    speed: float
    """Joint limit [rad/s]."""
    acceleration: float
    """Joint limit [rad/s²]."""
    torque: float
    """Joint limit [N·m]."""
    mass: float
    """[kg]: shares of the arm's 18 kg by link size, because Franka publishes only the total."""

    @property
    def offset(self) -> Tensor:
        """Rx(α) Tx(a) Tz(d), from the frame before to the joint's: ``(4, 4)`` float64."""
        c, s = math.cos(self.alpha), math.sin(self.alpha)
        rows = [[1.0, 0.0, 0.0, self.a], [0.0, c, -s, -self.d * s], [0.0, s, c, self.d * c], [0.0, 0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)


QUARTER = math.pi / 2
PANDA_LINKS = tuple(
    PandaLink(a=a, d=d, alpha=alpha, range=limits, speed=speed, acceleration=acceleration, torque=torque, mass=mass)
    for a, d, alpha, limits, speed, acceleration, torque, mass in (
        (0.0, 0.333, 0.0, (-2.8973, 2.8973), 2.175, 15.0, 87.0, 3.0),
        (0.0, 0.0, -QUARTER, (-1.7628, 1.7628), 2.175, 7.5, 87.0, 3.0),
        (0.0, 0.316, QUARTER, (-2.8973, 2.8973), 2.175, 10.0, 87.0, 3.0),
        (0.0825, 0.0, QUARTER, (-3.0718, -0.0698), 2.175, 12.5, 87.0, 3.0),
        (-0.0825, 0.384, -QUARTER, (-2.8973, 2.8973), 2.61, 15.0, 12.0, 3.0),
        (0.0, 0.0, QUARTER, (-0.0175, 3.7525), 2.61, 20.0, 12.0, 1.5),
        (0.088, 0.0, QUARTER, (-2.8973, 2.8973), 2.61, 20.0, 12.0, 0.5),
    )
)
"""Franka Emika, "Robot and interface specifications": DH parameters and joint limits."""
PANDA_FLANGE = 0.107
"""Distance of the flange from the last joint, along its axis [m]."""
TOOL_TURN = -math.pi / 4
"""Mounting angle of tools about the flange's axis, as of Franka's own gripper [rad]."""


def mount(tool_length: float) -> list[list[float]]:
    """Pose of a tool in the frame of the last joint, ``tool_length`` [m] in front of the flange."""
    c, s = math.cos(TOOL_TURN), math.sin(TOOL_TURN)
    height = PANDA_FLANGE + tool_length
    return [[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, height], [0.0, 0.0, 0.0, 1.0]]


def panda_arm(*, tool_length: float = 0.0, **options: Any) -> Arm:
    """The Panda with a tool ``tool_length`` [m] in front of its flange; ``options`` as of `Arm`."""
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    joints = [
        Joint(
            offset=link.offset,
            kind="revolute",
            axis=axis,
            name=f"panda_joint{number}",
            lower=link.range[0],
            upper=link.range[1],
            speed_limit=link.speed,
        )
        for number, link in enumerate(PANDA_LINKS, 1)
    ]
    return Arm(joints, tool=mount(tool_length), **options)
