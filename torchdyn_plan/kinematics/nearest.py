"""Nearest of several joint positions to a start: whole turns removed, compared by travel time."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm

TURN = 2.0 * math.pi
DISTINCT = 0.01
"""Solutions are equal if no joint differs by more than this, apart from whole turns [rad; m]."""


def revolute(arm: Arm) -> Tensor:
    """Revolute joints for which a full turn changes nothing, including what they drive: ``(N,)`` bool."""
    return torch.tensor(arm.full_turns, device=arm.lower.device)


def reduced(arm: Arm, q: Tensor) -> Tensor:
    """``q`` (*B, N) with endless joints wrapped to [-π, π], where their precision is uniform."""
    endless = revolute(arm) & arm.lower.isinf() & arm.upper.isinf()
    if not bool(endless.any()):
        return q
    exact = q.double()
    return torch.where(endless, exact - TURN * (exact / TURN).round(), exact).to(q.dtype)


def turned_towards(q: Tensor, start: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Angles ``q`` shifted by multiples of 2π to be nearest to ``start`` within the limits; all of one shape.

    An angle outside its limits that no turn brings inside is left unchanged.
    """
    number = ((start - q) / TURN).round()
    number = torch.minimum(torch.maximum(number, ((lower - q) / TURN).ceil()), ((upper - q) / TURN).floor())
    turned = q + TURN * number
    return torch.where((number != 0) & (turned >= lower) & (turned <= upper), turned, q)


def speeds(arm: Arm) -> Tensor:
    """Speeds ``(N,)`` that make the motions of joints comparable as times.

    These are the speed limits [rad/s; m/s], or 1 if the arm lacks some of them.
    """
    limit = arm.speed_limit
    return limit if bool((limit.isfinite() & (limit > 0)).all()) else torch.ones_like(limit)


def travel(q: Tensor, start: Tensor, speed: Tensor) -> Tensor:
    """Time ``(*B,)`` of the slowest joint from ``start`` to ``q``, both (*B, N)."""
    return ((q - start).abs() / speed).amax(dim=-1)


def first_distinct(q: Tensor, key: Tensor, count: int, turns: Tensor) -> Tensor:
    """Indices ``(M, count)`` of distinct rows of ``q`` (M, S, N), in ascending order of ``key`` (M, S).

    If there are fewer than ``count``, the remaining indices are -1.
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
