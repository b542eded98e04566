"""When to plan anew: after a window of steps, or when the last plan no longer fits what is seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError


class Clock(NamedTuple):
    """State of the re-plan schedule, int64 ``(*B,)`` each, in control steps."""

    window: Tensor
    """Steps from the last plan to the next."""
    countdown: Tensor
    """Steps from now to the next plan."""
    replans: Tensor
    """Plans begun since the reset."""


class Drift(NamedTuple):
    """How far the world has moved away from the last plan, ``(*B,)`` each."""

    miss: Tensor
    """Distance of the target from where the plan's forecast has it now [m]."""
    late: Tensor
    """Predicted time left to the goal less the time left by plan [control steps]; infinite where it never arrives."""
    over: Tensor
    """Bool: the planned meeting time has come."""


Look = Callable[[Tensor], Drift]
"""Measures the drift in the rows of a mask ``(*B,)``; its values in other rows mean nothing."""


class Schedule(Protocol):
    """What tells a planner which rows plan now."""

    watches: ClassVar[bool]
    """Whether it looks at the drift."""

    @property
    def longest(self) -> int:
        """Longest time between two plans [control steps]."""
        ...

    def start(self, step_count: Tensor, /) -> Clock:
        """Clock of episodes that are at ``step_count`` (*B,) and have no plan yet."""
        ...

    def tick(
        self, clock: Clock | None, step_count: Tensor, /, *, busy: Tensor | None = None, look: Look | None = None
    ) -> tuple[Clock, Tensor]:
        """Advance ``clock`` of the step before to ``step_count`` (*B,) int64, and say which rows plan now.

        Rows at step 0, and all rows if there is no clock, start afresh.

        Args:
            clock: as it was after the step before.
            step_count: control steps since the reset.
            busy: ``(*B,)`` bool: a plan is under way, and no other can begin; None for nowhere.
            look: measures how far the last plan has drifted.

        Returns:
            The clock after this step's plans, and ``(*B,)`` bool: true where a plan begins now.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class ReplanSchedule:
    """The paper's schedule, t_TTR = max(γ t_TTR, 25) (Section III-B.4), in whole steps; or `every` few steps.

    The window is shrunk before its first use, so that the paper's values plan at steps 13, 80, 140, 194, …
    A row that is busy when its plan is due lets a window of the same length go by.
    """

    watches: ClassVar[bool] = False

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

    @classmethod
    def every(cls, steps: int, *, first_step: int = 13) -> ReplanSchedule:
        """A plan at ``first_step`` and every ``steps`` control steps from then on."""
        check_number("steps", steps, minimum=1, integer=True)
        return cls(first_step=first_step, window=steps, shrink=1.0, minimum=steps)

    @property
    def longest(self) -> int:
        """Longest time between two plans [control steps]: the first window."""
        return int(self.next_window(torch.tensor(self.window)))

    def next_window(self, window: Tensor) -> Tensor:
        """max(⌊γ·window⌋, minimum) of int64 ``(*B,)``, exact: γ is taken as the decimal fraction that it is written."""
        ratio = Fraction(str(self.shrink))
        shrunk = torch.div(window * ratio.numerator, ratio.denominator, rounding_mode="floor")
        return shrunk.clamp_min(self.minimum)

    def start(self, step_count: Tensor) -> Clock:
        """Clock of episodes that are at ``step_count`` (*B,) and have no plan yet."""
        return _start(self.first_step, self.window, step_count)

    def tick(
        self, clock: Clock | None, step_count: Tensor, *, busy: Tensor | None = None, look: Look | None = None
    ) -> tuple[Clock, Tensor]:
        """Which rows plan now, as `Schedule.tick` says; the drift is not looked at."""
        window, countdown, replans = _advance(clock, self.start(step_count), step_count)
        over = countdown <= 0
        due = over if busy is None else over & ~busy
        window = torch.where(due, self.next_window(window), window)
        return Clock(window, torch.where(over, window, countdown), replans + due), due


@dataclass(frozen=True, kw_only=True)
class EventSchedule:
    """Plans anew when the last plan no longer fits: the target left its forecast, the robot is late, or time is over.

    It looks every few steps, so that times between plans are multiples of them and `ExactSearch` finds its candidates
    on the same places of the path. A row that is busy then plans at the next look.
    """

    watches: ClassVar[bool] = True

    first_step: int = 13
    """Control step of the first plan, counted from the reset."""
    every: int = 5
    """Control steps between two looks; for `ExactSearch` a multiple of its stride."""
    minimum: int = 5
    """Shortest time between two plans [control steps]."""
    maximum: int = 50
    """Longest time between two plans [control steps]."""
    miss: float = 0.003
    """Greatest distance of the target from its forecast [m]."""
    late: float = 5.0
    """Control steps that the robot may come later than planned."""

    def __post_init__(self) -> None:
        check_number("first_step", self.first_step, minimum=0, integer=True)
        check_number("every", self.every, minimum=1, integer=True)
        check_number("minimum", self.minimum, minimum=1, integer=True)
        check_number("maximum", self.maximum, minimum=self.minimum, integer=True)
        check_number("miss", self.miss, minimum=0.0)
        check_number("late", self.late)
        for name in ("minimum", "maximum"):
            if getattr(self, name) % self.every:
                raise InputError(f"{name} must be a multiple of every = {self.every}, got {getattr(self, name)}")

    @property
    def longest(self) -> int:
        """Longest time between two plans [control steps]."""
        return self.maximum

    def start(self, step_count: Tensor) -> Clock:
        """Clock of episodes that are at ``step_count`` (*B,) and have no plan yet."""
        return _start(self.first_step, self.maximum, step_count)

    def tick(
        self, clock: Clock | None, step_count: Tensor, *, busy: Tensor | None = None, look: Look | None = None
    ) -> tuple[Clock, Tensor]:
        """Which rows plan now, as `Schedule.tick` says; without ``look``, those whose longest time is over.

        The clock's countdown runs to the latest next plan, and below 0 where a busy row is overdue.
        """
        window, countdown, replans = _advance(clock, self.start(step_count), step_count)
        passed = window - countdown
        may = (replans > 0) & (passed >= self.minimum) & (passed % self.every == 0)
        due = (countdown <= 0) & (may | (replans == 0))
        if busy is not None:
            due, may = due & ~busy, may & ~busy
        looked = may & ~due
        if look is not None and looked.any():
            drift = look(looked)
            due = due | (looked & ((drift.miss > self.miss) | (drift.late > self.late) | drift.over))
        return Clock(window, torch.where(due, window, countdown), replans + due), due


def _start(first_step: int, window: int, step_count: Tensor) -> Clock:
    """Clock of episodes that are at ``step_count`` (*B,) and have no plan yet."""
    countdown = (first_step - step_count).clamp_min(0)
    return Clock(torch.full_like(step_count, window), countdown, torch.zeros_like(step_count))


def _advance(clock: Clock | None, start: Clock, step_count: Tensor) -> Clock:
    """``clock`` one step later; ``start`` in rows at step 0, and everywhere if there is no clock."""
    if clock is None:
        return start
    aged = Clock(clock.window, clock.countdown - 1, clock.replans)
    fresh = step_count == 0
    return Clock(*(torch.where(fresh, new, old) for new, old in zip(start, aged, strict=True)))
