"""Inverse kinematics for batches of targets: damped least squares from several starts, each row on its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number, check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step
from torchdyn_plan.kinematics.implicit import refine
from torchdyn_plan.kinematics.targets import CONSTRAINTS, constraint_error, constraint_jacobian
from torchdyn_plan.precision import without_autocast

BLOCK = 64
"""Rows of one product of matrices: a fixed number, so that a row's answer does not depend on its company."""
ROUNDS = (1, 4, 16, 64)
"""Starts that a row still unsolved is given, side by side, in each round."""


class IKStatus(IntEnum):
    """How a row of `solve_ik` ended."""

    SOLVED = 0
    """Within the tolerances and the joints' limits."""
    UNREACHED = 1
    """No start came within the tolerances."""
    SINGULAR = 2
    """As `UNREACHED`, in a singular configuration: stretched out to a target beyond its reach, or axes in line."""
    LIMITED = 3
    """As `UNREACHED`, with a joint at its limit."""
    INVALID = 4
    """The target or the start is NaN or infinite, or the target's rotation is not one; nothing was solved."""


class IKResult(NamedTuple):
    """What `solve_ik` found."""

    q: Tensor
    """``(*B, N)`` [rad; m]; the nearest that was found where the row is not solved, the start where it is invalid."""
    status: Tensor
    """``(*B,)``, integers of `IKStatus`."""
    residual: Tensor
    """``(*B, 2)``, distance of place [m] and of direction [rad] from the target; infinite where the row is invalid."""


class _Search(NamedTuple):
    """What every row shares."""

    arm: Arm
    constraint: str
    symmetry: int
    tolerances: tuple[float, float]
    iterations: int
    max_step: Tensor
    posture: Tensor | None


def solve_ik(
    arm: Arm,
    target: Tensor,
    *,
    q0: Tensor | None = None,
    constraint: str = "pose",
    symmetry: int = 1,
    position_tolerance: float = 1e-3,
    rotation_tolerance: float = math.radians(0.5),
    iterations: int = 16,
    rounds: Sequence[int] = ROUNDS,
    max_step: float | Tensor = 1.0,
    posture: Tensor | None = None,
    differentiable: bool = False,
) -> IKResult:
    """Joint positions at which the tool is at ``target``, by damped least squares with restarts.

    A row is never disturbed by another: bad rows are told by their status, and a row alone has the same answer as in
    a batch. The starts after the first are the same for every row.

    Args:
        arm: whose tool it is.
        target: ``(*B, 4, 4)``, base frame [m]; ``(*B, 3)`` will do for the constraint "position".
        q0: start of the first round, ``(*B, N)`` or ``(N,)``; a fixed one by default.
        constraint: "pose", "axis" (place, and direction of the tool's z axis: yaw is free) or "position".
        symmetry: for the constraint "pose", the tool is the same after one ``symmetry``-th of a turn about its z axis.
        position_tolerance: [m]
        rotation_tolerance: [rad]
        iterations: most steps from one start.
        rounds: number of starts, side by side, in each round; rows solved in one do not enter the next.
        max_step: most that any joint moves in one step, a number or ``(N,)`` [rad; m].
        posture: ``(*B, N)`` or ``(N,)``, to which the motion that the constraint leaves free is drawn.
        differentiable: give ``q`` derivatives in ``target`` and the arm's own tensors, see `implicit.refine`.

    Raises:
        InputError: a shape, device, precision, name or number is wrong.
    """
    check_choice("constraint", constraint, CONSTRAINTS)
    check_number("symmetry", symmetry, minimum=1, integer=True)
    check_number("iterations", iterations, minimum=1, integer=True)
    target = _as_pose(target, arm, constraint)
    batch, count = target.shape[:-2], arm.num_joints
    with torch.no_grad():
        wanted = target.detach().reshape(-1, 4, 4)
        posture = None if posture is None else _rows("posture", posture, arm, batch)
        limit = torch.as_tensor(max_step, dtype=wanted.dtype, device=wanted.device).expand(count)
        tolerances = position_tolerance, rotation_tolerance
        search = _Search(arm, constraint, symmetry, tolerances, iterations, limit, posture)
        starts = _starts(arm, sum(rounds))
        first = starts[:1].expand(len(wanted), count) if q0 is None else _rows("q0", q0, arm, batch)
        q, status, residual = without_autocast(_solve_rows, search, wanted, first, starts, rounds)
    result = IKResult(q.view(*batch, count), status.view(batch), residual.view(*batch, 2))
    if not differentiable:
        return result
    return result._replace(
        q=refine(arm, target, result.q, result.status == 0, constraint=constraint, symmetry=symmetry)
    )


def _as_pose(target: Tensor, arm: Arm, constraint: str) -> Tensor:
    """``target`` as poses, checked."""
    if constraint == "position" and isinstance(target, Tensor) and target.shape[-1:] == (3,):
        place = target.unsqueeze(-1)
        eye = torch.eye(4, dtype=target.dtype, device=target.device).expand(*place.shape[:-2], 4, 4)
        return torch.cat([eye[..., :3], torch.cat([place, torch.ones_like(place[..., :1, :])], dim=-2)], dim=-1)
    check_trailing_shape("target", target, 4, 4)
    _check_like("target", target, arm)
    return target


def _check_like(name: str, value: Tensor, arm: Arm) -> None:
    check_same_device(name, value, arm.lower.device, "the arm")
    if value.dtype != arm.lower.dtype:
        raise InputError(f"{name} is {value.dtype}, but the arm is {arm.lower.dtype}: convert one of them")


def _rows(name: str, value: Tensor, arm: Arm, batch: torch.Size) -> Tensor:
    """Joint positions ``(*B, N)`` or ``(N,)`` as rows ``(M, N)``, checked."""
    check_trailing_shape(name, value, arm.num_joints)
    _check_like(name, value, arm)
    if value.shape[:-1] not in (batch, torch.Size()):
        check_trailing_shape(name, value, *batch, arm.num_joints)
    return value.detach().expand(*batch, arm.num_joints).reshape(-1, arm.num_joints)


def _starts(arm: Arm, count: int) -> Tensor:
    """Joint positions spread over the limits, ``(count, N)``, always the same; more than a turn is the same again.

    Roberts' additive recurrence: frac(½ + k φ⁻ⁱ), with φ the root of φᴺ⁺¹ = φ + 1.
    """
    ratio = 2.0
    for _ in range(40):
        ratio = (1.0 + ratio) ** (1.0 / (arm.num_joints + 1))
    steps = ratio ** -torch.arange(1.0, arm.num_joints + 1.0, dtype=torch.float64)
    unit = (0.5 + torch.arange(1.0, count + 1.0, dtype=torch.float64).unsqueeze(-1) * steps).frac()
    lower, upper = arm.lower.clamp(min=-math.pi), arm.upper.clamp(max=math.pi)
    return lower + (upper - lower) * unit.to(lower)


def _solve_rows(
    search: _Search, target: Tensor, first: Tensor, starts: Tensor, rounds: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Best positions (M, N), status (M,) and residuals (M, 2) for targets (M, 4, 4)."""
    valid = _is_pose(target, search.constraint) & first.isfinite().all(dim=-1)
    if search.posture is not None:
        valid &= search.posture.isfinite().all(dim=-1)
    q, residual = first.clone(), torch.full((len(target), 2), torch.inf, dtype=first.dtype, device=first.device)
    open_rows, begin = valid.nonzero().squeeze(-1), 0
    for number in rounds:
        if not len(open_rows):
            break
        tries = starts[begin : begin + number].expand(len(open_rows), number, -1)
        if begin == 0:
            tries = torch.cat([first[open_rows].unsqueeze(1), tries[:, 1:]], dim=1)
        begin += number
        reached, left = _descend(search, target, tries, open_rows)
        nearer = _cost(search, left) < _cost(search, residual[open_rows])
        q[open_rows] = torch.where(nearer.unsqueeze(-1), reached, q[open_rows])
        residual[open_rows] = torch.where(nearer.unsqueeze(-1), left, residual[open_rows])
        open_rows = open_rows[_cost(search, left) > 1.0]
    status = torch.where(valid, int(IKStatus.SOLVED), int(IKStatus.INVALID))
    if len(open_rows):
        status[open_rows] = _reason(search, q[open_rows], target[open_rows])
    return q, status, residual


def _descend(search: _Search, target: Tensor, tries: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """From ``tries`` (A, S, N) towards ``target[rows]``: positions (A, N) and residuals (A, 2) of each row's best try.

    A row is left alone from the step at which its first try is within the tolerances.
    """
    count, number, joints = tries.shape
    best = tries[:, 0].clone()
    residual = torch.full((count, 2), torch.inf, dtype=best.dtype, device=best.device)
    here, q = torch.arange(count, device=rows.device), tries.reshape(-1, joints)
    for iteration in range(search.iterations + 1):
        index = rows[here].repeat_interleave(number)
        wanted = target[index]
        pose, jacobian = _evaluate(search.arm, q)
        error = constraint_error(pose, wanted, constraint=search.constraint, symmetry=search.symmetry)
        left = torch.stack([error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)], dim=-1).view(-1, number, 2)
        cost, chosen = _cost(search, left).min(dim=1)
        nearer = cost < _cost(search, residual[here])
        row = torch.arange(len(here), device=here.device)
        best[here] = torch.where(nearer.unsqueeze(-1), q.view(-1, number, joints)[row, chosen], best[here])
        residual[here] = torch.where(nearer.unsqueeze(-1), left[row, chosen], residual[here])
        going = cost > 1.0
        if iteration == search.iterations or not bool(going.any()):
            break
        rows_jacobian = constraint_jacobian(jacobian, wanted, constraint=search.constraint)
        q = _stepped(search, q, rows_jacobian, error, None if search.posture is None else search.posture[index])
        here, q = here[going], q.view(-1, number, joints)[going].reshape(-1, joints)
    return best, residual


def _stepped(search: _Search, q: Tensor, jacobian: Tensor, error: Tensor, posture: Tensor | None) -> Tensor:
    """One step of Levenberg and Marquardt (Sugihara 2011: λ² grows with the error), within limits of step and joint."""
    square = (error * error).sum(dim=-1)
    damping = (0.1 * square + _least_damping(q.dtype)).sqrt()
    preferred = None if posture is None else 0.3 * (posture - q)
    step = dls_step(jacobian, error, damping, preferred=preferred)
    worst = (step.abs() / search.max_step).amax(dim=-1, keepdim=True)
    return torch.clamp(q + step / worst.clamp_min(1.0), search.arm.lower, search.arm.upper)


def _least_damping(dtype: torch.dtype) -> float:
    """λ² at the target: what keeps the squares of singular values apart from rounding."""
    return 1e-8 if dtype == torch.float64 else 1e-5


def _evaluate(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and Jacobians for ``(M, N)``, by products of always `BLOCK` rows."""
    padded = torch.nn.functional.pad(q, (0, 0, 0, -len(q) % BLOCK))
    parts = [arm.pose_and_jacobian(block) for block in padded.split(BLOCK)]
    pose, jacobian = (torch.cat(part)[: len(q)] for part in zip(*parts, strict=True))
    return pose, jacobian


def _cost(search: _Search, residual: Tensor) -> Tensor:
    """Residuals ``(*B, 2)`` in units of their tolerances, the worse of both: at most 1 where solved."""
    place, direction = search.tolerances
    return torch.maximum(residual[..., 0] / place, residual[..., 1] / direction)


def _is_pose(target: Tensor, constraint: str) -> Tensor:
    """Whether targets ``(M, 4, 4)`` are finite, and their rotations orthonormal where the constraint has any."""
    finite = target.isfinite().all(dim=-1).all(dim=-1)
    if constraint == "position":
        return finite
    rotation = target[:, :3, :3]
    off = rotation.mT @ rotation - torch.eye(3, dtype=target.dtype, device=target.device)
    right_handed = (torch.linalg.cross(rotation[..., 0], rotation[..., 1]) * rotation[..., 2]).sum(dim=-1) > 0.0
    return finite & (off.abs().amax(dim=(-2, -1)) < 1e-3) & right_handed


def _reason(search: _Search, q: Tensor, target: Tensor) -> Tensor:
    """Status (M,) of rows that were not solved."""
    _, jacobian = _evaluate(search.arm, q)
    values = torch.linalg.svdvals(constraint_jacobian(jacobian, target, constraint=search.constraint))
    at_limit = ((q <= search.arm.lower) | (q >= search.arm.upper)).any(dim=-1)
    status = torch.where(at_limit, int(IKStatus.LIMITED), int(IKStatus.UNREACHED))
    return torch.where(values[:, -1] < 0.02 * values[:, 0], int(IKStatus.SINGULAR), status)
