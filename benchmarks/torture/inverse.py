"""Inverse kinematics of batches with rows that cannot be solved, and joints that are at their limits."""

from __future__ import annotations

import math
from pathlib import Path
from random import Random

import torch
from torch import Tensor

from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.kinematics import Arm, IKStatus, solve_ik

ROWS = 32
NARROW = 1.2
"""Limits of the arm with narrow joints, either way [rad]."""
BAD = (math.nan, math.inf, -math.inf, 1e30)


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Rows, in batches of `ROWS`: half of them for a UR5, half for one whose joints turn but little."""
    wide = Arm.ur5(tool_length=0.1)
    narrow = Arm.ur5(tool_length=0.1)
    narrow.lower.fill_(-NARROW)
    narrow.upper.fill_(NARROW)
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    for number in range(-(-count // ROWS)):
        yield from _solve(draw, narrow if number % 2 else wide, generator)


def _solve(draw: Random, arm: Arm, generator: torch.Generator) -> Cases:
    turn = 1.5 * arm.upper.clamp(max=math.pi)
    asked = (2.0 * torch.rand(ROWS, 6, generator=generator) - 1.0) * turn
    target = arm(asked)
    start = (2.0 * torch.rand(ROWS, 6, generator=generator) - 1.0) * arm.upper
    rows = draw.sample(range(ROWS), draw.randrange(0, ROWS // 2))
    spoiled, begun, constraint = target.clone(), start.clone(), draw.choice(("pose", "axis", "position"))
    for row in rows:
        _spoil(draw, spoiled[row], begun[row], constraint)
    outcome = attempt(solve_ik, arm, spoiled, q0=begun, constraint=constraint)
    usual = solve_ik(arm, target, q0=start, constraint=constraint)
    if outcome.value is None:
        yield f"the batch was sunk: {outcome.foreign or outcome.refused}"
        return
    found, status = outcome.value, outcome.value.status
    pose = arm(found.q.nan_to_num())
    away = (pose[:, :3, 3] - spoiled[:, :3, 3]).norm(dim=-1)
    within = ((found.q >= arm.lower - 1e-4) & (found.q <= arm.upper + 1e-4)).all(-1)
    same = (found.q == usual.q).all(-1) & (status == usual.status)
    for row in range(ROWS):
        yield _judge(row in rows, status[row], away[row], bool(within[row]), bool(same[row]))


def _spoil(draw: Random, target: Tensor, start: Tensor, constraint: str) -> None:
    """Make the row invalid, in something that the ``constraint`` reads."""
    kind = draw.randrange(2 if constraint == "position" else 4)
    if kind == 0:
        target[draw.randrange(3), 3] = draw.choice(BAD[:3])
    elif kind == 1:
        start[draw.randrange(6)] = draw.choice(BAD[:3])
    elif kind == 2:
        # Of a direction only the z axis is read.
        target[draw.randrange(3), 2 if constraint == "axis" else draw.randrange(3)] = draw.choice(BAD)
    else:
        target[:3, :3] = 0.0


def _judge(spoiled: bool, status: Tensor, away: Tensor, within: bool, same: bool) -> str | None:
    if spoiled:
        return None if status == IKStatus.INVALID else f"a bad row has status {int(status)}"
    if not same:
        return "a good row is another beside bad rows"
    if status == IKStatus.SOLVED and not within:
        return "a solved row is outside of its joints' limits"
    if status == IKStatus.SOLVED and not away < 1.1e-3:
        return f"a solved row is {float(away):g} m off"
    return None


PROMISE = Promise(
    says="inverse kinematics tells bad rows by their status, leaves the others as they were, and keeps joint limits",
    cases=cases,
    count=6400,
)
