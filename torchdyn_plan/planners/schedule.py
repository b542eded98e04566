"""When to plan anew: a window that shrinks from plan to plan."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number


class Clock(NamedTuple):
    """State of the re-plan schedule, int64 ``(*B,)`` each, in control steps."""

    window: Tensor
    """Steps from the last plan to the next."""
    countdown: Tensor
    """Steps from now to the next plan."""
    replans: Tensor
    """Plans made since the reset."""


@dataclass(frozen=True, kw_only=True)
class ReplanSchedule:
    """The paper's schedule, t_TTR = max(γ t_TTR, 25) (Section III-B.4), in whole steps.

    The window is shrunk before its first use, so that the paper's values plan at steps 13, 80, 140, 194, …
    """

    first_step: int = 13
    """Control step of the first plan, counted from the reset."""
    window: int = 75
    """Window before it is first shrunk [control steps]."""
    shrink: float = 0.9
    """γ, by which every plan multiplies the window."""
    minimum: int = 25
    """The window never falls below this [control steps]."""

    def __post_init__(self) -> None:
        check_number("first_step", self.first_step, minimum=0, integer=True)
        check_number("window", self.window, minimum=1, integer=True)
        check_number("shrink", self.shrink, minimum=0.0, maximum=1.0)
        check_number("minimum", self.minimum, minimum=1, integer=True)

    def next_window(self, window: Tensor) -> Tensor:
        """max(⌊γ·window⌋, minimum) of int64 ``(*B,)``, exact: γ is taken as the decimal fraction that it is written."""
        ratio = Fraction(str(self.shrink))
        shrunk = torch.div(window * ratio.numerator, ratio.denominator, rounding_mode="floor")
        return shrunk.clamp_min(self.minimum)

    def start(self, step_count: Tensor) -> Clock:
        """Clock of episodes that are at ``step_count`` (*B,) and have no plan yet."""
        countdown = (self.first_step - step_count).clamp_min(0)
        return Clock(torch.full_like(step_count, self.window), countdown, torch.zeros_like(step_count))

    def tick(self, clock: Clock | None, step_count: Tensor) -> tuple[Clock, Tensor]:
        """Advance ``clock`` of the step before to ``step_count`` (*B,) int64, and say which rows plan now.

        Rows at step 0, and all rows if there is no clock, start afresh.

        Returns:
            The clock after this step's plans, and ``(*B,)`` bool: true where a plan is due now.
        """
        window, countdown, replans = start = self.start(step_count)
        if clock is not None:
            aged = Clock(clock.window, clock.countdown - 1, clock.replans)
            fresh = step_count == 0
            window, countdown, replans = (torch.where(fresh, new, old) for new, old in zip(start, aged, strict=True))
        due = countdown <= 0
        window = torch.where(due, self.next_window(window), window)
        return Clock(window, torch.where(due, window, countdown), replans + due), due
