"""Rates with their uncertainty."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError

Z_95 = 1.959963984540054
"""Quantile of the normal distribution that leaves 95 % between its two signs."""


class Rate(NamedTuple):
    """A share of trials, 0 to 1, with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def wilson_interval(successes: Tensor, trials: Tensor) -> tuple[Tensor, Tensor]:
    """Ends of the 95 % interval of a binomial rate, float64 ``(*B,)`` each, within [0, 1].

    Wilson's score interval (1927): ``(p + z²/2n ± z·sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n)``; unlike the normal
    approximation it has width at p = 0 and p = 1. No trials know nothing: the interval is [0, 1].

    Args:
        successes: number of successes ``(*B,)``.
        trials: number of trials ``(*B,)``.

    Raises:
        InputError: a count is negative, or there are more successes than trials.
    """
    k, n = successes.to(torch.float64), trials.to(torch.float64)
    if bool(((k < 0) | (k > n)).any()):
        raise InputError(f"successes must lie between 0 and trials, got {successes.tolist()} of {trials.tolist()}")
    known = n > 0
    safe = torch.where(known, n, 1.0)
    p, z2 = k / safe, Z_95**2
    centre = p + z2 / (2.0 * safe)
    half = Z_95 * torch.sqrt(p * (1.0 - p) / safe + z2 / (4.0 * safe**2))
    scale = 1.0 + z2 / safe
    low = torch.where(known & (k > 0), (centre - half) / scale, 0.0)
    high = torch.where(known & (k < n), (centre + half) / scale, 1.0)
    return low, high


def rate(successes: int, trials: int) -> Rate:
    """The share ``successes / trials`` with its Wilson interval; NaN within [0, 1] when there are no trials."""
    low, high = wilson_interval(torch.tensor(successes), torch.tensor(trials))
    return Rate(successes / trials if trials else math.nan, low.item(), high.item())


def paired_loss(before: Tensor, after: Tensor) -> Rate:
    """Share of successes lost from ``before`` to ``after``, bool ``(E,)`` each, of the same episodes.

    Between -1 and 1, with the normal approximation's 95 % interval of the mean of the differences: narrower than that
    of two independent rates, as most episodes end alike. NaN within [-1, 1] for no episodes.
    """
    if before.shape != after.shape:
        raise InputError(f"the episodes must be the same, got {tuple(before.shape)} and {tuple(after.shape)}")
    lost = before.double() - after.double()
    if not lost.numel():
        return Rate(math.nan, -1.0, 1.0)
    value = lost.mean().item()
    half = Z_95 * math.sqrt(lost.square().mean().item() - value**2) / math.sqrt(lost.numel())
    return Rate(value, max(value - half, -1.0), min(value + half, 1.0))
