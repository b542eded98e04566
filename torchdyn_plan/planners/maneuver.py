"""What a planner does about its plan at every step: which goal its static planner is sent to now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

from torch import Tensor

from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan


class Maneuver(Protocol):
    """Turns the plan in use into a goal at every step; what it remembers from step to step is its ``State``."""

    State: ClassVar[type[Any]]
    """A `NamedTuple` of tensors ``(*B, …)``."""

    @property
    def lookahead(self) -> int:
        """Positions of the target's path that it reads, the present one included; 0 for none."""
        ...

    def start(self, observation: Observation, /) -> Any:
        """State of rows at their first step."""
        ...

    def __call__(self, plan: Plan, observation: Observation, holds: Tensor, state: Any, /) -> tuple[Tensor, Any]:
        """The goal at this step, ``(*B, D)`` [m, world], and the next state.

        Args:
            plan: in use.
            observation: of this step.
            holds: ``(*B,)`` bool: rows that could not plan, whose plan is to stay where the tool is.
            state: of the step before.
        """
        ...


class NoState(NamedTuple):
    """Nothing to remember."""


@dataclass(frozen=True)
class GoTo:
    """Goes to the meeting place (paper, Section III-B)."""

    State: ClassVar[type[NoState]] = NoState

    @property
    def lookahead(self) -> int:
        """None of the path."""
        return 0

    def start(self, observation: Observation) -> NoState:
        """Nothing."""
        return NoState()

    def __call__(self, plan: Plan, observation: Observation, holds: Tensor, state: NoState) -> tuple[Tensor, NoState]:
        """The plan's goal."""
        return plan.goal, state
