"""A serial chain as a list of joints, from which every form of an arm is made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import torch
from torch import Tensor

from torchdyn_plan.checks import check_finite
from torchdyn_plan.errors import InputError

Kind = Literal["fixed", "revolute", "prismatic"]


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One step along a chain: a fixed transform, then the joint's own motion."""

    offset: Tensor
    """``(4, 4)`` float64, from the previous frame to the joint's [m]. May require a gradient."""
    kind: Kind = "fixed"
    axis: Tensor | None = None
    """``(3,)`` unit vector in the joint's own frame, along or about which it moves; None for a fixed joint."""
    name: str = ""
    lower: float = -math.inf
    """[rad; m]"""
    upper: float = math.inf
    """[rad; m]"""
    speed_limit: float = math.inf
    """[rad/s; m/s]"""
    coupling: Coupling | None = None
    """How another joint drives this one; None for an independent joint."""


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """A joint's position is ``ratio · q + shift``, with q the position of another joint, the driver."""

    driver: Joint
    """The other joint, in the chain or not. Identified by its name; its limits apply, its offset does not matter."""
    ratio: float = 1.0
    shift: float = 0.0
    """[rad; m]"""


def merge_fixed(joints: Sequence[Joint]) -> tuple[list[Joint], Tensor]:
    """The joints that move, fixed ones folded into the next one's offset, and the transform after the last of them.

    Raises:
        InputError: a joint's offset, axis or limits are invalid.
    """
    moving: list[Joint] = []
    offset = torch.eye(4, dtype=torch.float64)
    for joint in joints:
        check_joint(joint)
        offset = offset @ joint.offset.to("cpu", torch.float64)
        if joint.axis is not None:
            axis = joint.axis.detach().to("cpu", torch.float64)
            moving.append(replace(joint, offset=offset, axis=axis / axis.norm()))
            offset = torch.eye(4, dtype=torch.float64)
    return moving, offset


def check_joint(joint: Joint) -> None:
    """Raise `InputError`, naming the joint, unless its numbers are valid."""
    named = f"joint {joint.name!r}"
    if joint.offset.shape != (4, 4):
        raise InputError(f"the offset of {named} must have shape (4, 4), got {tuple(joint.offset.shape)}")
    check_finite(f"the offset of {named}", joint.offset)
    if (joint.axis is None) != (joint.kind == "fixed"):
        raise InputError(f"{named} is {joint.kind}, and its axis is {joint.axis}: only joints that move have one")
    if joint.axis is not None:
        length = float(joint.axis.detach().norm())
        if not 0.0 < length < math.inf:
            raise InputError(f"{named} has no axis: {joint.axis.tolist()}")
        check_limits(joint)


def check_limits(joint: Joint) -> None:
    """Raise `InputError`, naming the joint, unless its limits allow some position and some speed."""
    if not joint.lower <= joint.upper:
        raise InputError(f"joint {joint.name!r} has a lower limit of {joint.lower} and an upper one of {joint.upper}")
    if not joint.speed_limit > 0.0:
        raise InputError(f"joint {joint.name!r} has a speed limit of {joint.speed_limit}, which must be above 0")


def motion(kind: Kind, axis: Tensor, position: float) -> Tensor:
    """Transform ``(4, 4)`` float64 of a joint at ``position``, about or along the unit vector ``axis``."""
    if kind == "prismatic":
        return transform(position=position * axis)
    return transform(rotation_about(axis, position))


def held(joint: Joint, position: float) -> Joint:
    """``joint`` as a fixed one, at ``position`` [rad; m]."""
    where = motion(joint.kind, cast(Tensor, joint.axis), position)
    return Joint(offset=joint.offset @ where, name=joint.name)


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
