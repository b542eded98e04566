"""The UR5 as one frozen table, from which its kinematic chain and its simulated bodies are both made."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Link:
    """One link of a serial arm in the standard Denavit-Hartenberg convention (Rz(q) Tz(d) Tx(a) Rx(α))."""

    name: str
    joint: str
    """Name of the joint that moves this link."""
    a: float
    """Link length [m]."""
    d: float
    """Link offset [m]."""
    alpha: float
    """Link twist [rad]."""
    mass: float
    """[kg]"""
    centre_of_mass: tuple[float, float, float]
    """[m], in the link's own DH frame."""
    torque_limit: float
    """[N·m]"""
    range: tuple[float, float]
    """Joint limits [rad]."""


HALF_TURN, FULL_TURN = math.pi, 2 * math.pi

# Universal Robots, "DH parameters for calculations of kinematics and dynamics" (UR5, CB series).
UR5_LINKS: tuple[Link, ...] = (
    Link(
        name="shoulder",
        joint="shoulder_pan",
        a=0.0,
        d=0.089159,
        alpha=math.pi / 2,
        mass=3.7,
        centre_of_mass=(0.0, -0.02561, 0.00193),
        torque_limit=150.0,
        range=(-FULL_TURN, FULL_TURN),
    ),
    Link(
        name="upper_arm",
        joint="shoulder_lift",
        a=-0.425,
        d=0.0,
        alpha=0.0,
        mass=8.393,
        centre_of_mass=(0.2125, 0.0, 0.11336),
        torque_limit=150.0,
        range=(-FULL_TURN, FULL_TURN),
    ),
    Link(
        name="forearm",
        joint="elbow",
        a=-0.39225,
        d=0.0,
        alpha=0.0,
        mass=2.275,
        centre_of_mass=(0.15, 0.0, 0.0265),
        torque_limit=150.0,
        range=(-HALF_TURN, HALF_TURN),
    ),
    Link(
        name="wrist_1",
        joint="wrist_1",
        a=0.0,
        d=0.10915,
        alpha=math.pi / 2,
        mass=1.219,
        centre_of_mass=(0.0, -0.0018, 0.01634),
        torque_limit=28.0,
        range=(-FULL_TURN, FULL_TURN),
    ),
    Link(
        name="wrist_2",
        joint="wrist_2",
        a=0.0,
        d=0.09465,
        alpha=-math.pi / 2,
        mass=1.219,
        centre_of_mass=(0.0, 0.0018, 0.01634),
        torque_limit=28.0,
        range=(-FULL_TURN, FULL_TURN),
    ),
    Link(
        name="wrist_3",
        joint="wrist_3",
        a=0.0,
        d=0.0823,
        alpha=0.0,
        mass=0.1879,
        centre_of_mass=(0.0, 0.0, -0.001159),
        torque_limit=28.0,
        range=(-FULL_TURN, FULL_TURN),
    ),
)
UR5_SPEED_LIMIT = math.pi
"""[rad/s], every joint."""


def link_transform(link: Link) -> Tensor:
    """Fixed part of a link's DH transform, Tz(d) Tx(a) Rx(α), from its joint to the next: ``(4, 4)`` float64."""
    c, s = math.cos(link.alpha), math.sin(link.alpha)
    rows = [[1.0, 0.0, 0.0, link.a], [0.0, c, -s, 0.0], [0.0, s, c, link.d], [0.0, 0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def ur5_urdf(tool_length: float = 0.0) -> str:
    """URDF text of the UR5 with a tool frame ``tool_length`` [m] in front of the flange, along its z axis.

    Links are named after `UR5_LINKS`, the root ``base`` and the tip ``tool``; joint i turns about its z axis.
    """
    parts = ['<robot name="ur5">', '<link name="base"/>']
    xyz, roll, parent = (0.0, 0.0, 0.0), 0.0, "base"
    for link in UR5_LINKS:
        parts.append(f'<link name="{link.name}"/>')
        parts.append(
            f'<joint name="{link.joint}" type="revolute"><parent link="{parent}"/><child link="{link.name}"/>'
            f'<origin xyz="{xyz[0]!r} {xyz[1]!r} {xyz[2]!r}" rpy="{roll!r} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="{link.range[0]!r}" upper="{link.range[1]!r}" effort="{link.torque_limit!r}" '
            f'velocity="{UR5_SPEED_LIMIT!r}"/></joint>'
        )
        xyz, roll, parent = (link.a, 0.0, link.d), link.alpha, link.name
    x, y, z = xyz[0], xyz[1], xyz[2] + tool_length
    parts.append('<link name="tool"/>')
    parts.append(
        f'<joint name="tool_mount" type="fixed"><parent link="{parent}"/><child link="tool"/>'
        f'<origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/></joint></robot>'
    )
    return "".join(parts)
