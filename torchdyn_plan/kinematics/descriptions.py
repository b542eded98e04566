"""Joints of an arm out of URDF or MJCF text.

pytorch-kinematics parses the text and says which frames lie between base and tip; it rounds their offsets to float32,
so the numbers themselves are read once more at the precision of the description.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, cast

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.joint import Joint, rotation_about, transform

if TYPE_CHECKING:
    import pytorch_kinematics

Kind = Literal["fixed", "revolute", "prismatic"]


def joints_of_urdf(text: str, *, base: str | None, tip: str) -> list[Joint]:
    """Joints from the link ``base`` (the root if None) to the link ``tip`` of the URDF ``text``."""
    import pytorch_kinematics as pk
    from pytorch_kinematics.urdf_parser_py.urdf import URDF

    tree = _parse("URDF", lambda: pk.build_chain_from_urdf(text.encode()))
    robot: Any = URDF.from_xml_string(text.encode())
    joints = []
    for frame in _frames_between(tree, base, tip):
        joint = robot.joint_map[frame.joint.name]
        if getattr(joint, "mimic", None) is not None:
            raise InputError(f"joint {joint.name!r} mimics another; Arm handles joints that move on their own")
        before = _fixed_part(frame.link) @ _origin(joint.origin)
        joints.append(_joint(frame, before, joint.axis, _urdf_limits(joint)))
    return joints


def joints_of_mjcf(text: str, *, base: str | None, tip: str) -> list[Joint]:
    """Joints from the body ``base`` (the world if None) to the body or site ``tip`` of the MJCF ``text``."""
    import pytorch_kinematics as pk

    try:
        from pytorch_kinematics import mjcf
    except ImportError as error:
        raise InputError("MJCF is read by mujoco, which is not installed: pip install 'torchdyn-plan[sim]'") from error
    # mujoco >= 3.17 gives joint types as numpy integers, which its enumeration's keys do not equal.
    mjcf.JOINT_TYPE_MAP = {int(kind): name for kind, name in mjcf.JOINT_TYPE_MAP.items()}
    tree = _parse("MJCF", lambda: pk.build_chain_from_mjcf(text))
    mujoco: Any = mjcf.mujoco
    model = mujoco.MjModel.from_xml_string(text)
    bodies = {model.body(index).name: model.body(index) for index in range(model.nbody)}
    joints = []
    for frame in _frames_between(tree, base, tip):
        place = bodies[frame.name] if frame.name in bodies else model.site(frame.name)
        before = transform(_rotation_of_quaternion(place.quat), place.pos)
        if frame.joint.joint_type == "fixed":
            joints.append(Joint(offset=before))
            continue
        joint = model.joint(frame.joint.name)
        anchor, axis = torch.from_numpy(joint.pos.copy()), torch.from_numpy(joint.axis.copy())
        before = before @ transform(position=anchor) @ _undone(frame.joint.joint_type, axis, float(joint.qpos0[0]))
        lower, upper = map(float, joint.range) if bool(joint.limited[0]) else (-math.inf, math.inf)
        joints.append(_joint(frame, before, axis, (lower, upper, math.inf)))
        joints.append(Joint(offset=transform(position=-anchor)))
    return joints


def joints_of_chain(chain: pytorch_kinematics.SerialChain) -> list[Joint]:
    """Joints of a chain that pytorch-kinematics has parsed, at the chain's own precision."""
    joints = []
    for frame in chain._serial_frames:
        speeds = frame.joint.velocity_limits
        lower, upper = frame.joint.limits or (-math.inf, math.inf)
        before = _fixed_part(frame.link) @ _fixed_part(frame.joint)
        joints.append(_joint(frame, before, frame.joint.axis, (lower, upper, speeds[1] if speeds else math.inf)))
    return joints


def _parse(language: str, build: Callable[[], pytorch_kinematics.Chain]) -> pytorch_kinematics.Chain:
    """What ``build`` returns; what the parser cannot read or handle, joint types among it, as one kind of error."""
    try:
        return build()
    except KeyError as error:
        raise InputError(
            f"the {language} text has a joint of type {error}; Arm handles fixed, revolute and prismatic joints"
        ) from error
    except Exception as error:
        raise InputError(f"the {language} text cannot be read: {error}") from error


def _frames_between(tree: pytorch_kinematics.Chain, base: str | None, tip: str) -> Sequence[Any]:
    import pytorch_kinematics as pk

    names = [name.strip() for name in tree.get_frame_names(exclude_fixed=False)]
    check_choice("link", tip, names)
    if base is not None:
        check_choice("link", base, names)
    try:
        chain = pk.SerialChain(tree, tip, base or "")
    except (KeyError, ValueError) as error:
        raise InputError(f"link {tip!r} does not hang from link {base!r}; choose a base nearer the root") from error
    return chain._serial_frames[1:]


def _joint(frame: Any, before: Tensor, axis: Any, limits: tuple[float, float, float]) -> Joint:
    kind = cast(Kind, frame.joint.joint_type)
    if kind == "fixed":
        return Joint(offset=before)
    direction = torch.as_tensor((1.0, 0.0, 0.0) if axis is None else axis, dtype=torch.float64)
    if not float(direction.norm()) > 0.0:
        raise InputError(f"joint {frame.joint.name!r} has no axis: {direction.tolist()}")
    lower, upper, speed = map(float, limits)
    axis = direction / direction.norm()
    return Joint(
        offset=before, kind=kind, axis=axis, name=frame.joint.name, lower=lower, upper=upper, speed_limit=speed
    )


def _urdf_limits(joint: Any) -> tuple[float, float, float]:
    """Lower, upper and speed limit; a continuous joint turns without end, and a speed of 0 means none was given."""
    limit = joint.limit
    if limit is None:
        return -math.inf, math.inf, math.inf
    lower, upper = (-math.inf, math.inf) if joint.type == "continuous" else (limit.lower or 0.0, limit.upper or 0.0)
    return lower, upper, limit.velocity or math.inf


def _origin(origin: Any) -> Tensor:
    """Transform of a URDF origin: fixed-axis roll, pitch, yaw."""
    if origin is None:
        return transform()
    axes = torch.eye(3, dtype=torch.float64)
    roll, pitch, yaw = (rotation_about(axis, angle) for axis, angle in zip(axes, origin.rpy or (0, 0, 0), strict=True))
    return transform(yaw @ pitch @ roll, origin.xyz or (0, 0, 0))


def _fixed_part(part: Any) -> Tensor:
    """Offset of a frame's link or joint."""
    return transform() if part.offset is None else part.offset.get_matrix()[0].to("cpu", torch.float64)


def _rotation_of_quaternion(quaternion: Any) -> Tensor:
    """Rotation ``(3, 3)`` of a quaternion wxyz."""
    w, x, y, z = (torch.as_tensor(quaternion.copy()) / math.hypot(*quaternion)).tolist()
    vector = torch.tensor([x, y, z], dtype=torch.float64)
    angle = 2.0 * math.atan2(float(vector.norm()), w)
    axis = vector / vector.norm() if float(vector.norm()) > 0.0 else vector
    return rotation_about(axis, angle)


def _undone(kind: str, axis: Tensor, reference: float) -> Tensor:
    """Motion of a joint by minus its reference, at which MuJoCo draws the model."""
    if kind == "prismatic":
        return transform(position=-reference * axis)
    return transform(rotation_about(axis, -reference))
