"""Predicted distributions: arrival times of a robot, and errors of a forecast."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.precision import EXACT, at_least_float32, autocast_is_on, without_autocast


class Arrival(NamedTuple):
    """When, and whether, the robot arrives at each of some goals."""

    steps: Tensor
    """``(*B,)`` control steps from now, of the goals' type, in float32 at least; where ``never`` is True, the steps if
    it arrived after all."""
    never: Tensor
    """``(*B,)`` bool: the goal is never reached; with the estimator ``soft``, the probability of that."""
    bins: Tensor | None = None
    """``(*B, bins)`` probability of arriving within each bin of time; the remainder to 1 is that of *never*. None if
    only the time is known."""
    bin_width: int = 1
    """Control steps in a bin."""
    passed: int = 0
    """Control steps that have passed since the start of the first bin."""

    def by(self, time: Tensor) -> Tensor:
        """P(the robot is there ``time`` (*B,) control steps from now): ``(*B,)``, linear within a bin."""
        if self.bins is None:
            return ((self.steps <= time) & ~self.never).to(self.steps.dtype)
        number = torch.arange(self.bins.shape[-1], device=self.bins.device)
        since = time if self.passed == 0 else time + self.passed
        filled = (since.unsqueeze(-1) / self.bin_width - number).clamp(0.0, 1.0)
        return (self.bins * filled).sum(-1).clamp(0.0, 1.0)

    def after(self, steps: int) -> Arrival:
        """The same, counted from ``steps`` control steps later, for a robot that has kept moving to the goal."""
        if steps == 0:
            return self
        return self._replace(steps=(self.steps - steps).clamp_min(0.0), passed=self.passed + steps)


class Spread(NamedTuple):
    """Distribution of a forecast's error, independent along x and y and symmetric about the forecast.

    The size of the error is log-logistic, P(|e| ≤ r) = 1 / (1 + (scale/r)^shape): half of all errors are smaller than
    ``scale``, and the tail falls as r^-shape. It is heavy because a forecast is either right or has missed a bounce.
    """

    scale: Tensor
    """``(*B, F, 2)`` median of the error's size along x and y at 1 … F steps [m]."""
    shape: Tensor
    """``(*B, F, 2)`` shape, positive; larger values have lighter tails."""
    gone: Tensor
    """``(*B, F)`` probability that the target is lost by then."""

    def at(self, steps: Tensor) -> Spread:
        """The spread ``steps`` (K,) control steps ahead, 1 to F each: ``(*B, K, 2)``, ``gone`` ``(*B, K)``."""
        index = (steps - 1).clamp_min(0)
        return Spread(self.scale[..., index, :], self.shape[..., index, :], self.gone[..., index])

    def after(self, steps: int) -> Spread:
        """The spread from ``steps`` control steps ahead on: that of the forecast without its first entries."""
        return Spread(self.scale[..., steps:, :], self.shape[..., steps:, :], self.gone[..., steps:])

    def within(self, size: Tensor | float) -> Tensor:
        """P(|e| ≤ size), ``(*B, F, 2)``, for sizes that broadcast against it [m]; 0 for sizes that are not positive."""
        size = torch.as_tensor(size, dtype=self.scale.dtype, device=self.scale.device)
        # A guard on both sides of the `where` keeps the gradient finite.
        exponent = self.shape * (size.clamp_min(1e-12).log() - self.scale.log())
        return torch.where(size > 0.0, exponent.sigmoid(), 0.0)

    def between(self, offset: Tensor, half_width: Tensor | float) -> Tensor:
        """P(|offset + e| ≤ half_width) along each axis, for a position ``offset`` from the forecast [m]."""
        offset = offset.abs()
        left = half_width - offset
        near, far = self.within(torch.stack([half_width + offset, left.abs()])).unbind(0)
        return 0.5 * (near + far.copysign(left))

    def interval(self, share: float) -> Tensor:
        """Half-width ``(*B, F, 2)`` of the interval about the forecast that holds the target with P = ``share`` [m]."""
        check_number("share", share, minimum=1e-6, maximum=1.0 - 1e-6)
        return self.scale * (share / (1.0 - share)) ** (1.0 / self.shape)


def decode_mode(logits: Tensor, *, bin_width: int = 5) -> Arrival:
    """Middle of the likeliest bin, as in the paper: bin k is ``bin_width·k + (bin_width - 1)/2``, rounded down.

    Args:
        logits: ``(*B, bins + 1)``, the last for *never arrives*.
        bin_width: control steps in a bin.

    Returns:
        `Arrival` of ``(*B,)``; ``never`` where the last class is the likeliest, with the likeliest bin even so.
    """
    bins, logits = logits.shape[-1] - 1, logits if logits.dtype in EXACT else logits.float()
    never = logits.argmax(dim=-1) == bins
    steps = bin_width * logits[..., :bins].argmax(dim=-1) + (bin_width - 1) // 2
    return Arrival(steps.to(logits.dtype), never)


def decode_distribution(logits: Tensor, *, bin_width: int = 5, moments: Tensor | None = None) -> Arrival:
    """Mean arrival time given that the robot arrives, finer than a bin, and each bin's probability; differentiable.

    Args:
        logits: ``(*B, bins + 1)``, the last for *never arrives*.
        bin_width: control steps in a bin.
        moments: `arrival_moments` of the same bins, if already computed.

    Returns:
        `Arrival` of ``(*B,)``; ``never`` where *never* is likelier than all bins together.
    """
    if autocast_is_on():
        return without_autocast(decode_distribution, logits, bin_width=bin_width, moments=moments)
    logits = logits if logits.dtype in EXACT else logits.float()
    if moments is None:
        moments = arrival_moments(logits, bin_width)
    probability = logits.softmax(dim=-1)
    arrives, weighted = (probability @ moments).unbind(-1)
    return Arrival(weighted / arrives.clamp_min(1e-12), arrives < 0.5, probability[..., :-1], bin_width)


def decode_expectation(logits: Tensor, *, bin_width: int = 5, moments: Tensor | None = None) -> Arrival:
    """`decode_distribution` without the probabilities."""
    return Arrival(*decode_distribution(logits, bin_width=bin_width, moments=moments)[:2])


def arrival_moments(logits: Tensor, bin_width: int) -> Tensor:
    """Matrix ``(bins + 1, 2)`` from probabilities (*B, bins + 1) to that of arriving and the sum of times.

    Its last row leaves *never* out.
    """
    bins = logits.shape[-1] - 1
    middle = bin_width * torch.arange(bins, device=logits.device, dtype=logits.dtype) + (bin_width - 1) / 2
    return torch.nn.functional.pad(torch.stack([torch.ones_like(middle), middle], dim=-1), (0, 0, 0, 1))


def without_never(scores: Tensor) -> Tensor:
    """Scores ``(*B, bins + 1)`` of a network that scores ``(*B, bins)`` alone: *never* has probability 0."""
    return torch.nn.functional.pad(scores, (0, 1), value=-math.inf)


def decode_soft(logits: Tensor, *, bin_width: int = 5) -> Arrival:
    """As `decode_expectation`, but ``never`` is a probability: all of it is differentiable."""
    arrival = decode_expectation(logits, bin_width=bin_width)
    return Arrival(arrival.steps, at_least_float32(logits).softmax(dim=-1)[..., -1])


ESTIMATORS: dict[str, Callable[..., Arrival]] = {
    "mode": decode_mode,
    "expectation": decode_expectation,
    "distribution": decode_distribution,
    "soft": decode_soft,
}
"""How a distribution over bins becomes one arrival time."""
