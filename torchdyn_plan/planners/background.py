"""Planning beside a control loop in real time: in a thread, with a deadline."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.latency import Job, Values, where_rows


class Order(NamedTuple):
    """A job that was handed to the thread."""

    made: Future[Values]
    rows: Tensor
    """``(*B,)`` bool: rows that wait for it."""
    step_count: Tensor
    """``(*B,)`` of the step in which it was ordered."""


class Background:
    """Makes plans in a thread while the control loop goes on; hand it to `DynamicPlanner.set_latency`.

    A plan comes into use ``latency`` control steps after it was ordered, the moment for which it was made. One that is
    not ready then comes into use when it is, as old as it is; one that is not ready by the ``deadline`` never does, and
    the last valid goal is kept. The thread makes one plan at a time. A thread cannot live in a tensordict: this serves
    one loop only.
    """

    def __init__(self, *, latency: int, deadline: int, executor: Executor | None = None) -> None:
        """Join a thread to a loop.

        Args:
            latency: control steps, as the planner was told.
            deadline: control steps, at least ``latency``.
            executor: runs the jobs one after the other; a thread of its own by default.
        """
        check_number("latency", latency, minimum=0, integer=True)
        check_number("deadline", deadline, minimum=latency, integer=True)
        self.latency, self.deadline = latency, deadline
        self.executor = executor or ThreadPoolExecutor(1, thread_name_prefix="planner")
        self.used, self.missed = 0, 0
        self._order: Order | None = None

    def close(self) -> None:
        """Wait for the thread's last plan and end it."""
        self.executor.shutdown()

    def keys(self, values: Iterable[str]) -> tuple[str, ...]:
        """Nothing is kept under ``plan``."""
        return ()

    def arrive(self, plan: TensorDictBase | None, values: Values, step_count: Tensor) -> tuple[Values, Tensor]:
        """Plans that are ready and meant for now or earlier; raises what the planning raised.

        Everywhere is busy while the thread is.
        """
        busy, order = torch.zeros_like(step_count, dtype=torch.bool), self._order
        if order is None:
            return values, busy
        rows, age = order.rows & (step_count > 0), step_count - order.step_count
        self._order = order._replace(rows=rows)
        if not order.made.done() or (rows & (age < self.latency)).any():
            return values, ~busy
        made, self._order = order.made.result(), None
        now = rows & (age <= self.deadline)
        self.used, self.missed = self.used + int(now.any()), self.missed + int((rows & ~now).any())
        late = (age - self.latency).clamp_min(0)
        return {name: where_rows(now, _older(name, made[name], late), old) for name, old in values.items()}, busy

    def order(self, job: Job, plan: TensorDictBase | None, values: Values) -> tuple[Values, Values]:
        """Hand the job to the thread if any row is due."""
        if job.due.any():
            # The loop's world may write into the same memory while the thread reads.
            copy = job._replace(inputs=tuple(value.clone() for value in job.inputs))
            made = self.executor.submit(_make, copy, values, torch.is_grad_enabled())
            self._order = Order(made, job.due, job.step_count.clone())
        return values, {}


def _make(job: Job, values: Values, gradients: bool) -> Values:
    """The plans; whether gradients are wanted is known to each thread alone."""
    with torch.set_grad_enabled(gradients):
        return job(values)


def _older(name: str, value: Tensor, steps: Tensor) -> Tensor:
    """Value ``name`` of a plan that comes into use ``steps`` (*B,) after the moment for which it was made."""
    if name == "arrival_steps":
        return (value - steps).clamp_min(0)
    return value + steps if name == "outlook_age" else value


def measured_latency(plan: Callable[[], object], control_step: float, *, runs: int = 20, quantile: float = 0.95) -> int:
    """Control steps that ``plan`` takes on this machine, rounded up, by the given quantile of ``runs`` calls.

    Args:
        plan: makes one plan.
        control_step: length of a control step [s].
        runs: calls that are timed, after one that is not.
        quantile: 0 … 1.
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
