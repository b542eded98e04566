"""Planning in a background thread, with a deadline, for control loops in real time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.delivery import MakePlans
from torchdyn_plan.planners.maneuver import NoState
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.rows import where_rows
from torchdyn_plan.planners.seconds import steps_in


class Order(NamedTuple):
    """A request for plans that was handed to the thread."""

    made: Future[Plan]
    rows: Tensor
    """``(*B,)`` bool: rows that wait for a plan."""
    step_count: Tensor
    """``(*B,)`` step at which they were ordered."""


class Background:
    """Makes plans in a thread while the control loop runs: a planner's ``delivery``.

    A plan is used ``latency`` control steps after it was ordered, the step for which it was made. If it is late it is
    used as soon as it is ready; if it is not ready by the ``deadline`` it is dropped, and the last valid goal is kept.
    The thread makes one plan at a time. Because a thread cannot be stored in a tensordict, one object serves one loop.
    """

    State: ClassVar[type[NoState]] = NoState

    def __init__(self, *, latency: int, deadline: int, executor: Executor | None = None) -> None:
        """Set up the thread.

        Args:
            latency: control steps from observation to action, see `measured_latency`.
            deadline: control steps after which a plan is dropped, at least ``latency``.
            executor: runs one job at a time; a new thread by default.
        """
        check_number("latency", latency, minimum=0, integer=True)
        check_number("deadline", deadline, minimum=latency, integer=True)
        self.delay, self.deadline = latency, deadline
        self.executor = executor or ThreadPoolExecutor(1, thread_name_prefix="planner")
        self.used, self.missed = 0, 0
        self._order: Order | None = None

    @classmethod
    def by_seconds(
        cls, *, latency: float, deadline: float, control_step: float, executor: Executor | None = None
    ) -> Background:
        """The same with times in seconds, in control steps of ``control_step`` [s], rounded up."""
        steps = steps_in("latency", latency, control_step), steps_in("deadline", deadline, control_step)
        return cls(latency=steps[0], deadline=steps[1], executor=executor)

    def close(self) -> None:
        """Wait for the last plan and end the thread."""
        self.executor.shutdown()

    def drop(self) -> None:
        """Discard the plan in progress, when the loop restarts or jumps."""
        order, self._order = self._order, None
        if order is not None:
            wait([order.made])

    def start(self, plan: Plan) -> NoState:
        """Nothing."""
        return NoState()

    def older(self, state: NoState) -> NoState:
        """Nothing."""
        return state

    def arrive(self, plan: Plan, state: NoState, observation: Observation) -> tuple[Plan, Tensor]:
        """Plans that are ready and due; re-raises an exception from the thread.

        All rows are busy while the thread is.
        """
        step_count, order = observation.step_count, self._order
        busy = torch.zeros_like(step_count, dtype=torch.bool)
        if order is None:
            return plan, busy
        rows, age = order.rows & (step_count > 0), step_count - order.step_count
        self._order = order._replace(rows=rows)
        if not order.made.done() or (rows & (age < self.delay)).any():
            return plan, ~busy
        made, self._order = order.made.result(), None
        now = rows & (age <= self.deadline)
        self.used, self.missed = self.used + int(now.any()), self.missed + int((rows & ~now).any())
        late = (age - self.delay).clamp_min(0)
        made = made._replace(arrival_steps=(made.arrival_steps - late).clamp_min(0), age=made.age + late)
        return Plan(*(where_rows(now, new, old) for new, old in zip(made, plan, strict=True))), busy

    def order(
        self, make: MakePlans, due: Tensor, observation: Observation, plan: Plan, state: NoState
    ) -> tuple[Plan, NoState]:
        """Hand the work to the thread if any row is due."""
        if due.any():
            # The environment may overwrite the same memory while the thread reads it.
            copy = Observation.of([value.clone() for value in observation.flat()])
            made = self.executor.submit(_make, make, due, copy, plan, torch.is_grad_enabled())
            self._order = Order(made, due, copy.step_count)
        return plan, state


def _make(make: MakePlans, due: Tensor, observation: Observation, plan: Plan, gradients: bool) -> Plan:
    """The plans; torch's gradient mode is thread-local, so it is passed in."""
    with torch.set_grad_enabled(gradients):
        return make(due, observation, plan, plan)


def measured_latency(plan: Callable[[], object], control_step: float, *, runs: int = 20, quantile: float = 0.95) -> int:
    """Control steps that ``plan`` takes on this machine: a quantile of ``runs`` timed calls, rounded up.

    Args:
        plan: makes one plan.
        control_step: length of a control step [s].
        runs: timed calls, after one warm-up call.
        quantile: of the times, 0 … 1.
    """
    check_number("control_step", control_step, minimum=1e-9)
    check_number("runs", runs, minimum=1, integer=True)
    check_number("quantile", quantile, minimum=0.0, maximum=1.0)
    plan()
    durations = []
    for _ in range(runs):
        started = time.perf_counter()
        plan()
        durations.append(time.perf_counter() - started)
    return math.ceil(sorted(durations)[math.ceil(quantile * (runs - 1))] / control_step)
