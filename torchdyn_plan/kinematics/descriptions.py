"""What the readers of arms' descriptions share, and joints out of a chain that pytorch-kinematics has parsed."""

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
"""A description: its text, or the path of its file. Text holds a ``<``, and no path does."""
HANDLED = "fixed, revolute and prismatic joints"
"""What an arm can be made of, in words."""


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
    """Joints of a chain that pytorch-kinematics has parsed, at the chain's own precision."""
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
    """A joint as a description has it; a speed of 0 means that none was given."""
    if kind == "fixed":
        return Joint(offset=before, name=name)
    lower, upper = map(float, limits or (-math.inf, math.inf))
    axis, speed = unit_axis(name, axis), float(speed or math.inf)
    return Joint(offset=before, kind=kind, axis=axis, name=name, lower=lower, upper=upper, speed_limit=speed)


def unit_axis(name: str, axis: Any) -> Tensor:
    """Direction ``(3,)`` float64 of length 1; `InputError` where ``axis`` has none."""
    direction = torch.as_tensor(axis, dtype=torch.float64)
    length = direction.norm()
    if not 0.0 < float(length) < math.inf:
        raise InputError(f"joint {name!r} has no axis: {direction.tolist()}")
    return direction / length


def _fixed_part(part: Any) -> Tensor:
    """Offset of a frame's link or joint."""
    return transform() if part.offset is None else part.offset.get_matrix()[0].to("cpu", torch.float64)
