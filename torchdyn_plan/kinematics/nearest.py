"""Which of several joint positions is the nearest to a start: whole turns off, and the time that the way takes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm

TURN = 2.0 * math.pi
DISTINCT = 0.01
"""Solutions are the same when no joint differs by more [rad; m], whole turns aside."""


def revolute(arm: Arm) -> Tensor:
    """Which joints turn, and are where they were after a full turn with all that they move, ``(N,)`` bool."""
    return torch.tensor(arm.full_turns, device=arm.lower.device)


def reduced(arm: Arm, q: Tensor) -> Tensor:
    """``q`` (*B, N) with joints that turn without an end brought to [-π, π], where their precision is the same."""
    endless = revolute(arm) & arm.lower.isinf() & arm.upper.isinf()
    if not bool(endless.any()):
        return q
    exact = q.double()
    return torch.where(endless, exact - TURN * (exact / TURN).round(), exact).to(q.dtype)


def turned_towards(q: Tensor, start: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Angles ``q`` turned by multiples of 2π to the nearest of ``start`` within the limits, all of one shape.

    An angle outside its limits that no turn brings inside stays as it is.
    """
    number = ((start - q) / TURN).round()
    number = torch.minimum(torch.maximum(number, ((lower - q) / TURN).ceil()), ((upper - q) / TURN).floor())
    turned = q + TURN * number
    return torch.where((number != 0) & (turned >= lower) & (turned <= upper), turned, q)


def speeds(arm: Arm) -> Tensor:
    """What the way of each joint is divided by to be compared with another's: ``(N,)``.

    That is the speed limits [rad/s; m/s], or 1 where the arm does not have them all.
    """
    limit = arm.speed_limit
    return limit if bool((limit.isfinite() & (limit > 0)).all()) else torch.ones_like(limit)


def travel(q: Tensor, start: Tensor, speed: Tensor) -> Tensor:
    """Time ``(*B,)`` that the slowest joint takes from ``start`` to ``q``, both (*B, N)."""
    return ((q - start).abs() / speed).amax(dim=-1)


def first_distinct(q: Tensor, key: Tensor, count: int, turns: Tensor) -> Tensor:
    """Indices ``(M, count)`` of the rows of ``q`` (M, S, N) with the least ``key`` (M, S), each unlike those before.

    Where fewer than ``count`` are left, the index is -1.
    """
    picked, key = [], key.clone()
    for _ in range(count):
        least, index = key.min(dim=1)
        picked.append(torch.where(least.isinf(), -1, index))
        if len(picked) < count:
            way = q - q.gather(1, index[:, None, None].expand(-1, 1, q.shape[-1]))
            way = torch.where(turns, way - TURN * (way / TURN).round(), way)
            key.masked_fill_(way.abs().amax(dim=-1) <= DISTINCT, torch.inf)
    return torch.stack(picked, dim=1)
