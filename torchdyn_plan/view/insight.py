"""What a plan was based on: the forecast and its uncertainty, all candidate meetings, and the reachable region.

Nothing is computed twice: the planner's own search is wrapped, and its inputs are kept.
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
"""Most meetings shown; a search with more candidates is subsampled."""
GRID = 17
"""Points along a side of the square in which the reachable region is shown."""


class Insight(NamedTuple):
    """What a plan of one robot was based on. Unknown values are NaN."""

    begin: int
    """Control step since the reset from which its times count: the step at which the plan was to be used."""
    path: Tensor
    """``(F, D)`` forecast of the target 1 … F control steps later [m, world]."""
    half_width: Tensor
    """``(F, 2)`` half-widths along x and y of the interval that holds the target with P = `SHARE` [m]."""
    goals: Tensor
    """``(K, D)`` candidate goals of the tool [m, world]."""
    target_steps: Tensor
    """``(K,)`` control steps until the target is there."""
    slack: Tensor
    """``(K,)`` control steps that the robot would wait there for the target; negative if it would be late, -inf if it
    never arrives or the target is lost by then."""
    region: Tensor
    """``(G, D)`` grid points that the robot could go to [m, world]."""
    region_steps: Tensor
    """``(G,)`` control steps to reach them; infinite for never."""


class Shown(NamedTuple):
    """Inputs of a goal search for B robots, without the arrival model."""

    forecast: Forecast
    target_pos: Tensor
    """``(B, D)`` [m, world]."""
    context: SearchContext


@dataclass(kw_only=True, eq=False)
class WatchedSearch:
    """Wraps a goal search and keeps its inputs; the result is unchanged."""

    search: GoalSearch
    shown: list[Shown] = field(default_factory=list)
    """Inputs since the list was last read."""

    @property
    def reads_turn(self) -> bool:
        """Whether the wrapped search reads how the tool is to be turned."""
        return getattr(self.search, "reads_turn", False)

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """See `GoalSearch`."""
        self.shown.append(Shown(forecast, target_pos, context))
        return self.search(forecast, target_pos, eta, context)


class Watch:
    """Runs a planner, and reports what each of its plans was based on."""

    def __init__(self, planner: Any) -> None:
        """Watch ``planner``; a planner without plans has nothing to report."""
        inner = planner.planner if isinstance(planner, TrackedPlanner) else planner
        self.planner, self._inner, self._search = planner, None, None
        if isinstance(inner, DynamicPlanner):
            self._search = WatchedSearch(search=inner.search)
            self._inner = inner.with_parts(search=self._search)
            self.planner = self._inner if inner is planner else planner.with_planner(self._inner)

    def insight(self, robot_state: Tensor, grid: Tensor, step: int) -> Insight | None:
        """What the plan just made was based on; None if no plan was made.

        Args:
            robot_state: ``(1, S)`` when it was made.
            grid: ``(G, D)`` points for which arrival times are queried [m, world].
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
    """Insight of the first row, from the inputs ``shown`` to ``search`` at ``step``; times start ``delay`` later."""
    path, now, descent = shown.forecast.path[:1], shown.target_pos[:1], getattr(search, "descent_steps", 0.0)
    lost_at, turn = shown.context.lost, shown.context.turn
    if hasattr(search, "candidates"):
        found = search.candidates(torch.cat([now.unsqueeze(-2), path], dim=-2), lost_at)
        thin = slice(None, None, -(-found.goals.shape[-2] // CANDIDATES))
        goals, target_steps = found.goals[:, thin], found.target_steps.expand(found.goals.shape[:-1])[:, thin]
        lost = None if found.lost is None else found.lost[:, thin]
        quats = None if turn is None else turn[:1, (found.steps[thin] - 1).clamp_min(0)]
    else:
        stride = -(-path.shape[-2] // CANDIDATES)
        goals, target_steps = path[:, stride - 1 :: stride], torch.arange(stride, path.shape[-2] + 1, stride)[None]
        lost, quats = None if lost_at is None else lost_at.forecast(goals), None
    slack = target_steps + delay - descent - _steps_to(eta, goals, quats)
    half_width = torch.full_like(path[0, :, :2], torch.nan)
    if shown.forecast.spread is not None:
        half_width = shown.forecast.spread.interval(SHARE)[0]
    places = search.goals(grid) if hasattr(search, "goals") else grid
    # A goal that is moved into reach says nothing about the original position.
    moved = (places - grid)[:, :2].norm(dim=-1) > 1e-6
    # Zeros for a quaternion leave the tool turned as it is.
    as_turned = None if turn is None else places.new_zeros(1, len(places), 4)
    return Insight(
        begin=step + delay,
        path=path[0],
        half_width=half_width,
        goals=goals[0],
        target_steps=target_steps[0],
        slack=(slack if lost is None else slack.masked_fill(lost, -torch.inf))[0],
        region=places,
        region_steps=_steps_to(eta, places[None], as_turned)[0].masked_fill(moved, torch.inf),
    )


def _steps_to(eta: ArrivalQuery, goals: Tensor, quats: Tensor | None = None) -> Tensor:
    """Control steps (1, K) to goals (1, K, D), turned by ``quats`` (1, K, 4) if any; infinite for never."""
    if quats is not None:
        goals = torch.cat([goals, quats], dim=-1)
    arrival = eta(goals, estimator="expectation")
    return arrival.steps.masked_fill(arrival.never.bool(), torch.inf)
