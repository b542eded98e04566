"""Shared code of the URDF and MJCF readers, and joints from a chain parsed by pytorch-kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.joint import Joint, Kind, transform

if TYPE_CHECKING:
    import pytorch_kinematics

Source = str | bytes | PathLike[str]
"""A description: its text, or the path of its file. Text contains a ``<``, a path does not."""
HANDLED = "fixed, revolute and prismatic joints"
"""Supported joints, for messages."""


def file_or_text(source: Source, language: str) -> Path | str | bytes:
    """``source`` as the path of a file that exists, or as its text.

    Raises:
        InputError: there is no such file, or ``source`` is of another type.
    """
    if isinstance(source, bytes):
        return source
    if not isinstance(source, (str, PathLike)):
        raise InputError(f"{language} comes as text or as a path, got {type(source).__name__}")
    if isinstance(source, str) and "<" in source:
        return source
    if str(source).strip() and Path(source).is_file():
        return Path(source)
    raise InputError(f"the {language} text cannot be read: {str(source)[:200]!r} is neither a description nor a file")


def joints_of_chain(chain: pytorch_kinematics.SerialChain) -> list[Joint]:
    """Joints of a chain parsed by pytorch-kinematics, at the chain's precision."""
    joints = []
    for frame in chain._serial_frames:
        joint, before = frame.joint, _fixed_part(frame.link) @ _fixed_part(frame.joint)
        speed = joint.velocity_limits[1] if joint.velocity_limits else None
        name, kind = joint.name or "", joint.joint_type
        joints.append(make_joint(name, kind, before, joint.axis, limits=joint.limits, speed=speed))
    return joints


def make_joint(
    name: str, kind: Kind, before: Tensor, axis: Any, *, limits: Sequence[float] | None, speed: float | None
) -> Joint:
    """A joint from a description; a speed of 0 means that none is given."""
    if kind == "fixed":
        return Joint(offset=before, name=name)
    lower, upper = map(float, limits or (-math.inf, math.inf))
    axis, speed = unit_axis(name, axis), float(speed or math.inf)
    return Joint(offset=before, kind=kind, axis=axis, name=name, lower=lower, upper=upper, speed_limit=speed)


def unit_axis(name: str, axis: Any) -> Tensor:
    """Unit vector ``(3,)`` float64 along ``axis``; raises `InputError` if it has no direction."""
    direction = torch.as_tensor(axis, dtype=torch.float64)
    length = direction.norm()
    if not 0.0 < float(length) < math.inf:
        raise InputError(f"joint {name!r} has no axis: {direction.tolist()}")
    return direction / length


def _fixed_part(part: Any) -> Tensor:
    """Offset of a frame's link or joint."""
    return transform() if part.offset is None else part.offset.get_matrix()[0].to("cpu", torch.float64)
