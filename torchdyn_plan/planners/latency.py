"""Planning takes time: what will be when a plan takes effect, and how plans come late."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.eta import Arrival
from torchdyn_plan.planners.rows import apply_to_rows

Values = dict[str, Tensor]
"""What a plan consists of, by name, ``(*B, …)`` each."""


def skip_steps(forecast: Tensor, target_pos: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Forecast ``(*B, F - steps, 3)`` and target ``(*B, 3)`` [m, world] as they are expected in ``steps`` steps.

    Raises:
        InputError: the forecast does not reach so far.
    """
    if steps == 0:
        return forecast, target_pos
    if steps >= forecast.shape[-2]:
        raise InputError(f"latency must be below the forecast's {forecast.shape[-2]} steps, got {steps}")
    return forecast[..., steps:, :], forecast[..., steps - 1, :]


def arrival_after(eta: Callable[..., Arrival], steps: int) -> Callable[..., Arrival]:
    """``eta`` counted from ``steps`` control steps later, as of a robot that has gone on towards the goal meanwhile."""
    if steps == 0:
        return eta

    def later(goals: Tensor, **settings: Any) -> Arrival:
        arrival = eta(goals, **settings)
        return Arrival((arrival.steps - steps).clamp_min(0.0), arrival.never)

    return later


class Job(NamedTuple):
    """Plans to be made, in some rows."""

    function: Callable[..., Sequence[Tensor]]
    """Makes plans for some rows: the entries of `Values` in their order."""
    due: Tensor
    """``(*B,)`` bool: the rows."""
    inputs: tuple[Tensor, ...]
    """What ``function`` reads, ``(*B, …)`` each."""
    step_count: Tensor
    """``(*B,)`` control steps since the reset."""
    chunk: int | None = None
    """Rows that ``function`` sees at once."""

    def __call__(self, values: Values) -> Values:
        """``values`` with the rows that are due replaced by new plans."""
        made = apply_to_rows(self.function, self.due, self.inputs, tuple(values.values()), chunk=self.chunk)
        return dict(zip(values, made, strict=True))


class Delivery(Protocol):
    """How a plan gets from its making to its use."""

    def keys(self, values: Iterable[str], /) -> tuple[str, ...]:
        """Names of what it keeps under ``plan`` for plans of such ``values``."""
        ...

    def arrive(
        self, plan: TensorDictBase | None, values: Values, step_count: Tensor, /
    ) -> tuple[Values, Tensor | None]:
        """Values of the plans in use at this step, and ``(*B,)`` where one is still under way, None for nowhere.

        Args:
            plan: the memory, as it was after the step before.
            values: of the plans in use until now.
            step_count: ``(*B,)`` control steps since the reset.
        """
        ...

    def order(self, job: Job, plan: TensorDictBase | None, values: Values, /) -> tuple[Values, Values]:
        """Begin ``job``: the values in use at this step, and what is to be kept under ``plan``."""
        ...


class AtOnce:
    """A plan takes effect in the step in which it is made."""

    def keys(self, values: Iterable[str]) -> tuple[str, ...]:
        """Nothing is kept."""
        return ()

    def arrive(self, plan: TensorDictBase | None, values: Values, step_count: Tensor) -> tuple[Values, None]:
        """Nothing is ever under way."""
        return values, None

    def order(self, job: Job, plan: TensorDictBase | None, values: Values) -> tuple[Values, Values]:
        """Plan now."""
        return job(values), {}


class Delayed:
    """A plan takes effect some control steps after it was begun, and until then no other is begun in its row.

    It waits in the tensordict under ``plan``, in entries ``pending_…``, with ``pending_steps`` (*B,), the steps until
    it arrives, 0 for none. What arrives is taken as it is: nobody says how old it is.
    """

    def __init__(self, steps: int) -> None:
        """Deliver after ``steps`` control steps."""
        check_number("steps", steps, minimum=1, integer=True)
        self.steps = steps

    def keys(self, values: Iterable[str]) -> tuple[str, ...]:
        """The pending values and ``pending_steps``."""
        return (*map(_pending, values), _pending("steps"))

    def arrive(self, plan: TensorDictBase | None, values: Values, step_count: Tensor) -> tuple[Values, Tensor]:
        """Those that are due to arrive now."""
        left = self._left(plan, step_count)
        if plan is None or not (now := left == 0).any():
            return values, left > 0
        return {name: where_rows(now, plan.get(_pending(name)), old) for name, old in values.items()}, left > 0

    def order(self, job: Job, plan: TensorDictBase | None, values: Values) -> tuple[Values, Values]:
        """Plan, and let it wait."""
        waiting = values
        if plan is not None and plan.get(_pending("steps"), None) is not None:
            waiting = {name: plan.get(_pending(name)) for name in values}
        steps = self._left(plan, job.step_count).clamp_min(0).masked_fill(job.due, self.steps)
        kept = {_pending(name): value for name, value in job(waiting).items()}
        return values, kept | {_pending("steps"): steps}

    def _left(self, plan: TensorDictBase | None, step_count: Tensor) -> Tensor:
        """Steps from now until a plan arrives, ``(*B,)``; negative for none."""
        left = None if plan is None else plan.get(_pending("steps"), None)
        if left is None:
            return torch.full_like(step_count, -1)
        return torch.where(step_count == 0, -1, left - 1)


def where_rows(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """``new`` (*B, …) in the rows of ``mask`` (*B,), ``old`` in the others."""
    return torch.where(mask[(..., *[None] * (new.ndim - mask.ndim))], new, old)


def _pending(name: str) -> str:
    return f"pending_{name}"
