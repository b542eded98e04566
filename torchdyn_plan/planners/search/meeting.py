"""What a goal search is given, and what it finds."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from torch import Tensor

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalQuery
    from torchdyn_plan.nets.capture import CaptureModel
    from torchdyn_plan.nets.distributions import Arrival
    from torchdyn_plan.nets.forecast import Forecast
    from torchdyn_plan.planners.plan import Lost


class Meeting(NamedTuple):
    """Where and when robot and target meet."""

    goal: Tensor
    """``(*B, D)`` [m, world]: where they meet; with a turn in the context the tool's quaternion follows."""
    arrival_steps: Tensor
    """``(*B,)`` int64: control steps from now to the meeting, at most the horizon."""
    clamped: Tensor
    """``(*B,)`` bool: an arrival that decided the goal lay beyond the horizon and was cut to it."""
    reachable: Tensor
    """``(*B,)`` bool: false where the robot never arrives at any candidate, and the goal is only a direction."""


class SearchContext(NamedTuple):
    """What a search may want to know beside forecast and arrival; each is None where nobody knows it."""

    tool_pos: Tensor | None = None
    """``(*B, D)`` [m, world], to tell goals that are reached already."""
    planned_steps: Tensor | None = None
    """``(*B,)`` control steps from now to the meeting that was planned before."""
    lost: Lost | None = None
    """When a target is lost."""
    capture: CaptureModel | None = None
    """How likely it is that a robot that waits at a goal captures the target."""
    turn: Tensor | None = None
    """``(*B, F, 4)``: how a tool that meets the target on its forecast is to be turned, quaternions wxyz."""


NO_CONTEXT = SearchContext()


class GoalSearch(Protocol):
    """A strategy that chooses where and when robot and target meet.

    One that reads how the tool is to be turned says so by ``reads_turn``.
    """

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT, /
    ) -> Meeting:
        """Choose a meeting.

        Args:
            forecast: of the target, ``(*B, F, D)`` [m, world].
            target_pos: ``(*B, D)`` [m, world], the target now.
            eta: maps goals (*B, K, D) to arrivals (*B, K).
            context: what else is known.
        """
        ...


def later(eta: ArrivalQuery, steps: int) -> ArrivalQuery:
    """``eta`` counted from ``steps`` control steps later."""

    def query(goal: Tensor, *, estimator: str = "mode") -> Arrival:
        return eta(goal, estimator=estimator).after(steps)

    return query
