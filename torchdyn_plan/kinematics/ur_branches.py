"""All IK solutions of a UR arm in closed form: three parallel axes, and all other neighbouring axes intersect.

The chain is brought to Denavit and Hartenberg's form T = Rz(q₁)Rx(½π) Rz(q₂)Tx(a₂) Rz(q₃)Tx(a₃) Rz(q₄)Tz(d₄)Rx(½π)
Rz(q₅)Tz(d₅)Rx(-½π) Rz(q₆) between a constant base and a constant tool, and solved as by Hawkins (Analytic Inverse
Kinematics for the Universal Robots UR-5/UR-10 Arms, 2013), by sines and cosines alone up to the last step.
"""

from __future__ import annotations

import math
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.implicit import refine
from torchdyn_plan.kinematics.joint import Joint, merge_fixed
from torchdyn_plan.kinematics.nearest import turned_towards
from torchdyn_plan.kinematics.targets import as_pose, as_rows, is_pose
from torchdyn_plan.precision import without_autocast

NUMBER = 8
"""Most solutions of a pose: two of the shoulder, each with two of the wrist, each with two of the elbow."""
EXACT = 1e-5
"""Largest sine of the angle between parallel axes, and largest distance between intersecting ones [m]."""
SLACK = 0.6
"""An angle outside its limits by at most eps to this power is clamped [rad].

Near singular positions, angles are only accurate to the square root of eps.
"""
BLOCK = 64
"""Rows per matrix product: a fixed number, so that a row's result does not depend on the batch."""


class Branches(NamedTuple):
    """All solutions of each pose."""

    q: Tensor
    """``(*B, 8, 6)`` [rad]; finite but meaningless where not valid."""
    valid: Tensor
    """``(*B, 8)`` bool: reaches the pose within the limits. In a singular configuration two may be equal."""


class Universal(NamedTuple):
    """Constants of an arm of the UR family; its joints' angles are ``sign * q + offset`` in the form above."""

    to_base: Tensor
    """``(4, 4)`` float64, from the arm's base frame to that of the form."""
    from_tool: Tensor
    """``(4, 4)`` float64, from the tool to the last frame of the form."""
    sign: Tensor
    """``(6,)`` float64"""
    offset: Tensor
    """``(6,)`` float64 [rad]"""
    lengths: tuple[float, float, float, float]
    """a₂, a₃, d₄, d₅ [m]"""


def branches(arm: Arm, target: Tensor, *, q0: Tensor | None = None, differentiable: bool = False) -> Branches:
    """All joint positions of a UR arm at which its tool is at ``target``.

    Args:
        arm: six revolute joints; axes 2, 3 and 4 are parallel, 1 and 2, 4 and 5, 5 and 6 intersect at right angles.
        target: ``(*B, 4, 4)``, base frame [m].
        q0: ``(*B, 6)`` or ``(6,)``; joints are turned by 2π towards it within their limits, and its last joint is kept
            if axes 4 and 6 are in line. The middle of the limits by default.
        differentiable: give ``q`` gradients with respect to ``target`` and the arm's tensors, see `implicit.refine`.

    Raises:
        InputError: the arm is not a UR arm, or a shape, device or precision is wrong.
    """
    form = universal(arm)
    if isinstance(form, str):
        raise InputError(f"branches handles arms of the UR family only: {form}")
    target = as_pose(target, arm, "pose")
    batch = target.shape[:-2]
    with torch.no_grad():
        rows = target.detach().reshape(-1, 4, 4)
        near = torch.zeros_like(arm.lower) if q0 is None else q0
        start = as_rows("q0", near, arm, batch)
        q, valid = without_autocast(all_branches, form, arm, rows, start, arm.lower, arm.upper)
        valid = valid & is_pose(rows, "pose").unsqueeze(-1)
    q, valid = q.view(*batch, NUMBER, 6), valid.view(*batch, NUMBER)
    if differentiable:
        q = refine(arm, target.unsqueeze(-3).expand(*batch, NUMBER, 4, 4), q, valid)
    return Branches(q, valid)


_KNOWN: WeakKeyDictionary[Arm, Universal | str] = WeakKeyDictionary()


def universal(arm: Arm) -> Universal | str:
    """The arm's constants, or why it has none."""
    if arm not in _KNOWN:
        with torch.no_grad():
            _KNOWN[arm] = _universal(*merge_fixed(arm.part_settings()["joints"]))
    return _KNOWN[arm]


def all_branches(  # noqa: PLR0917  # All are needed.
    form: Universal, arm: Arm, target: Tensor, start: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Solutions ``(M, 8, 6)`` of ``target`` (M, 4, 4) near ``start`` (M, 6), and which are valid, ``(M, 8)``."""
    # Joints first and rows last: whole columns at a time.
    sign, offset = form.sign.to(target).view(6, 1, 1), form.offset.to(target).view(6, 1, 1)
    lower, upper = (limit.reshape(-1, 6).T.unsqueeze(1).contiguous() for limit in (lower, upper))
    start = start.T.contiguous().unsqueeze(1)
    angles, solvable = _angles(form, target, (sign * start + offset)[5, 0])
    # For a joint at its limit, rounding alone may lead outside.
    slack, valid = torch.finfo(target.dtype).eps ** SLACK, solvable
    q = turned_towards((angles - offset) * sign, start, lower - slack, upper + slack)
    for column, least, most in zip(q, lower - slack, upper + slack, strict=True):
        valid = valid & (column >= least) & (column <= most)
    q = torch.clamp(q, lower, upper)
    return q.nan_to_num(0.0, 0.0, 0.0).permute(2, 1, 0).contiguous(), valid.T.contiguous()


def tool_turns(target: Tensor, symmetry: int) -> Tensor:
    """The poses ``(M, symmetry, 4, 4)`` that are equivalent for a tool with this rotational symmetry about z."""
    angle = torch.arange(symmetry, dtype=torch.float64) * (2.0 * math.pi / symmetry)
    turns = torch.eye(4, dtype=torch.float64).repeat(symmetry, 1, 1)
    turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    return target.unsqueeze(1) @ turns.to(target)


def _angles(form: Universal, target: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Angles of the form, ``(6, 8, M)``, and which solve it, ``(8, M)``; ``last`` (M,) is kept where q₆ is free.

    Entries have the rows last, ``(M,)``, and two signs for each choice before them: shoulder, wrist, elbow.
    """
    upper_arm, forearm, shoulder, wrist = form.lengths
    eps = torch.finfo(target.dtype).eps
    (x1, y1, z1, px), (x2, y2, z2, py), (x3, y3, _, pz) = _entries(form, target)
    sides = target.new_tensor([1.0, -1.0]).unsqueeze(-1)

    # The wrist centre lies at distance d₄ from the plane in which the arm bends: s₁ px - c₁ py = d₄.
    reach = px * px + py * py
    square = reach - shoulder**2
    root, reach = sides * square.clamp_min(0.0).sqrt(), reach.clamp_min(eps**2)
    sin1, cos1 = (py * root + px * shoulder) / reach, (px * root - py * shoulder) / reach

    # The axis of joint 2 in the last frame is (s₅c₆, -s₅s₆, c₅).
    cos5 = sin1 * z1 - cos1 * z2
    cos6, sin6 = sin1 * x1 - cos1 * x2, cos1 * y2 - sin1 * y1
    sin5 = (cos6 * cos6 + sin6 * sin6).sqrt()
    free = sin5 < eps**0.5
    sin5_or_1 = torch.where(free, 1.0, sin5)
    cos6, sin6 = torch.where(free, last.cos(), cos6 / sin5_or_1), torch.where(free, last.sin(), sin6 / sin5_or_1)

    # Axis 5 in the plane of the arm, for the first wrist; for the second it points the other way.
    along = -(sin6 * (cos1 * x1 + sin1 * x2) + cos6 * (cos1 * y1 + sin1 * y2))
    above = -(sin6 * x3 + cos6 * y3)
    way = sides * wrist
    x = (cos1 * px + sin1 * py).unsqueeze(1) - way * along.unsqueeze(1)
    y = pz - way * above.unsqueeze(1)

    # Two links that reach (x, y).
    cos3 = (x * x + y * y - (upper_arm**2 + forearm**2)) / (2.0 * upper_arm * forearm)
    solvable = (square >= -8.0 * eps) & (cos3.abs() <= 1.0 + 64.0 * eps)
    cos3 = cos3.clamp(-1.0, 1.0)
    sin3 = ((1.0 - cos3) * (1.0 + cos3)).sqrt()
    near, aside = (upper_arm + forearm * cos3).unsqueeze(2), sides * (forearm * sin3).unsqueeze(2)
    x, y = x.unsqueeze(2), y.unsqueeze(2)
    sin2, cos2 = near * y - aside * x, near * x + aside * y

    count = len(target)
    pairs = ((sin1, cos1), (sin5, cos5), (sin6, cos6), (along, -above), (sin3, cos3), (sin2, cos2))
    sines, cosines = (torch.cat([pair[i].flatten(0, -2) for pair in pairs]) for i in range(2))
    q1, q5, q6, sum234, q3, q2 = _angle(sines, cosines).split((2, 2, 2, 2, 4, 8))
    half_turn = math.pi * (1.0 - sides) * 0.5
    q5, q6 = sides * q5.unsqueeze(1), q6.unsqueeze(1) + half_turn
    q3, q2 = sides * q3.view(2, 2, 1, count), q2.view(2, 2, 2, count)
    q4 = (sum234.unsqueeze(1) + half_turn).unsqueeze(2) - q2 - q3
    columns = (q1.view(2, 1, 1, count), q2, q3, q4, q5.unsqueeze(2), q6.unsqueeze(2))
    angles = torch.stack([column.expand(2, 2, 2, count) for column in columns])
    solvable = solvable.unsqueeze(2).expand(2, 2, 2, count)
    return angles.view(6, NUMBER, count), solvable.reshape(NUMBER, count)


def _angle(sine: Tensor, cosine: Tensor) -> Tensor:
    """The angle of (cosine, sine), of any length; the rounding of `torch.atan2` depends on a row's position."""
    length = (sine * sine + cosine * cosine).sqrt()
    tangent = sine / (length + cosine.abs()).clamp_min(torch.finfo(sine.dtype).tiny)
    back, angle = cosine < 0, 2.0 * tangent.atan()
    return torch.where(back, torch.copysign(torch.full_like(sine, math.pi), sine) - angle, angle)


def _entries(form: Universal, target: Tensor) -> list[list[Tensor]]:
    """Rows of the target's pose in the form, three times four entries ``(M,)``."""
    # A pose laid out flat, A T B, is T's times (A ⊗ Bᵀ)ᵀ.
    matrix = torch.kron(form.to_base[:3].contiguous(), form.from_tool.T.contiguous()).T.to(target)
    flat = torch.nn.functional.pad(target.reshape(-1, 16), (0, 0, 0, -len(target) % BLOCK))
    rows = torch.cat([block @ matrix for block in flat.split(BLOCK)])[: len(target)]
    entries = rows.T.contiguous().unbind(0)
    return [list(entries[start : start + 4]) for start in (0, 4, 8)]


def _universal(joints: list[Joint], tool: Tensor) -> Universal | str:
    """Constants of a chain, or why it is not of the family."""
    if len(joints) != 6 or any(joint.kind != "revolute" for joint in joints):
        return f"it has {len(joints)} joints of kinds {', '.join(joint.kind for joint in joints)}, not 6 revolute ones"
    if any(joint.coupling is not None for joint in joints):
        return "some of its joints move together"
    axes, places, end = _lines(joints, tool)
    for first, second in ((1, 2), (2, 3)):
        if torch.linalg.cross(axes[first], axes[second]).norm() > EXACT:
            return f"its axes {first + 1} and {second + 1} are not parallel"
    for first, second in ((0, 1), (3, 4), (4, 5)):
        way = places[second] - places[first]
        if (axes[first] @ axes[second]).abs() > EXACT:
            return f"its axes {first + 1} and {second + 1} are not at right angles"
        if (way @ torch.linalg.cross(axes[first], axes[second])).abs() > EXACT:
            return f"its axes {first + 1} and {second + 1} do not intersect"
    return _constants(axes, places, end)


def _constants(axes: list[Tensor], places: list[Tensor], end: Tensor) -> Universal | str:
    """Constants of the form, from the axes' directions and places where all joints are at 0."""
    up, side = axes[0], axes[1]
    forward = torch.linalg.cross(up, side)
    origin = _crossing(places[0], up, places[1])
    base = _frame(forward, -side, up, origin)

    def planar(vector: Tensor) -> tuple[float, float, float]:
        """Components in the plane of the arm, and the angle there."""
        x, y = float(vector @ forward), float(vector @ up)
        return x, y, math.atan2(y, x)

    x2, y2, angle2 = planar(places[2] - origin)
    x3, y3, angle3 = planar(places[3] - places[2])
    upper_arm, forearm = math.hypot(x2, y2), math.hypot(x3, y3)
    if min(upper_arm, forearm) < 1e-3:
        return "two of its parallel axes are the same"
    elbow = _crossing(places[3], side, places[4])
    centre = _crossing(places[4], axes[4], places[5])
    sum234 = planar(axes[4])[2] + 0.5 * math.pi
    across = math.cos(sum234) * forward + math.sin(sum234) * up
    sin5, cos5 = -float(axes[5] @ across), float(axes[5] @ side)
    last_x = cos5 * across + sin5 * side
    last = _frame(last_x, torch.linalg.cross(axes[5], last_x), axes[5], centre)
    sign = [1.0, 1.0, float((axes[2] @ side).sign()), float((axes[3] @ side).sign()), 1.0, 1.0]
    offset = [0.0, angle2, angle3 - angle2, sum234 - angle3, math.atan2(sin5, cos5), 0.0]
    return Universal(
        to_base=torch.linalg.inv(base),
        from_tool=torch.linalg.inv(end) @ last,
        sign=torch.tensor(sign, dtype=torch.float64),
        offset=torch.tensor(offset, dtype=torch.float64),
        lengths=(upper_arm, forearm, float((elbow - origin) @ side), float((centre - elbow) @ axes[4])),
    )


def _lines(joints: list[Joint], tool: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Directions and places of the axes, and the tool's pose, where all joints are at 0."""
    axes, places, frame = [], [], torch.eye(4, dtype=torch.float64)
    for joint in joints:
        assert joint.axis is not None
        frame = frame @ joint.offset.detach()
        axes.append(frame[:3, :3] @ joint.axis)
        places.append(frame[:3, 3])
    return axes, places, frame @ tool.detach()


def _crossing(place: Tensor, axis: Tensor, other: Tensor) -> Tensor:
    """Where the line through ``place`` along ``axis`` meets a line through ``other`` at right angles."""
    return place + axis * ((other - place) @ axis)


def _frame(x: Tensor, y: Tensor, z: Tensor, place: Tensor) -> Tensor:
    """The pose ``(4, 4)`` of these axes at this place."""
    top = torch.stack([x, y, z, place], dim=-1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
