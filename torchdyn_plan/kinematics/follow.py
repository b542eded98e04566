"""Along a path of poses: joint positions within the limits of place and speed, a step of time after the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.descent import Search, descend, evaluate, residual_at
from torchdyn_plan.kinematics.solver import IKResult, IKStatus, inside_limits, reason, solve_rows
from torchdyn_plan.kinematics.targets import CONSTRAINTS, as_pose, as_rows, is_pose
from torchdyn_plan.precision import without_autocast

TIGHT = 0.1
"""Share of the tolerances within which the reference is kept, so that a slow target is followed and not stepped after."""
RETRY = 10
"""Steps after which a row that lost its target looks for another way to it again."""
RESTARTS = (1, 16)
"""Starts of such a search."""


class _State(NamedTuple):
    """Where each row stands."""

    q: Tensor
    """``(M, N)``, the joints."""
    reference: Tensor
    """``(M, N)``, where they would be if there were no speed limits."""
    target: Tensor
    """``(M, 4, 4)``, the last pose that was one."""
    lost: Tensor
    """``(M,)`` int64, steps for which the reference has not been at the target."""


def follow(
    arm: Arm,
    poses: Tensor,
    q0: Tensor,
    dt: float,
    *,
    constraint: str = "pose",
    symmetry: int = 1,
    position_tolerance: float = 1e-3,
    rotation_tolerance: float = math.radians(0.5),
    iterations: int = 8,
    posture: Tensor | None = None,
) -> IKResult:
    """Joint positions that follow ``poses`` from ``q0`` on, within the limits of place and of speed at every step.

    A reference goes with the target from where it was: its first step is what the target has moved (its velocity fed
    forward) and what was left before, further ones correct that. Where a limit or a singularity bars the way, the
    reference goes on from another solution, the nearest that is found. The joints go to the reference, all together
    and as fast as the slowest allows: they are at the target (`SOLVED`), or on the way to it (`LATE`).

    Args:
        arm: whose tool it is; without speed limits the joints are always at the reference.
        poses: ``(*B, T, 4, 4)``, base frame [m], the first to be reached after ``dt``; ``(*B, T, 3)`` will do for the
            constraint "position".
        q0: ``(*B, N)`` or ``(N,)``, the joints before the first step. From outside their limits they come back as fast
            as they can, and no step is `SOLVED` before they have.
        dt: time of a step [s].
        constraint: as of `solve_ik`.
        symmetry: as of `solve_ik`.
        position_tolerance: [m]
        rotation_tolerance: [rad]
        iterations: most steps of the reference for each pose.
        posture: ``(*B, N)`` or ``(N,)``, to which the motion that the constraint leaves free is drawn.

    Returns:
        As of `solve_ik`, with the time before the last dimensions: ``q`` (*B, T, N), ``status`` (*B, T), and
        ``residual`` (*B, T, 2). At a pose that is not one the joints stay; the row goes on after it.

    Raises:
        InputError: a shape, device, precision, name or number is wrong.
    """
    check_choice("constraint", constraint, CONSTRAINTS)
    check_number("symmetry", symmetry, minimum=1, integer=True)
    check_number("iterations", iterations, minimum=1, integer=True)
    check_number("dt", dt, minimum=1e-9)
    poses = as_pose(poses, arm, constraint, name="poses")
    if poses.ndim < 3:
        raise InputError(f"poses must have shape (*B, T, 4, 4), got {tuple(poses.shape)}")
    batch, steps = poses.shape[:-3], poses.shape[-3]
    with torch.no_grad():
        start = as_rows("q0", q0, arm, batch)
        rows = poses.detach().reshape(len(start), steps, 4, 4)
        posture = None if posture is None else as_rows("posture", posture, arm, batch)
        tolerances = position_tolerance, rotation_tolerance
        limit = torch.ones_like(arm.lower)
        search = Search(
            arm, rows[:, :0], arm.lower, arm.upper, constraint, symmetry, tolerances, iterations, limit, posture
        )
        found = without_autocast(follow_rows, search, rows, start, arm.speed_limit * dt)
    q, status, residual = found
    return IKResult(q.view(*batch, steps, -1), status.view(*batch, steps), residual.view(*batch, steps, 2))


def follow_rows(search: Search, poses: Tensor, start: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`follow` for rows: ``poses`` (M, T, 4, 4) from ``start`` (M, N), by at most ``reach`` (N,) a step."""
    count, steps, joints = len(start), poses.shape[1], start.shape[1]
    q, residual = start.new_empty(count, steps, joints), start.new_empty(count, steps, 2)
    status = torch.empty(count, steps, dtype=torch.int64, device=start.device)
    good = start.isfinite().all(dim=-1)
    inside = torch.where(good.unsqueeze(-1), inside_limits(search.arm, start), _finite(search.arm))
    state = _State(start, inside, evaluate(search.arm, inside)[0], good.to(torch.int64) * 0)
    for step in range(steps):
        valid = good & is_pose(poses[:, step], search.constraint)
        state = _advance(search, state, poses[:, step], valid, reach)
        q[:, step] = state.q
        status[:, step], residual[:, step] = _told(search, state, valid)
    return q, status, residual


def _advance(search: Search, state: _State, target: Tensor, valid: Tensor, reach: Tensor) -> _State:
    """The state one step of time later."""
    search = search._replace(target=torch.where(valid[:, None, None], target, state.target))
    tight = search._replace(tolerances=(TIGHT * search.tolerances[0], TIGHT * search.tolerances[1]))
    every = torch.arange(len(target), device=target.device)
    found, residual = descend(tight, state.reference.unsqueeze(1), every)
    reference, lost = found.squeeze(1), search.cost(residual.squeeze(1)) > 1.0
    retried = (lost & (state.lost % RETRY == 0) & valid).nonzero().squeeze(-1)
    if len(retried):
        reference[retried] = _another_way(search, state, retried, reference[retried])
        lost[retried] = search.cost(residual_at(search, reference[retried], retried)) > 1.0
    lost = torch.where(lost, state.lost + 1, 0)
    q = torch.where(valid.unsqueeze(-1), _towards(state.q, reference, reach), state.q)
    return _State(q, torch.where(valid.unsqueeze(-1), reference, state.reference), search.target, lost)


def _another_way(search: Search, state: _State, rows: Tensor, reference: Tensor) -> Tensor:
    """The nearest other solution to the joints of ``rows`` (A,); ``reference`` (A, N) where none is found."""
    posture = None if search.posture is None else search.posture[rows]
    weights = None if search.weights is None else search.weights[rows]
    part = search._replace(target=search.target[rows], posture=posture, weights=weights)
    start = state.q[rows]
    q, status, _ = solve_rows(part, start, inside_limits(search.arm, start), RESTARTS, 1)
    return torch.where(status == IKStatus.SOLVED, q.squeeze(1), reference)


def _towards(q: Tensor, reference: Tensor, reach: Tensor) -> Tensor:
    """``q`` (M, N) moved to ``reference`` (M, N), or on the straight way there by at most ``reach`` (N,)."""
    # So that not even rounding passes the speed limit.
    eps = torch.finfo(q.dtype).eps
    most = (reach - 4.0 * eps * (q.abs() + reach.nan_to_num(posinf=0.0))).clamp_min(0.0)
    way = reference - q
    tiny = torch.finfo(q.dtype).tiny
    worst = (way.abs() / most.clamp_min(tiny)).amax(dim=-1, keepdim=True)
    return torch.where(worst <= 1.0, reference, q + way / worst.clamp_min(1.0))


def _told(search: Search, state: _State, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Status ``(M,)`` and residual ``(M, 2)`` of where the joints are."""
    search = search._replace(target=state.target)
    every = torch.arange(len(valid), device=valid.device)
    q = torch.where(valid.unsqueeze(-1), state.q, state.reference)
    residual = residual_at(search, q, every)
    outside = ((q < search.arm.lower) | (q > search.arm.upper)).any(dim=-1)
    status = torch.full_like(state.lost, int(IKStatus.LATE))
    lost = (state.lost > 0).nonzero().squeeze(-1)
    if len(lost):
        status[lost] = reason(search, state.reference[lost], lost)
    status[search.cost(residual) <= 1.0] = int(IKStatus.SOLVED)
    status[outside] = int(IKStatus.LIMITED)
    status[~valid] = int(IKStatus.INVALID)
    return status, residual.masked_fill(~valid.unsqueeze(-1), torch.inf)


def _finite(arm: Arm) -> Tensor:
    """Some positions within the limits, ``(N,)``."""
    return torch.clamp(torch.zeros_like(arm.lower), arm.lower, arm.upper)
