"""The UR10 as one frozen table, from which its kinematic chain and its simulated bodies are both made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.joint import Joint


@dataclass(frozen=True, kw_only=True)
class UR10Link:
    """One link in the standard Denavit-Hartenberg convention, Rz(q) Tz(d) Tx(a) Rx(α), and the joint that moves it."""

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
    """Taken for the joint's limit [rad/s²]: Universal Robots publishes none."""
    torque: float
    """Joint limit [N·m]."""
    mass: float
    """[kg]"""
    centre: tuple[float, float, float]
    """Centre of mass in the frame after the link [m]."""

    @property
    def transform(self) -> Tensor:
        """Tz(d) Tx(a) Rx(α), from the joint's frame to the one after the link: ``(4, 4)`` float64."""
        c, s = math.cos(self.alpha), math.sin(self.alpha)
        rows = [[1.0, 0.0, 0.0, self.a], [0.0, c, -s, 0.0], [0.0, s, c, self.d], [0.0, 0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)


QUARTER, HALF, TURN = math.pi / 2, math.pi, 2 * math.pi
SLOW, FAST = math.radians(120.0), math.radians(180.0)
UR10_LINKS = tuple(
    UR10Link(
        a=a, d=d, alpha=alpha, range=(-most, most), speed=speed, acceleration=15.0, torque=torque, mass=mass, centre=at
    )
    for a, d, alpha, most, speed, torque, mass, at in (
        (0.0, 0.1273, QUARTER, TURN, SLOW, 330.0, 7.1, (0.021, 0.0, 0.027)),
        (-0.612, 0.0, 0.0, TURN, SLOW, 330.0, 12.7, (0.38, 0.0, 0.158)),
        (-0.5723, 0.0, 0.0, HALF, FAST, 150.0, 4.27, (0.24, 0.0, 0.068)),
        (0.0, 0.163941, QUARTER, TURN, FAST, 56.0, 2.0, (0.0, 0.007, 0.018)),
        (0.0, 0.1157, -QUARTER, TURN, FAST, 56.0, 2.0, (0.0, 0.007, 0.018)),
        (0.0, 0.0922, 0.0, TURN, FAST, 56.0, 0.365, (0.0, 0.0, -0.026)),
    )
)
"""Universal Robots, "DH parameters for calculations of kinematics and dynamics" (UR10, CB series) and its data sheet.

The elbow may turn a whole turn; it is kept within half of one, so that it does not wind up."""


def ur10_arm(*, tool_length: float = 0.0, **options: Any) -> Arm:
    """The UR10 with a tool ``tool_length`` [m] in front of its flange; ``options`` as of `Arm`."""
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    offset, joints = torch.eye(4, dtype=torch.float64), []
    for number, link in enumerate(UR10_LINKS, 1):
        low, high = link.range
        joints.append(
            Joint(
                offset=offset,
                kind="revolute",
                axis=axis,
                name=f"joint{number}",
                lower=low,
                upper=high,
                speed_limit=link.speed,
            )
        )
        offset = link.transform
    tool = offset.clone()
    tool[:3, 3] += tool_length * tool[:3, 2]
    return Arm(joints, tool=tool, **options)
