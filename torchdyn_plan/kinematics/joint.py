"""A serial chain as a list of joints, the one description from which every form of an arm is made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One step along a chain: a fixed transform, then the joint's own motion."""

    offset: Tensor
    """``(4, 4)`` float64, from the previous frame to the joint's [m]. May require a gradient."""
    kind: Literal["fixed", "revolute", "prismatic"] = "fixed"
    axis: Tensor | None = None
    """``(3,)`` unit vector in the joint's own frame, along or about which it moves; None for a fixed joint."""
    name: str = ""
    lower: float = -math.inf
    """[rad; m]"""
    upper: float = math.inf
    """[rad; m]"""
    speed_limit: float = math.inf
    """[rad/s; m/s]"""


def merge_fixed(joints: Sequence[Joint]) -> tuple[list[Joint], Tensor]:
    """The joints that move, fixed ones folded into the next one's offset, and the transform after the last of them."""
    moving: list[Joint] = []
    offset = torch.eye(4, dtype=torch.float64)
    for joint in joints:
        offset = offset @ joint.offset.to("cpu", torch.float64)
        if joint.axis is not None:
            axis = joint.axis.detach().to("cpu", torch.float64)
            values = {"name": joint.name, "lower": joint.lower, "upper": joint.upper, "speed_limit": joint.speed_limit}
            moving.append(Joint(offset=offset, kind=joint.kind, axis=axis / axis.norm(), **values))
            offset = torch.eye(4, dtype=torch.float64)
    return moving, offset


def transform(rotation: Tensor | None = None, position: Sequence[float] | Tensor = (0.0, 0.0, 0.0)) -> Tensor:
    """Homogeneous transform ``(4, 4)`` float64 of a rotation ``(3, 3)`` and a position ``(3,)`` [m]."""
    matrix = torch.eye(4, dtype=torch.float64)
    if rotation is not None:
        matrix[:3, :3] = rotation
    matrix[:3, 3] = torch.as_tensor(position, dtype=torch.float64)
    return matrix


def cross_matrix(vector: Tensor) -> Tensor:
    """The matrix ``(3, 3)`` with ``cross_matrix(u) @ v = u × v``."""
    return torch.linalg.cross(vector.expand(3, 3), torch.eye(3, dtype=vector.dtype)).T


def rotation_about(axis: Tensor, angle: float) -> Tensor:
    """Rotation ``(3, 3)`` float64 about the unit vector ``axis`` by ``angle`` [rad] (Rodrigues)."""
    cross = cross_matrix(axis.to(torch.float64))
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
