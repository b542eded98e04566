"""Arms for studies of inverse kinematics: real ones by their tables, on bases, with narrow limits, random chains."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from torchdyn_plan.kinematics import Arm, Joint
from torchdyn_plan.kinematics.joint import rotation_about, transform

RIGHT = math.pi / 2
Z = (0.0, 0.0, 1.0)
Place = tuple[float, float, float]


def joint(
    xyz: Place,
    rpy: Place = (0.0, 0.0, 0.0),
    limits: tuple[float, float] = (-3.0, 3.0),
    *,
    kind: str = "revolute",
    axis: Place = Z,
    speed: float = 2.0,
) -> Joint:
    """A joint as URDF tells it: place and fixed-axis roll, pitch, yaw from the one before, and its own axis."""
    eye = torch.eye(3, dtype=torch.float64)
    roll, pitch, yaw = (rotation_about(way, angle) for way, angle in zip(eye, rpy, strict=True))
    values = {"lower": limits[0], "upper": limits[1], "speed_limit": speed}
    moving = {} if kind == "fixed" else {"axis": torch.tensor(axis, dtype=torch.float64)}
    return Joint(offset=transform(yaw @ pitch @ roll, xyz), kind=kind, **moving, **values)  # type: ignore[arg-type]


def universal(  # noqa: PLR0917  # The table's own columns.
    d1: float, a2: float, a3: float, d4: float, d5: float, d6: float, turn: float = 2 * math.pi
) -> list[Joint]:
    """A UR arm by its table."""
    full, elbow = (-turn, turn), (-min(turn, math.pi), min(turn, math.pi))
    return [
        joint((0, 0, 0), limits=full),
        joint((0, 0, d1), (RIGHT, 0, 0), full),
        joint((a2, 0, 0), limits=elbow),
        joint((a3, 0, 0), limits=full),
        joint((0, 0, d4), (RIGHT, 0, 0), full),
        joint((0, 0, d5), (-RIGHT, 0, 0), full),
        joint((0, 0, d6), kind="fixed"),
    ]


UR3 = (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819)
UR5 = (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823)
UR5E = (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996)
UR10 = (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922)
UR16E = (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655)
PANDA = [
    joint((0, 0, 0.333), limits=(-2.8973, 2.8973), speed=2.175),
    joint((0, 0, 0), (-RIGHT, 0, 0), (-1.7628, 1.7628), speed=2.175),
    joint((0, -0.316, 0), (RIGHT, 0, 0), (-2.8973, 2.8973), speed=2.175),
    joint((0.0825, 0, 0), (RIGHT, 0, 0), (-3.0718, -0.0698), speed=2.175),
    joint((-0.0825, 0.384, 0), (-RIGHT, 0, 0), (-2.8973, 2.8973), speed=2.61),
    joint((0, 0, 0), (RIGHT, 0, 0), (-0.0175, 3.7525), speed=2.61),
    joint((0.088, 0, 0), (RIGHT, 0, 0), (-2.8973, 2.8973), speed=2.61),
    joint((0, 0, 0.107), kind="fixed"),
]
IIWA = [
    joint((0, 0, 0.15), limits=(-2.9671, 2.9671), speed=1.48),
    joint((0, 0, 0.19), (RIGHT, 0, math.pi), (-2.0944, 2.0944), speed=1.48),
    joint((0, 0.21, 0), (RIGHT, 0, math.pi), (-2.9671, 2.9671), speed=1.74),
    joint((0, 0, 0.19), (RIGHT, 0, 0), (-2.0944, 2.0944), speed=1.3),
    joint((0, 0.21, 0), (-RIGHT, math.pi, 0), (-2.9671, 2.9671), speed=2.26),
    joint((0, 0.0607, 0.19), (RIGHT, 0, 0), (-2.0944, 2.0944), speed=2.35),
    joint((0, 0.081, 0.0607), (-RIGHT, math.pi, 0), (-3.0543, 3.0543), speed=2.35),
    joint((0, 0, 0.045), kind="fixed"),
]
PUMA = [
    joint((0, 0, 0.67), limits=(-2.79, 2.79)),
    joint((0, 0, 0), (-RIGHT, 0, 0), (-3.84, 0.79)),
    joint((0.4318, 0, 0.15), limits=(-0.79, 3.84)),
    joint((0.0203, -0.4318, 0), (-RIGHT, 0, 0), (-1.92, 2.97)),
    joint((0, 0, 0), (RIGHT, 0, 0), (-1.75, 1.75)),
    joint((0, 0, 0), (-RIGHT, 0, 0), (-4.64, 4.64)),
    joint((0, 0, 0.06), kind="fixed"),
]
FETCH = [
    joint((-0.087, 0, 0.378), limits=(0.0, 0.386), kind="prismatic", speed=0.1),
    joint((0.1195, 0, 0.3486), limits=(-1.6056, 1.6056), speed=1.256),
    joint((0.117, 0, 0.06), limits=(-1.221, 1.518), axis=(0, 1, 0), speed=1.454),
    joint((0.219, 0, 0), limits=(-math.inf, math.inf), axis=(1, 0, 0), speed=1.571),
    joint((0.133, 0, 0), limits=(-2.251, 2.251), axis=(0, 1, 0), speed=1.521),
    joint((0.197, 0, 0), limits=(-math.inf, math.inf), axis=(1, 0, 0), speed=1.571),
    joint((0.1245, 0, 0), limits=(-2.16, 2.16), axis=(0, 1, 0), speed=2.268),
    joint((0.1385, 0, 0), limits=(-math.inf, math.inf), axis=(1, 0, 0), speed=2.268),
    joint((0.16645, 0, 0), kind="fixed"),
]
BASE = [
    joint((0, 0, 0), limits=(-1.0, 1.0), kind="prismatic", axis=(1, 0, 0), speed=0.5),
    joint((0, 0, 0), limits=(-1.0, 1.0), kind="prismatic", axis=(0, 1, 0), speed=0.5),
    joint((0, 0, 0), limits=(-math.inf, math.inf), speed=1.0),
]
RAIL = [joint((0, 0, 0.2), limits=(-0.6, 0.6), kind="prismatic", axis=(0, 1, 0), speed=0.5)]


def random_chain(seed: int, count: int) -> list[Joint]:
    """A chain of ``count`` joints with offsets up to 0.3 m, axes at any angle, and limits of one to six radians."""
    random = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, size: int = 1) -> list[float]:
        return (low + (high - low) * torch.rand(size, generator=random, dtype=torch.float64)).tolist()

    joints = []
    for _ in range(count):
        (middle,), (half,) = uniform(-1.0, 1.0), uniform(0.5, 3.0)
        place, turn = tuple(uniform(-0.3, 0.3, 3)), tuple(uniform(-3.0, 3.0, 3))
        joints.append(joint(place, turn, (middle - half, middle + half)))  # type: ignore[arg-type]
    return [*joints, joint((0.05, 0, 0.1), kind="fixed")]


ARMS: dict[str, Callable[[], list[Joint]]] = {
    "ur3": lambda: universal(*UR3),
    "ur5": lambda: universal(*UR5),
    "ur5e": lambda: universal(*UR5E),
    "ur10": lambda: universal(*UR10),
    "ur16e": lambda: universal(*UR16E),
    "ur5, half turns": lambda: universal(*UR5, turn=math.pi),
    "ur5, narrow": lambda: universal(*UR5, turn=1.5),
    "puma": lambda: PUMA,
    "panda": lambda: PANDA,
    "iiwa": lambda: IIWA,
    "fetch": lambda: FETCH,
    "rail and ur5": lambda: [*RAIL, *universal(*UR5)],
    "rail and panda": lambda: [*RAIL, *PANDA],
    "base and ur5": lambda: [*BASE, *universal(*UR5)],
    "base and panda": lambda: [*BASE, *PANDA],
    **{f"random {6 + seed % 3}, {seed}": lambda seed=seed: random_chain(seed, 6 + seed % 3) for seed in range(16)},
}
"""What makes the joints of each."""


def make(name: str, dtype: torch.dtype = torch.float64) -> Arm:
    """The arm of that name."""
    return Arm(ARMS[name](), dtype=dtype)


def positions(arm: Arm, count: int, seed: int = 0) -> torch.Tensor:
    """Joint positions all over the limits, ``(count, N)``; within half a turn where there are none."""
    random = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, arm.num_joints, generator=random, dtype=torch.float64).to(arm.lower)
    low, high = arm.lower.clamp(min=-math.pi), arm.upper.clamp(max=math.pi)
    return low + (high - low) * unit
