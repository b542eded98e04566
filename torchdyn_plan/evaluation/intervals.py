"""Rates with their uncertainty."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_count, check_finite
from torchdyn_plan.errors import InputError

Z_95 = 1.959963984540054
"""Quantile of the normal distribution that leaves 95 % between its two signs."""
RESAMPLES = 20_000
"""Bootstrap resamples: the ends of an interval then repeat to about a hundredth of its width."""


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


def mcnemar(before: Tensor, after: Tensor) -> float:
    """p-value of two planners being equally good, from successes ``before`` and ``after``, bool ``(E,)`` each.

    McNemar's exact test (two-sided): of the n episodes that only one of them solved each is taken for the toss of a
    fair coin, ``p = min(1, 2 P(X <= min(n10, n01)))`` with ``X ~ Binomial(n, 1/2)``. 1 where they never differ.

    Raises:
        InputError: the two are not of the same episodes.
    """
    if before.shape != after.shape:
        raise InputError(f"the episodes must be the same, got {tuple(before.shape)} and {tuple(after.shape)}")
    lost, won = int((before & ~after).sum()), int((after & ~before).sum())
    return sign_test(lost, won)


def sign_test(lost: int, won: int) -> float:
    """p-value of `mcnemar`, by the numbers of episodes that only the one and only the other solved."""
    if min(lost, won) < 0:
        raise InputError(f"episodes cannot be fewer than none, got {lost} and {won}")
    tosses = lost + won
    # Whole numbers: nothing is rounded before the division.
    tail = sum(math.comb(tosses, count) for count in range(min(lost, won) + 1))
    return min(1.0, 2 * tail / 2**tosses)


def interquartile_mean(scores: Tensor) -> Tensor:
    """Mean of the middle half of ``scores`` ``(*B, R, K)``, of R trainings in K settings each: ``(*B,)`` float64.

    All R·K scores of a batch entry are sorted together, and ``⌊R K / 4⌋`` are left out at either end (Agarwal et al.,
    Deep RL at the edge of the statistical precipice, 2021): less noisy than the median, less moved by one bad training
    than the mean.
    """
    if scores.ndim < 2 or not scores.shape[-2:].numel():
        raise InputError(f"scores must have shape (*B, R, K) with R, K >= 1, got {tuple(scores.shape)}")
    ordered = scores.to(torch.float64).flatten(-2).sort(dim=-1).values
    count = ordered.shape[-1]
    return ordered[..., count // 4 : count - count // 4].mean(dim=-1)


def interquartile_mean_interval(scores: Tensor, *, resamples: int = RESAMPLES, seed: int = 0) -> Rate:
    """`interquartile_mean` of ``scores`` (R, K) with its stratified 95 % bootstrap interval (Agarwal et al., 2021).

    A resample draws R of the R trainings with replacement, in each setting anew; the ends are the 2.5th and the 97.5th
    percentile over ``resamples``. It tells how the figure would differ with other trainings in the same settings.

    Args:
        scores: rates, of R trainings in K settings each.
        resamples: how many are drawn.
        seed: of the draws.

    Raises:
        InputError: ``scores`` have another shape, or hold a NaN, or there are too few resamples.
    """
    if scores.ndim != 2:
        raise InputError(f"scores must have shape (R, K), got {tuple(scores.shape)}")
    check_finite("scores", scores)
    check_count("resamples", resamples, minimum=100)
    value = interquartile_mean(scores).item()
    draw = torch.Generator().manual_seed(seed)
    index = torch.randint(len(scores), (resamples, *scores.shape), generator=draw)
    drawn = scores.to(torch.float64).expand(resamples, *scores.shape).gather(1, index)
    ends = torch.tensor([0.025, 0.975], dtype=torch.float64)
    low, high = interquartile_mean(drawn).quantile(ends).tolist()
    return Rate(value, low, high)
