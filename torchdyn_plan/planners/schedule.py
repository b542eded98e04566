"""Re-plan schedules: after a number of steps, or when the plan in use no longer fits the observation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.rows import any_row, apply_to_rows
from torchdyn_plan.planners.seconds import steps_in

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalModel


class Clock(NamedTuple):
    """State of the re-plan schedule, int64 ``(*B,)`` each, in control steps."""

    window: Tensor
    """Steps from the last plan to the next."""
    countdown: Tensor
    """Steps from now to the next plan."""
    replans: Tensor
    """Plans started since the reset."""

    def older(self) -> Clock:
        """The clock one control step later."""
        return self._replace(countdown=self.countdown - 1)

    @classmethod
    def until(cls, first_step: int, window: int, step_count: Tensor) -> Clock:
        """Clock of episodes at ``step_count`` (*B,) whose first plan is at ``first_step``."""
        countdown = (first_step - step_count).clamp_min(0)
        return cls(torch.full_like(step_count, window), countdown, torch.zeros_like(step_count))

    def retry(self, failed: Tensor, before: Clock) -> Clock:
        """The clock with rows that ``failed`` (*B,) to plan due again at the next step.

        ``before`` is the clock before they were due: a failed plan is not counted and does not shrink the window.
        """
        return Clock(
            torch.where(failed, before.window, self.window),
            self.countdown.masked_fill(failed, 1),
            self.replans - failed.long(),
        )


Late = Callable[[Tensor], Tensor]
"""`lateness` of the robots in the rows of a mask ``(*B,)``: ``(*B,)`` [control steps]."""


class Schedule(Protocol):
    """Decides which rows plan now; its state is a `Clock`."""

    watches: ClassVar[bool]
    """Whether it reads the plan's path between plans, which is then kept in the memory."""

    @property
    def longest(self) -> int:
        """Longest time between two plans [control steps]."""
        ...

    def start(self, observation: Observation, /) -> Clock:
        """Clock of rows that have no plan yet."""
        ...

    def tick(
        self, clock: Clock, observation: Observation, plan: Plan, /, *, busy: Tensor | None, late: Late
    ) -> tuple[Clock, Tensor]:
        """Decide which rows plan now.

        Args:
            clock: of this step.
            observation: of this step.
            plan: in use.
            busy: ``(*B,)`` bool: a plan is under way and no other can start; None if no row is busy.
            late: measures how late the robot is.

        Returns:
            The clock after this step's plans, and ``(*B,)`` bool: true where a plan starts now.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class ReplanSchedule:
    """The paper's schedule, t_TTR = max(γ t_TTR, 25) (Section III-B.4), in whole steps; or a fixed period, `every`.

    The window is shrunk before its first use, so that the paper's values plan at steps 13, 80, 140, 194, …
    A row that is busy when its plan is due waits for another window of the same length.
    """

    watches: ClassVar[bool] = False

    first_step: int = 13
    """Control step of the first plan, counted from the reset."""
    window: int = 75
    """Window before it is first shrunk [control steps]."""
    shrink: float = 0.9
    """γ, the factor applied to the window at every plan."""
    minimum: int = 25
    """The window never falls below this [control steps]."""

    def __post_init__(self) -> None:
        check_number("first_step", self.first_step, minimum=0, integer=True)
        check_number("window", self.window, minimum=1, integer=True)
        check_number("shrink", self.shrink, minimum=0.0, maximum=1.0)
        check_number("minimum", self.minimum, minimum=1, integer=True)

    @classmethod
    def every(cls, steps: int, *, first_step: int = 1) -> ReplanSchedule:
        """A plan at ``first_step`` and every ``steps`` after it; at step 1 two positions of the target are known."""
        check_number("steps", steps, minimum=1, integer=True)
        return cls(first_step=first_step, window=steps, shrink=1.0, minimum=steps)

    @classmethod
    def every_seconds(cls, seconds: float, *, control_step: float, first: float | None = None) -> ReplanSchedule:
        """A plan every ``seconds``, the first one ``first`` [s] after the reset, or after one step for None.

        Times are rounded up to whole control steps of ``control_step`` [s].
        """
        first_step = 1 if first is None else steps_in("first", first, control_step)
        return cls.every(max(steps_in("seconds", seconds, control_step), 1), first_step=first_step)

    @property
    def longest(self) -> int:
        """Longest time between two plans [control steps]: the first window."""
        return int(self.next_window(torch.tensor(self.window)))

    def next_window(self, window: Tensor) -> Tensor:
        """max(⌊γ·window⌋, minimum) of int64 ``(*B,)``, exact: γ is read as the decimal fraction it is written as."""
        ratio = Fraction(str(self.shrink))
        shrunk = torch.div(window * ratio.numerator, ratio.denominator, rounding_mode="floor")
        return shrunk.clamp_min(self.minimum)

    def start(self, observation: Observation) -> Clock:
        """Clock of rows that have no plan yet."""
        return Clock.until(self.first_step, self.window, observation.step_count)

    def tick(
        self, clock: Clock, observation: Observation, plan: Plan, *, busy: Tensor | None, late: Late
    ) -> tuple[Clock, Tensor]:
        """Which rows plan now, see `Schedule.tick`; the plan is not read."""
        over = clock.countdown <= 0
        if not (torch.compiler.is_compiling() or debug_unwrap(over).any()):
            return clock, over
        due = over if busy is None else over & ~busy
        window = clock.window
        # A fixed period is the same after every plan.
        if self.minimum != self.window:
            window = torch.where(due, self.next_window(window), window)
        return Clock(window, torch.where(over, window, clock.countdown), clock.replans + due), due


@dataclass(frozen=True, kw_only=True)
class EventSchedule:
    """Plans again when the target has left its forecast, the robot is late, or the longest time is over.

    It checks every few steps, so that times between plans are multiples of ``every`` and `ExactSearch` finds its
    candidates at the same points of the path. A row that is busy plans at the next check.
    """

    watches: ClassVar[bool] = True

    first_step: int = 13
    """Control step of the first plan, counted from the reset."""
    every: int = 5
    """Control steps between two checks; for `ExactSearch` a multiple of its stride."""
    minimum: int = 5
    """Shortest time between two plans [control steps]."""
    maximum: int = 50
    """Longest time between two plans [control steps]."""
    miss: float = 0.003
    """Largest distance of the target from its forecast [m]."""
    late: float = 5.0
    """Control steps by which the robot may be later than planned."""

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

    def start(self, observation: Observation) -> Clock:
        """Clock of rows that have no plan yet."""
        return Clock.until(self.first_step, self.maximum, observation.step_count)

    def tick(
        self, clock: Clock, observation: Observation, plan: Plan, *, busy: Tensor | None, late: Late
    ) -> tuple[Clock, Tensor]:
        """Which rows plan now, see `Schedule.tick`.

        The clock's countdown runs to the latest possible next plan, and below 0 in busy rows that are overdue.
        """
        window, countdown, replans = clock
        passed = window - countdown
        may = (replans > 0) & (passed >= self.minimum) & (passed % self.every == 0)
        due = (countdown <= 0) & (may | (replans == 0))
        if busy is not None:
            due, may = due & ~busy, may & ~busy
        looked = may & ~due
        if any_row(looked):
            miss = torch.linalg.vector_norm(plan.ahead(1).squeeze(-2) - observation.target_pos, dim=-1)
            misfit = (miss > self.miss) | (late(looked) > self.late) | (plan.arrival_steps == 0)
            due = due | (looked & misfit)
        return Clock(window, torch.where(due, window, countdown), replans + due), due


def starting_at(schedule: Schedule, first_step: int) -> Schedule:
    """``schedule`` with its first plan at ``first_step``; unchanged if it has no ``first_step``."""
    settings: Any = schedule
    named = dataclasses.is_dataclass(schedule) and any(
        field.name == "first_step" for field in dataclasses.fields(schedule)
    )
    return dataclasses.replace(settings, first_step=first_step) if named else schedule


def lateness(eta: ArrivalModel, observation: Observation, plan: Plan, chunk: int | None, rows: Tensor) -> Tensor:
    """Predicted minus planned time to the goal [control steps], ``(*B,)``: how late the robots are.

    Infinite where a robot never arrives; values outside ``rows`` (*B,) bool are meaningless. ``eta`` is given ``chunk``
    rows at a time.
    """

    def measure(robot_state: Tensor, goal: Tensor, planned_steps: Tensor) -> tuple[Tensor]:
        arrival = eta.arrival(robot_state.unsqueeze(-2), goal.unsqueeze(-2), estimator="expectation")
        eta_steps = arrival.steps.masked_fill(arrival.never, torch.inf).squeeze(-1)
        return (eta_steps - planned_steps,)

    inputs = observation.robot_state, plan.goal, plan.arrival_steps
    on_time = torch.zeros_like(observation.target_pos[..., 0])
    return apply_to_rows(measure, rows, inputs, (on_time,), chunk=chunk)[0]
