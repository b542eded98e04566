"""Batched inverse kinematics: damped least squares with several starts; rows are independent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.descent import Search, descend, evaluate, residual_at, rows_at
from torchdyn_plan.kinematics.implicit import refine
from torchdyn_plan.kinematics.nearest import TURN, first_distinct, reduced, revolute, speeds, travel, turned_towards
from torchdyn_plan.kinematics.targets import CONSTRAINTS, as_pose, as_rows, is_pose
from torchdyn_plan.kinematics.ur_branches import NUMBER, Universal, all_branches, tool_turns, universal
from torchdyn_plan.precision import without_autocast

ROUNDS = (1, 4, 16, 64, 128)
"""Parallel starts for each unsolved row, in each round."""
LEAST_TOLERANCE = 1e-12
"""[m; rad]; smaller tolerances can never be met."""
OVERSHOOT = 0.1
"""[rad; m]; a start farther outside its limits than this is turned by 2π if that brings it inside."""


class IKStatus(IntEnum):
    """How a row of `solve_ik` ended, or a step of `follow`."""

    SOLVED = 0
    """Within the tolerances and the joints' limits."""
    UNREACHED = 1
    """No start came within the tolerances."""
    SINGULAR = 2
    """Like `UNREACHED`, in a singular configuration: stretched out to a target beyond its reach, or axes in line."""
    LIMITED = 3
    """Like `UNREACHED`, with a joint at its limit."""
    INVALID = 4
    """The target or the start is NaN or infinite, or the target's rotation is not one; nothing was solved."""
    LATE = 5
    """Not there yet, with a joint at its speed limit; only from `follow`."""


class IKResult(NamedTuple):
    """Result of `solve_ik`; with ``solutions=k`` each entry has a dimension ``k`` after the batch."""

    q: Tensor
    """``(*B, N)`` [rad; m]; the best found if the row is not solved, the start if it is invalid."""
    status: Tensor
    """``(*B,)``, integers of `IKStatus`."""
    residual: Tensor
    """``(*B, 2)``, errors of position [m] and orientation [rad]; infinite where the row is invalid."""


class _Pool(NamedTuple):
    """The best ``K`` solutions that each row has found so far, the nearest to the start first."""

    q: Tensor
    """``(M, K, N)``"""
    residual: Tensor
    """``(M, K, 2)``, infinite in empty slots."""
    start: Tensor
    """``(M, N)``, the start."""
    speed: Tensor
    """``(N,)``, see `nearest.speeds`."""
    turns: Tensor
    """``(N,)`` bool, joints for which a whole turn changes nothing."""


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
    max_move: float | Tensor | None = None,
    posture: Tensor | None = None,
    solutions: int | None = None,
    differentiable: bool = False,
) -> IKResult:
    """Joint positions at which the tool is at ``target``, by damped least squares with restarts.

    Rows are independent: bad rows are marked by their status, and a single row has the same solution as in a batch. The
    starts after the first are the same for every row. Full poses of UR arms are first solved by `branches`, unless
    ``rounds`` is a single start. Joints are turned by 2π towards the start as far as their limits allow, and the
    solution that all joints reach soonest at their speed limits is taken (if some speed limits are missing, the one
    with the least rotation).

    With ``solutions=k`` a row has up to ``k`` distinct solutions, the nearest first. Missing ones have a status other
    than `SOLVED` and are copies of the first, with infinite residuals. In this case all starts of a round run to the
    end, and further rounds follow until there are ``k``; a UR arm has at most 8 solutions, all known.

    Args:
        arm: the arm.
        target: ``(*B, 4, 4)``, base frame [m]; or ``(*B, 3)`` for the constraint "position".
        q0: start of the first round, ``(*B, N)`` or ``(N,)``; a fixed one by default. It is clamped to
            the limits.
        constraint: "pose", "axis" (position and direction of the tool's z axis; yaw is free) or "position".
        symmetry: for the constraint "pose", order of the tool's rotational symmetry about its z axis.
        position_tolerance: [m]
        rotation_tolerance: [rad]
        iterations: most steps from one start.
        rounds: number of parallel starts in each round; rows solved in one round skip the next.
        max_step: largest motion of any joint in one step, a number or ``(N,)`` [rad; m].
        max_move: largest distance of any joint from ``q0`` at the end, a number or ``(N,)`` [rad; m].
        posture: ``(*B, N)`` or ``(N,)``, preferred joint positions in the null space of the constraint.
        solutions: number of solutions per row; ``q`` is then ``(*B, k, N)``, and the others likewise.
        differentiable: give ``q`` gradients with respect to ``target`` and the arm's tensors, see `implicit.refine`.

    Raises:
        InputError: a shape, device, precision, name or number is wrong.
    """
    check_task(constraint, symmetry, position_tolerance, rotation_tolerance, iterations)
    if not isinstance(rounds, Sequence) or not rounds:
        raise InputError(f"rounds must be numbers of starts, one for each round, got {rounds!r}")
    for number in rounds:
        check_number("each of rounds", number, minimum=1, integer=True)
    if solutions is not None:
        check_number("solutions", solutions, minimum=1, integer=True)
    target = as_pose(target, arm, constraint)
    batch, count = target.shape[:-2], arm.num_joints
    with torch.no_grad():
        wanted = target.detach().reshape(-1, 4, 4)
        posture = None if posture is None else as_rows("posture", posture, arm, batch)
        step = joint_numbers("max_step", max_step, arm)
        start = _middle(arm).expand(len(wanted), count) if q0 is None else as_rows("q0", q0, arm, batch)
        first = inside_limits(arm, start)
        lower, upper = _limits(arm, None if q0 is None else first, max_move)
        tolerances = position_tolerance, rotation_tolerance
        search = Search(arm, wanted, lower, upper, constraint, symmetry, tolerances, iterations, step, posture)
        q, status, residual = without_autocast(solve_rows, search, start, first, rounds, solutions or 1)
    extra = () if solutions is None else (solutions,)
    shape = *batch, *extra
    result = IKResult(q.reshape(*shape, count), status.reshape(shape), residual.reshape(*shape, 2))
    if not differentiable:
        return result
    wanted = target if solutions is None else target.unsqueeze(-3).expand(*shape, 4, 4)
    solved = result.status == IKStatus.SOLVED
    return result._replace(q=refine(arm, wanted, result.q, solved, constraint=constraint, symmetry=symmetry))


def check_task(
    constraint: str, symmetry: int, position_tolerance: float, rotation_tolerance: float, iterations: int
) -> None:
    """Raise `InputError` unless these are valid arguments of `solve_ik` and `follow`."""
    check_choice("constraint", constraint, CONSTRAINTS)
    check_number("symmetry", symmetry, minimum=1, integer=True)
    check_number("position_tolerance", position_tolerance, minimum=LEAST_TOLERANCE)
    check_number("rotation_tolerance", rotation_tolerance, minimum=LEAST_TOLERANCE)
    check_number("iterations", iterations, minimum=1, integer=True)


def joint_numbers(name: str, value: float | Tensor, arm: Arm) -> Tensor:
    """A positive number, or one for each joint, as ``(N,)``."""
    if not isinstance(value, Tensor):
        check_number(name, value)
    numbers = torch.as_tensor(value, dtype=arm.lower.dtype, device=arm.lower.device)
    if numbers.shape not in ((), arm.lower.shape) or not bool((numbers > 0).all()):
        raise InputError(f"{name} must be positive, a number or of shape {tuple(arm.lower.shape)}, got {value!r}")
    return numbers.expand(arm.num_joints)


def inside_limits(arm: Arm, q: Tensor) -> Tensor:
    """``q`` (*B, N) within the limits: the same pose if whole turns bring it there, else the nearest position.

    NaN and infinite values become NaN.
    """
    known, q, turns = q.isfinite(), reduced(arm, q), revolute(arm)
    outside = torch.maximum(arm.lower - q, q - arm.upper)
    turned = turned_towards(q, torch.clamp(q, arm.lower, arm.upper), arm.lower, arm.upper)
    q = torch.where(turns & (outside > OVERSHOOT), turned, q)
    return torch.clamp(q, arm.lower, arm.upper).masked_fill(~known, torch.nan)


def _limits(arm: Arm, start: Tensor | None, max_move: float | Tensor | None) -> tuple[Tensor, Tensor]:
    """Limits of the search, ``(N,)``, or ``(M, N)`` if it is bounded around ``start``."""
    if max_move is None:
        return arm.lower, arm.upper
    if start is None:
        raise InputError("max_move bounds the distance from q0: give q0 with it")
    move = joint_numbers("max_move", max_move, arm)
    return torch.maximum(arm.lower, start - move), torch.minimum(arm.upper, start + move)


def _spread(count: int, joints: int) -> Tensor:
    """Points ``(count, N)`` float64 of the unit cube, always the same.

    Roberts' additive recurrence: frac(½ + k φ⁻ⁱ), with φ the root of φᴺ⁺¹ = φ + 1.
    """
    ratio = 2.0
    for _ in range(40):
        ratio = (1.0 + ratio) ** (1.0 / (joints + 1))
    steps = ratio ** -torch.arange(1.0, joints + 1.0, dtype=torch.float64)
    return (0.5 + torch.arange(1.0, count + 1.0, dtype=torch.float64).unsqueeze(-1) * steps).frac()


def _range(arm: Arm, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Finite limits between which starts are spread, at most a turn apart."""
    has_lower, has_upper = lower.isfinite(), upper.isfinite()
    low = torch.where(has_lower, lower, torch.where(has_upper, upper - 2.0 * math.pi, -math.pi))
    high = torch.where(has_upper, upper, torch.where(has_lower, lower + 2.0 * math.pi, math.pi))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = torch.where(revolute(arm), half.clamp(max=math.pi), half)
    return middle - half, middle + half


def _middle(arm: Arm) -> Tensor:
    """The default start, ``(N,)``."""
    low, high = _range(arm, arm.lower, arm.upper)
    return low + (high - low) * _spread(1, arm.num_joints)[0].to(low)


def solve_rows(
    search: Search, start: Tensor, first: Tensor, rounds: Sequence[int], count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The best ``K`` of each row (M, K, N), their status (M, K) and residuals (M, K, 2).

    ``first`` (M, N) is ``start`` (M, N) within the limits.
    """
    valid = is_pose(search.target, search.constraint) & first.isfinite().all(dim=-1)
    if search.posture is not None:
        valid &= search.posture.isfinite().all(dim=-1)
    residual = torch.full((len(first), count, 2), torch.inf, dtype=first.dtype, device=first.device)
    empty = first.unsqueeze(1).repeat(1, count, 1)
    pool = _Pool(empty, residual, first, speeds(search.arm), revolute(search.arm))
    whole = search.constraint == "pose" and search.weights is None
    form = universal(search.arm) if whole else "a part of the pose"
    known = not isinstance(form, str) and (count > 1 or len(rounds) > 1)
    # A row is done once its last slot is filled, or, if all solutions are known, once it has one.
    needed = 0 if known else count - 1
    open_rows = valid.nonzero().squeeze(-1)
    if known and count == 1:
        # Staying is the nearest solution.
        pool.residual[open_rows, 0] = residual_at(search, first[open_rows], open_rows)
        open_rows = open_rows[search.cost(pool.residual[open_rows, 0]) > 1.0]
    for stage in _stages(rounds, known=known):
        if not len(open_rows):
            break
        if stage is None:
            assert isinstance(form, Universal)
            rows, tries = _branch_tries(search, form, first, open_rows)
        else:
            rows, tries = open_rows, _start_tries(search, first, open_rows, *stage)
        # With several parallel starts, the nearest solution is wanted, not the first.
        all_tries = count > 1 or stage is None or stage[0] == 0
        _put(search, pool, rows, *descend(search, tries, rows, all_tries=all_tries))
        open_rows = open_rows[search.cost(pool.residual[open_rows, needed]) > 1.0]
    status = _status(search, pool, valid)
    pool = _as_started(search, pool, start)
    return torch.where(valid[:, None, None], pool.q, start.unsqueeze(1)), status, pool.residual


def _stages(rounds: Sequence[int], *, known: bool) -> list[tuple[int, int] | None]:
    """First start and number of starts of each round; None stands for the solutions of `branches`."""
    stages: list[tuple[int, int] | None] = list(zip(accumulate(rounds, initial=0), rounds, strict=False))
    return [None, *stages] if known else stages


def _start_tries(search: Search, first: Tensor, rows: Tensor, begin: int, number: int) -> Tensor:
    """Starts ``begin`` to ``begin + number`` of some rows, ``(A, number, N)``: the row's own, then fixed ones."""
    unit = _spread(begin + number, search.arm.num_joints)[begin:].to(search.target)
    low, high = _range(search.arm, *search.bounds(rows))
    low, high = low.reshape(-1, 1, unit.shape[-1]), high.reshape(-1, 1, unit.shape[-1])
    tries = (low + (high - low) * unit).expand(len(rows), *unit.shape)
    return tries if begin else torch.cat([first[rows].unsqueeze(1), tries[:, 1:]], dim=1)


def _branch_tries(search: Search, form: Universal, first: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The rows with analytic solutions, ``(A,)``, and the solutions, ``(A, S, N)``, some repeated."""
    poses = tool_turns(search.target[rows], search.symmetry)
    many = rows.repeat_interleave(search.symmetry)
    q, valid = all_branches(form, search.arm, poses.flatten(0, 1), first[many], *search.bounds(many))
    q, valid = q.view(len(rows), search.symmetry * NUMBER, 6), valid.view(len(rows), search.symmetry * NUMBER)
    one = q.gather(1, valid.to(torch.uint8).argmax(dim=1)[:, None, None].expand(-1, 1, 6))
    has = valid.any(dim=1)
    return rows[has], torch.where(valid.unsqueeze(-1), q, one)[has]


def _put(search: Search, pool: _Pool, rows: Tensor, q: Tensor, residual: Tensor) -> None:
    """Merge ``q`` (A, S, N) with ``residual`` (A, S, 2) into ``pool``, keeping the nearest of each of ``rows``."""
    start, number = pool.start[rows].unsqueeze(1), pool.q.shape[1]
    lower, upper = (limit.reshape(-1, 1, q.shape[-1]) for limit in search.bounds(rows))
    q = torch.where(pool.turns, turned_towards(q, start, lower, upper), q)
    q, residual = torch.cat([pool.q[rows], q], dim=1), torch.cat([pool.residual[rows], residual], dim=1)
    cost = search.cost(residual)
    # Unsolved ones come after all solved ones.
    key = torch.where(cost <= 1.0, travel(q, start, pool.speed), 1e6 * cost)
    picked = first_distinct(q, key, number, pool.turns)
    index = picked.clamp_min(0).unsqueeze(-1)
    q, residual = q.gather(1, index.expand(-1, -1, q.shape[-1])), residual.gather(1, index.expand(-1, -1, 2))
    if number > 1:
        empty = (picked < 0).unsqueeze(-1) | (search.cost(residual) > 1.0).unsqueeze(-1)
        empty[:, 0] = False
        q, residual = torch.where(empty, q[:, :1], q), residual.masked_fill(empty, torch.inf)
    pool.q[rows], pool.residual[rows] = q, residual


def _as_started(search: Search, pool: _Pool, start: Tensor) -> _Pool:
    """The pool with endless joints shifted by the whole turns between ``start`` (M, N) and the pool's own start.

    A solution stays unshifted if rounding after so many turns would exceed the tolerances.
    """
    arm = search.arm
    endless = pool.turns & arm.lower.isinf() & arm.upper.isinf()
    away = torch.where(endless, start.double() - pool.start.double(), 0.0).nan_to_num(0.0, 0.0, 0.0)
    if not bool((away != 0.0).any()):
        return pool
    q = (pool.q.double() + TURN * (away / TURN).round().unsqueeze(1)).to(pool.q.dtype)
    rows = torch.arange(len(q), device=q.device).repeat_interleave(q.shape[1])
    residual = residual_at(search, reduced(arm, q).flatten(0, 1), rows).view(pool.residual.shape)
    kept = (search.cost(residual) <= 1.0) | (search.cost(pool.residual) > 1.0)
    kept = kept.unsqueeze(-1)
    residual = torch.where(kept & pool.residual.isfinite(), residual, pool.residual)
    return pool._replace(q=torch.where(kept, q, pool.q), residual=residual)


def _status(search: Search, pool: _Pool, valid: Tensor) -> Tensor:
    """Status ``(M, K)`` of the pool's entries."""
    solved = search.cost(pool.residual) <= 1.0
    status = torch.where(solved, int(IKStatus.SOLVED), int(IKStatus.UNREACHED))
    failed = (valid & ~solved[:, 0]).nonzero().squeeze(-1)
    if len(failed):
        status[failed] = reason(search, pool.q[failed, 0], failed).unsqueeze(-1)
    return status.masked_fill(~valid.unsqueeze(-1), int(IKStatus.INVALID))


def reason(search: Search, q: Tensor, rows: Tensor) -> Tensor:
    """Status ``(A,)`` of rows that were not solved and came to ``q`` (A, N)."""
    _, jacobian = evaluate(search.arm, q)
    values = torch.linalg.svdvals(rows_at(search, jacobian, rows))
    lower, upper = search.bounds(rows)
    at_limit = ((q <= lower) | (q >= upper)).any(dim=-1)
    status = torch.where(at_limit, int(IKStatus.LIMITED), int(IKStatus.UNREACHED))
    return torch.where(values[:, -1] < 0.02 * values[:, 0], int(IKStatus.SINGULAR), status)
