"""Descriptions of arms for the tests, as URDF and as MJCF from one table."""

import math
from typing import NamedTuple

import torch

from torchdyn_plan.kinematics.joint import rotation_about, transform


class Row(NamedTuple):
    """A joint: place and fixed-axis roll, pitch, yaw from the previous frame, and how it moves."""

    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: str = "revolute"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lower: float = -3.0
    upper: float = 3.0


RIGHT, HALF = math.pi / 2, math.pi


def universal(d1, a2, a3, d4, d5, d6):
    """A UR arm from its DH parameters."""
    return [
        Row((0, 0, 0)),
        Row((0, 0, d1), (RIGHT, 0, 0)),
        Row((a2, 0, 0)),
        Row((a3, 0, 0)),
        Row((0, 0, d4), (RIGHT, 0, 0)),
        Row((0, 0, d5), (-RIGHT, 0, 0)),
        Row((0, 0, d6), kind="fixed"),
    ]


ARMS = {
    "ur5": universal(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur5e": universal(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10": universal(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "panda": [
        Row((0, 0, 0.333)),
        Row((0, 0, 0), (-RIGHT, 0, 0)),
        Row((0, -0.316, 0), (RIGHT, 0, 0)),
        Row((0.0825, 0, 0), (RIGHT, 0, 0)),
        Row((-0.0825, 0.384, 0), (-RIGHT, 0, 0)),
        Row((0, 0, 0), (RIGHT, 0, 0)),
        Row((0.088, 0, 0), (RIGHT, 0, 0)),
        Row((0, 0, 0.107), kind="fixed"),
    ],
    "iiwa": [
        Row((0, 0, 0.15)),
        Row((0, 0, 0.19), (RIGHT, 0, HALF)),
        Row((0, 0.21, 0), (RIGHT, 0, HALF)),
        Row((0, 0, 0.19), (RIGHT, 0, 0)),
        Row((0, 0.21, 0), (-RIGHT, HALF, 0)),
        Row((0, 0.0607, 0.19), (RIGHT, 0, 0)),
        Row((0, 0.081, 0.0607), (-RIGHT, HALF, 0)),
        Row((0, 0, 0.045), kind="fixed"),
    ],
    "scara": [
        Row((0, 0, 0.3)),
        Row((0.3, 0, 0)),
        Row((0.25, 0, 0), kind="prismatic", axis=(0, 0, -1)),
        Row((0, 0, -0.1)),
        Row((0, 0, -0.05), kind="fixed"),
    ],
    "gantry": [
        Row((0.1, 0, 1), kind="prismatic", axis=(1, 0, 0)),
        Row((0, 0.2, 0), (0.3, 0, 0), "prismatic", (0, 1, 0)),
        Row((0, 0, -0.2), (HALF, 0, 0)),
        Row((0.3, 0, 0), (RIGHT, 0, 0)),
        Row((0.2, 0, 0.1), kind="fixed"),
    ],
}
"""By name; frames ``link0`` (the base) to ``tool``."""


def names(rows):
    """Names of the frames that the rows lead to."""
    return [*(f"link{index + 1}" for index in range(len(rows) - 1)), "tool"]


def urdf(rows):
    """URDF text; every link has some mass, which pinocchio wants."""
    parts, parent = ['<robot name="arm"><link name="link0"/>'], "link0"
    for index, (row, name) in enumerate(zip(rows, names(rows), strict=True)):
        xyz, rpy, axis = (" ".join(map(repr, map(float, v))) for v in (row.xyz, row.rpy, row.axis))
        parts.append(
            f'<link name="{name}"/><joint name="joint{index}" type="{row.kind}"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            f'<limit lower="{row.lower!r}" upper="{row.upper!r}" effort="1" velocity="2"/></joint>'
        )
        parent = name
    return "".join([*parts, "</robot>"])


def quaternion(rpy):
    """Quaternion wxyz of fixed-axis roll, pitch, yaw, as text."""
    r, p, y = (0.5 * angle for angle in rpy)
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (r, p, y))
    values = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return " ".join(map(repr, values))


def mjcf(rows):
    """MJCF text, the tool a site."""
    text, closing = "", ""
    for index, (row, name) in enumerate(zip(rows, names(rows), strict=True)):
        xyz, axis = (" ".join(map(repr, map(float, v))) for v in (row.xyz, row.axis))
        place = f'name="{name}" pos="{xyz}" quat="{quaternion(row.rpy)}"'
        if name == "tool" and row.kind == "fixed":
            text += f"<site {place}/>"
            continue
        kind = {"revolute": "hinge", "prismatic": "slide"}.get(row.kind)
        joint = f'<joint name="joint{index}" type="{kind}" axis="{axis}" range="{row.lower} {row.upper}"/>'
        text += f'<body {place}>{joint if kind else ""}<geom size="0.01"/>'
        closing += "</body>"
    return f'<mujoco><compiler angle="radian"/><worldbody>{text}{closing}</worldbody></mujoco>'


def configurations(count, joints, seed=0, dtype=torch.float64, spread=3.0):
    """Random joint angles, ``(count, joints)``."""
    generator = torch.Generator().manual_seed(seed)
    return ((torch.rand(count, joints, generator=generator, dtype=torch.float64) * 2 - 1) * spread).to(dtype)


def product_of_transforms(rows, q):
    """Poses by the plain product of transforms, one configuration at a time: ``(B, N)`` -> ``(B, 4, 4)``."""
    poses = []
    for values in q.double():
        pose, index = torch.eye(4, dtype=torch.float64), 0
        for row in rows:
            axes = torch.eye(3, dtype=torch.float64)
            roll, pitch, yaw = (rotation_about(axis, angle) for axis, angle in zip(axes, row.rpy, strict=True))
            pose = pose @ transform(yaw @ pitch @ roll, row.xyz)
            axis = torch.tensor(row.axis, dtype=torch.float64)
            axis = axis / axis.norm()
            if row.kind == "revolute":
                pose = pose @ transform(rotation_about(axis, float(values[index])))
            if row.kind == "prismatic":
                pose = pose @ transform(position=values[index] * axis)
            index += row.kind != "fixed"
        poses.append(pose)
    return torch.stack(poses)
