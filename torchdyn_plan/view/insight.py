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

    begin: int
    """Control step since the reset from which on it counts: that in which the plan was to come into use."""
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


class Shown(NamedTuple):
    """What a goal search is shown of B robots, but for the arrival model."""

    forecast: Forecast
    target_pos: Tensor
    """``(B, D)`` [m, world]."""
    context: SearchContext


@dataclass(kw_only=True, eq=False)
class WatchedSearch:
    """A goal search that keeps what it is shown; it finds what the search inside finds."""

    search: GoalSearch
    shown: list[Shown] = field(default_factory=list)
    """What it was shown since this was last asked for."""

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """As of `GoalSearch`."""
        self.shown.append(Shown(forecast, target_pos, context))
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
        shown = self._search.shown[-1]
        self._search.shown.clear()
        delay = 0 if self._inner.delivery is None else self._inner.delivery.delay
        eta = self._inner.eta.from_state(robot_state)
        return look_into(self._search.search, shown, eta, grid, step=step, delay=delay)


def look_into(search: Any, shown: Shown, eta: ArrivalQuery, grid: Tensor, *, step: int, delay: int) -> Insight:
    """The first row of what ``search`` was ``shown`` at control step ``step``, of the time from ``delay`` later on."""
    path, now, descent = shown.forecast.path[:1], shown.target_pos[:1], getattr(search, "descent_steps", 0.0)
    lost_at = shown.context.lost
    if hasattr(search, "candidates"):
        found = search.candidates(path, now, lost_at)
        thin = slice(None, None, -(-found.goals.shape[-2] // CANDIDATES))
        goals, target_steps = found.goals[:, thin], found.target_steps.expand(found.goals.shape[:-1])[:, thin]
        lost = None if found.lost is None else found.lost[:, thin]
    else:
        stride = -(-path.shape[-2] // CANDIDATES)
        goals, target_steps = path[:, stride - 1 :: stride], torch.arange(stride, path.shape[-2] + 1, stride)[None]
        lost = None if lost_at is None else lost_at.forecast(goals)
    slack = target_steps + delay - descent - _steps_to(eta, goals)
    half_width = torch.full_like(path[0, :, :2], torch.nan)
    if shown.forecast.spread is not None:
        half_width = shown.forecast.spread.interval(SHARE)[0]
    places = search.goals(grid) if hasattr(search, "goals") else grid
    # A goal that is moved to where the tool can be says nothing of the place itself.
    moved = (places - grid)[:, :2].norm(dim=-1) > 1e-6
    return Insight(
        begin=step + delay,
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
