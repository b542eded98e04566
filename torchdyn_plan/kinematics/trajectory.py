"""Joint trajectories along a path of poses, within position and speed limits, one time step after another."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.descent import Search, descend, evaluate, residual_at
from torchdyn_plan.kinematics.nearest import speeds
from torchdyn_plan.kinematics.solver import IKResult, IKStatus, check_task, inside_limits, reason, solve_rows
from torchdyn_plan.kinematics.targets import as_pose, as_rows, is_pose
from torchdyn_plan.precision import without_autocast

TIGHT = 0.1
"""Share of the tolerances at which a step ends, so that a slow target is followed smoothly."""
PATIENCE = 5
"""Number of steps without reaching the target after which a row searches for another solution."""
RESTARTS = (1, 16)
"""Starts of that search."""
FULL_SPEED = 0.999
"""Share of its speed limit from which a joint counts as moving at full speed."""


class _State(NamedTuple):
    """State of each row."""

    q: Tensor
    """``(M, N)``, the joints."""
    reference: Tensor
    """``(M, N)``, their goal while they change over to another solution."""
    changing: Tensor
    """``(M,)`` bool: on the way to another solution."""
    late: Tensor
    """``(M,)`` int64, steps since the joints were at the target."""
    target: Tensor
    """``(M, 4, 4)``, the last valid pose."""


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
    """Joint positions that follow ``poses`` from ``q0``, within position and speed limits at every step.

    At every step the joints move as close to the pose as possible within ``dt``: first by the target's motion (velocity
    feed-forward) plus the remaining error, then by corrections. Slow joints are weighted to move less. A joint at a
    position or speed limit is left out, and the others do the work. A row that does not reach its target for `PATIENCE`
    steps changes over to the nearest other solution, in a straight line and as fast as its slowest joint allows, while
    the target moves on.

    Args:
        arm: the arm. Joints without a speed limit may move arbitrarily fast.
        poses: ``(*B, T, 4, 4)``, base frame [m], the first to be reached after ``dt``; or ``(*B, T, 3)`` for the
            constraint "position".
        q0: ``(*B, N)`` or ``(N,)``, the joints before the first step. If they are outside their limits they return as
            fast as possible, and no step is `SOLVED` before that.
        dt: time of a step [s].
        constraint: see `solve_ik`.
        symmetry: see `solve_ik`.
        position_tolerance: [m]
        rotation_tolerance: [rad]
        iterations: most iterations for each pose.
        posture: ``(*B, N)`` or ``(N,)``, preferred joint positions in the null space of the constraint.

    Returns:
        As `solve_ik`, with the time dimension after the batch: ``q`` (*B, T, N), ``status`` (*B, T), and ``residual``
        (*B, T, 2). At an invalid pose the joints stay; the row continues after it.

    Raises:
        InputError: a shape, device, precision, name or number is wrong.
    """
    check_task(constraint, symmetry, position_tolerance, rotation_tolerance, iterations)
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
        search = following(arm, constraint, symmetry, tolerances, iterations)._replace(posture=posture)
        found = without_autocast(follow_rows, search, rows, start, arm.speed_limit * dt)
    q, status, residual = found
    return IKResult(q.view(*batch, steps, arm.num_joints), status.view(*batch, steps), residual.view(*batch, steps, 2))


def following(arm: Arm, constraint: str, symmetry: int, tolerances: tuple[float, float], iterations: int) -> Search:
    """A search whose target poses are set later."""
    speed, none = speeds(arm), arm.lower.new_zeros(0, 4, 4)
    step = torch.ones_like(speed)
    ease = None if bool((speed == speed[0]).all()) else speed / speed.max()
    search = Search(arm, none, arm.lower, arm.upper, constraint, symmetry, tolerances, iterations, step)
    return search._replace(ease=ease)


def follow_rows(
    search: Search, poses: Tensor, start: Tensor, reach: Tensor, *, patience: int = PATIENCE
) -> tuple[Tensor, Tensor, Tensor]:
    """`follow` for rows: ``poses`` (M, T, 4, 4) from ``start`` (M, N), at most ``reach`` (N,) per step."""
    count, steps, joints = len(start), poses.shape[1], start.shape[1]
    q, residual = start.new_empty(count, steps, joints), start.new_empty(count, steps, 2)
    status = torch.empty(count, steps, dtype=torch.int64, device=start.device)
    good = start.isfinite().all(dim=-1)
    clamped = torch.clamp(start, search.arm.lower, search.arm.upper)
    inside = torch.where(good.unsqueeze(-1), clamped, _finite(search.arm))
    outside = good & (inside != start).any(dim=-1)
    late = torch.zeros(count, dtype=torch.int64, device=start.device)
    state = _State(start, inside, outside, late, evaluate(search.arm, inside)[0])
    for step in range(steps):
        valid = good & is_pose(poses[:, step], search.constraint)
        before, state = state.q, _advance(search, state, poses[:, step], valid, reach, patience)
        q[:, step] = state.q
        status[:, step], residual[:, step] = _told(search, state, before, valid, reach)
    return q, status, residual


def _advance(  # noqa: PLR0917  # One step of a loop over all of them.
    search: Search, state: _State, target: Tensor, valid: Tensor, reach: Tensor, patience: int
) -> _State:
    """The state one time step later."""
    search = search._replace(target=torch.where(valid[:, None, None], target, state.target))
    q, reference, changing, late = (value.clone() for value in state[:4])
    rows = (valid & ~changing).nonzero().squeeze(-1)
    if len(rows):
        q[rows], solved = _follow_on(search, q[rows], rows, reach)
        late[rows] = torch.where(solved, 0, late[rows] + 1)
        reference[rows] = q[rows]
    lost = (valid & ~changing & (late > 0) & (late % patience == 0)).nonzero().squeeze(-1)
    if len(lost):
        reference[lost], changing[lost] = _another_way(search, state.q[lost], lost)
        q[lost] = torch.where(changing[lost].unsqueeze(-1), _towards(state.q[lost], reference[lost], reach), q[lost])
    rows = (valid & state.changing).nonzero().squeeze(-1)
    if len(rows):
        reference[rows] = descend(_tight(search), reference[rows].unsqueeze(1), rows)[0].squeeze(1)
        q[rows] = _towards(q[rows], reference[rows], reach)
    changing &= (q != reference).any(dim=-1)
    return _State(q, reference, changing, late, search.target)


def _tight(search: Search) -> Search:
    return search._replace(tolerances=(TIGHT * search.tolerances[0], TIGHT * search.tolerances[1]))


def _follow_on(search: Search, q: Tensor, rows: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """The closest to the target that one step from ``q`` (A, N) reaches, and whether it is reached, ``(A,)``."""
    most = _within(q, reach)
    lower, upper = torch.maximum(search.arm.lower, q - most), torch.minimum(search.arm.upper, q + most)
    part = _rows_of(search, rows)._replace(lower=lower, upper=upper)
    found, residual = descend(_tight(part), q.unsqueeze(1), torch.arange(len(rows), device=rows.device))
    return found.squeeze(1), search.cost(residual.squeeze(1)) <= 1.0


def _another_way(search: Search, q: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The solution nearest to ``q`` (A, N), and whether there is one, ``(A,)``."""
    found, status, _ = solve_rows(_rows_of(search, rows), q, inside_limits(search.arm, q), RESTARTS, 1)
    solved = status.squeeze(1) == IKStatus.SOLVED
    return torch.where(solved.unsqueeze(-1), found.squeeze(1), q), solved


def _rows_of(search: Search, rows: Tensor) -> Search:
    """The search restricted to some rows."""
    posture = None if search.posture is None else search.posture[rows]
    weights = None if search.weights is None else search.weights[rows]
    return search._replace(target=search.target[rows], posture=posture, weights=weights)


def _within(q: Tensor, reach: Tensor) -> Tensor:
    """Largest step of joints at ``q`` (*B, N): ``reach`` (N,) minus a margin for rounding."""
    eps = torch.finfo(q.dtype).eps
    return (reach - 4.0 * eps * (q.abs() + reach.nan_to_num(posinf=0.0))).clamp_min(0.0)


def _towards(q: Tensor, reference: Tensor, reach: Tensor) -> Tensor:
    """``q`` (M, N) moved in a straight line towards ``reference`` (M, N), by at most ``reach`` (N,)."""
    way = reference - q
    worst = (way.abs() / _within(q, reach).clamp_min(torch.finfo(q.dtype).tiny)).amax(dim=-1, keepdim=True)
    return torch.where(worst <= 1.0, reference, q + way / worst.clamp_min(1.0))


def _told(search: Search, state: _State, before: Tensor, valid: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Status ``(M,)`` and residual ``(M, 2)`` after a step from ``before`` (M, N)."""
    search = search._replace(target=state.target)
    every = torch.arange(len(valid), device=valid.device)
    q = torch.where(valid.unsqueeze(-1), state.q, state.reference)
    residual = residual_at(search, q, every)
    status = torch.where(search.cost(residual) <= 1.0, int(IKStatus.SOLVED), int(IKStatus.LATE))
    as_fast = ((state.q - before).abs() >= FULL_SPEED * _within(before, reach)).any(dim=-1)
    stopped = (valid & (status != IKStatus.SOLVED) & ~as_fast).nonzero().squeeze(-1)
    if len(stopped):
        status[stopped] = reason(search, q[stopped], stopped)
    outside = ((q < search.arm.lower) | (q > search.arm.upper)).any(dim=-1)
    status[outside] = int(IKStatus.LIMITED)
    status[~valid] = int(IKStatus.INVALID)
    return status, residual.masked_fill(~valid.unsqueeze(-1), torch.inf)


def _finite(arm: Arm) -> Tensor:
    """Some positions within the limits, ``(N,)``."""
    return torch.clamp(torch.zeros_like(arm.lower), arm.lower, arm.upper)
