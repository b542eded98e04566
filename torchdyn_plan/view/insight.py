"""What a plan was made from: the forecast and how sure it is, every meeting that could be, and where the robot can go.

Nothing is computed twice: the planner's own search is given a companion that keeps what it is shown.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.planners import DynamicPlanner, TrackedPlanner
from torchdyn_plan.planners.search.meeting import NO_CONTEXT, GoalSearch, Meeting, SearchContext

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalQuery
    from torchdyn_plan.nets.forecast import Forecast

SHARE = 0.8
"""The target is within the forecast's half-widths with this probability, along each axis."""
CANDIDATES = 60
"""Meetings that are shown, at most; of a search that looks at more every so many of them."""
GRID = 17
"""Places along a side of the square in which the reachable region is shown."""


class Insight(NamedTuple):
    """What a plan was made from, of one robot. All that is unknown is NaN."""

    made_at: int
    """Control step since the reset."""
    path: Tensor
    """``(F, D)`` where the target was expected 1 … F control steps later [m, world]."""
    half_width: Tensor
    """``(F, 2)`` half-widths along x and y of the interval that holds the target with P = `SHARE` [m]."""
    goals: Tensor
    """``(K, D)`` where the tool could have been sent to meet the target [m, world]."""
    target_steps: Tensor
    """``(K,)`` control steps until the target is there."""
    slack: Tensor
    """``(K,)`` control steps that the robot would wait there for the target; negative if it would be late, -inf if it
    never comes there, or if the target is lost by then."""
    region: Tensor
    """``(G, D)`` places on a grid to which the robot can go [m, world]."""
    region_steps: Tensor
    """``(G,)`` control steps that it needs there; infinite for never."""


@dataclass(kw_only=True, eq=False)
class WatchedSearch:
    """A goal search that keeps what it is shown; it finds what the search inside finds."""

    search: GoalSearch
    shown: list[tuple[Forecast, Tensor, SearchContext]] = field(default_factory=list)
    """Forecast, target and context since they were last taken."""

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """As of `GoalSearch`."""
        self.shown.append((forecast, target_pos, context))
        return self.search(forecast, target_pos, eta, context)


class Watch:
    """Plays for a planner, and tells what each of its plans was made from."""

    def __init__(self, planner: Any) -> None:
        """Watch ``planner``; of one that makes no plans there is nothing to tell."""
        inner = planner.planner if isinstance(planner, TrackedPlanner) else planner
        self.planner, self._inner, self._search = planner, None, None
        if isinstance(inner, DynamicPlanner):
            self._search = WatchedSearch(search=inner.search)
            self._inner = inner.with_parts(search=self._search)
            self.planner = self._inner if inner is planner else planner.with_planner(self._inner)

    def insight(self, robot_state: Tensor, grid: Tensor, step: int) -> Insight | None:
        """What the plan was made from that has just been made, None if there was none.

        Args:
            robot_state: ``(1, S)`` when it was made.
            grid: ``(G, D)`` places at which to ask where the robot can go [m, world].
            step: control step since the reset.
        """
        if self._search is None or self._inner is None or not self._search.shown:
            return None
        forecast, target_pos, context = self._search.shown[-1]
        self._search.shown.clear()
        delay = 0 if self._inner.delivery is None else self._inner.delivery.delay
        return look_into(
            self._inner, self._search.search, forecast, target_pos, context, robot_state, grid, step, delay
        )


def look_into(
    planner: DynamicPlanner,
    search: Any,
    forecast: Forecast,
    target_pos: Tensor,
    context: SearchContext,
    robot_state: Tensor,
    grid: Tensor,
    step: int,
    delay: int,
) -> Insight:
    """The first row of what ``search`` was shown, as an `Insight`."""
    path, now = forecast.path[:1], target_pos[:1]
    eta, descent = planner.eta.from_state(robot_state), getattr(search, "descent_steps", 0.0)
    if hasattr(search, "candidates"):
        found = search.candidates(path, now, context.lost)
        thin = slice(None, None, -(-found.goals.shape[-2] // CANDIDATES))
        goals, target_steps = found.goals[:, thin], found.target_steps.expand(found.goals.shape[:-1])[:, thin]
        lost = None if found.lost is None else found.lost[:, thin]
    else:
        stride = -(-path.shape[-2] // CANDIDATES)
        goals, target_steps = path[:, stride - 1 :: stride], torch.arange(stride, path.shape[-2] + 1, stride)[None]
        lost = None if context.lost is None else context.lost.forecast(goals)
    slack = target_steps + delay - descent - _steps_to(eta, goals)
    half_width = torch.full_like(path[0, :, :2], torch.nan)
    if forecast.spread is not None:
        half_width = forecast.spread.interval(SHARE)[0]
    places = search.goals(grid) if hasattr(search, "goals") else grid
    # A goal that is moved to where the tool can be says nothing of the place itself.
    moved = (places - grid)[:, :2].norm(dim=-1) > 1e-6
    return Insight(
        made_at=step,
        path=path[0],
        half_width=half_width,
        goals=goals[0],
        target_steps=target_steps[0],
        slack=(slack if lost is None else slack.masked_fill(lost, -torch.inf))[0],
        region=places,
        region_steps=_steps_to(eta, places[None])[0].masked_fill(moved, torch.inf),
    )


def _steps_to(eta: ArrivalQuery, goals: Tensor) -> Tensor:
    """Control steps (1, K) to goals (1, K, D), infinitely many where the robot never arrives."""
    arrival = eta(goals, estimator="expectation")
    return arrival.steps.masked_fill(arrival.never.bool(), torch.inf)
