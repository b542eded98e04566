"""When plans become available, given that planning takes time. Without a delivery, plans are used at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.rows import any_row, where_rows
from torchdyn_plan.planners.seconds import steps_in

MakePlans = Callable[[Tensor, Observation, Plan, Plan], Plan]
"""Makes new plans in the rows of a mask ``(*B,)``, from the observation and the plan in use; the other rows are taken
from the last argument."""


class Delivery(Protocol):
    """Decides when plans become available; its memory from step to step is a ``State``."""

    State: ClassVar[type[Any]]
    """A `NamedTuple` of tensors ``(*B, …)``."""

    @property
    def delay(self) -> int:
        """Control steps that a planner plans ahead, to the step at which the plan becomes available."""
        ...

    def start(self, plan: Plan, /) -> Any:
        """State of rows at their first step, whose ``plan`` is to hold still."""
        ...

    def older(self, state: Any, /) -> Any:
        """The state one control step later."""
        ...

    def arrive(self, plan: Plan, state: Any, observation: Observation, /) -> tuple[Plan, Tensor]:
        """Plans in use at this step, and ``(*B,)`` bool where one is still under way.

        Args:
            plan: in use until now.
            state: of this step.
            observation: of this step.
        """
        ...

    def order(
        self, make: MakePlans, due: Tensor, observation: Observation, plan: Plan, state: Any, /
    ) -> tuple[Plan, Any]:
        """Start plans in the rows ``due`` (*B,); the plans in use stay.

        Returns:
            The new plans, or the plan in use where they are not ready yet, and the next state.
        """
        ...


class Pending(NamedTuple):
    """A plan under way in each row: the fields of `Plan`, and when it arrives."""

    goal: Tensor
    arrival_steps: Tensor
    clamped: Tensor
    reachable: Tensor
    usable: Tensor
    path: Tensor
    age: Tensor
    steps: Tensor
    """``(*B,)`` int64 control steps until it becomes available; negative for none."""

    @property
    def plan(self) -> Plan:
        """The plan itself."""
        return Plan(**{field: getattr(self, field) for field in Plan._fields})


@dataclass(frozen=True)
class Delayed:
    """A plan takes effect some control steps after it was started; until then no other starts in its row."""

    steps: int
    """Control steps from the observation to the use of the plan made from it."""
    compensate: bool = True
    """Whether the planner plans for the step of use; otherwise it ignores the delay."""

    State: ClassVar[type[Pending]] = Pending

    def __post_init__(self) -> None:
        check_number("steps", self.steps, minimum=1, integer=True)

    @classmethod
    def by_seconds(cls, latency: float, *, control_step: float, compensate: bool = True) -> Delayed:
        """Plans that take effect ``latency`` [s] after they were started, in control steps of ``control_step`` [s]."""
        return cls(steps_in("latency", latency, control_step), compensate)

    @property
    def delay(self) -> int:
        """Control steps that the planner plans ahead."""
        return self.steps if self.compensate else 0

    def start(self, plan: Plan) -> Pending:
        """No plan is under way."""
        return Pending(*plan, steps=torch.full_like(plan.age, -1))

    def older(self, state: Pending) -> Pending:
        """The state one control step later."""
        return state._replace(steps=state.steps - 1)

    def arrive(self, plan: Plan, state: Pending, observation: Observation) -> tuple[Plan, Tensor]:
        """Plans that become available now."""
        now = state.steps == 0
        if any_row(now):
            plan = Plan(*(where_rows(now, new, old) for new, old in zip(state.plan, plan, strict=True)))
        return plan, state.steps > 0

    def order(
        self, make: MakePlans, due: Tensor, observation: Observation, plan: Plan, state: Pending
    ) -> tuple[Plan, Pending]:
        """Make plans, and hold them back."""
        made = make(due, observation, plan, state.plan)
        steps = state.steps.clamp_min(0).masked_fill(due, self.steps)
        return made, Pending(*made, steps=steps)
