"""What `torchdyn-plan bench replan` times: a re-plan, its parts, and the planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.nets.eta import Arrival
from torchdyn_plan.planners import CornerSearch, DynamicPlanner, ExactSearch, IKPlanner, MeetingPlanner

Part = Callable[..., Sequence[Tensor]]
"""Something timed: from tensors to what is compared."""
Inputs = Callable[[TensorDictBase], tuple[Tensor, ...]]
"""What a part reads, from what a planner sees."""

PLANNED_STEPS = 60
"""Control steps to the meeting that the meeting planner is said to have planned before."""
SEARCHES = {"corner": CornerSearch(), "exact": ExactSearch(), "exact, coarse to fine": ExactSearch(coarse=4)}


def replans(planner: DynamicPlanner, meeting: MeetingPlanner) -> dict[str, tuple[Part, Inputs]]:
    """Whole re-plans, by name, of ``planner`` with each search and of ``meeting`` as it is: goal and arrival steps."""
    found: dict[str, tuple[Part, Inputs]] = {}
    for name, search in SEARCHES.items():
        other = DynamicPlanner(planner.static, planner.forecaster, planner.eta, search=search)
        found[f"re-plan, {name}"] = partial(_first_two, other.plan), _plan_inputs
    found["re-plan, meet"] = partial(_first_two, meeting.plan_ahead), _ahead_inputs
    return found


def networks(planner: DynamicPlanner) -> dict[str, tuple[Part, Inputs]]:
    """The networks of ``planner`` alone, by name."""
    eta: Any = planner.eta

    def forecast(history: Tensor) -> tuple[Tensor]:
        return (planner.forecaster(history),)

    def arrivals(state: Tensor, goal: Tensor) -> tuple[Tensor]:
        return (eta(state.unsqueeze(1), goal),)

    found: dict[str, tuple[Part, Inputs]] = {"forecast": (forecast, lambda seen: (seen[keys.TARGET_HISTORY],))}
    for goals in (1, 4, 60):
        found[f"ETA, {goals} goal{'s' * (goals > 1)}"] = arrivals, partial(_goals, count=goals)
    return found


def searches() -> dict[str, tuple[Part, Inputs]]:
    """The searches alone, by name, on a straight forecast and with arrivals that cost nothing."""
    return {f"search alone, {name}": (partial(_search, search), _straight) for name, search in SEARCHES.items()}


def steps(planner: DynamicPlanner) -> dict[str, tuple[Part, Inputs]]:
    """What a control step is made of beside, by name; ``planner`` is on an `IKPlanner`."""
    static = planner.static
    assert isinstance(static, IKPlanner)

    def whole(inputs: Any) -> tuple[Tensor]:
        return (planner(inputs.copy())[keys.ACTION],)

    return {
        "IK path of 5 steps": (lambda q, goal: (static.path(q, goal),), lambda td: (td[keys.JOINT_POS], td[keys.GOAL])),
        "planner step that plans": (whole, lambda seen: (seen.exclude(keys.PLAN),)),
        "planner step between plans": (whole, lambda seen: (seen,)),
    }  # fmt: skip


def in_blocks(part: Part, rows: int, *inputs: Any) -> Sequence[Tensor]:
    """``part`` of at most ``rows`` rows at a time: larger ones leave the processor's caches."""
    if len(inputs[0]) <= rows:
        return part(*inputs)
    blocks = zip(*(value.split(rows) for value in inputs), strict=True)
    return [torch.cat(values) for values in zip(*(part(*block) for block in blocks), strict=True)]


def _first_two(plan: Part, *inputs: Tensor) -> Sequence[Tensor]:
    return plan(*inputs)[:2]


def _plan_inputs(seen: TensorDictBase) -> tuple[Tensor, ...]:
    return seen[keys.ROBOT_STATE], seen[keys.TARGET_POS], seen[keys.TARGET_HISTORY]


def _ahead_inputs(seen: TensorDictBase) -> tuple[Tensor, ...]:
    state, target, history = _plan_inputs(seen)
    return state, target, seen[keys.TOOL_POS], torch.full_like(seen[keys.STEP_COUNT], PLANNED_STEPS), history


def _goals(seen: TensorDictBase, *, count: int) -> tuple[Tensor, ...]:
    return seen[keys.ROBOT_STATE], _straight(seen)[0][:, :: 300 // count][:, :count].contiguous()


def _straight(seen: TensorDictBase) -> tuple[Tensor, ...]:
    """A forecast (B, 300, 3) at constant velocity, and the target now."""
    history, here = seen[keys.TARGET_HISTORY], seen[keys.TARGET_POS]
    ahead = torch.arange(1.0, 301.0, device=here.device).unsqueeze(-1)
    return here.unsqueeze(1) + (history[:, -1:] - history[:, -2:-1]) * ahead, here


def _search(search: Any, forecast: Tensor, here: Tensor) -> Sequence[Tensor]:
    return search(forecast, here, _constant_arrival)[:2]


def _constant_arrival(goal: Tensor, **_: Any) -> Arrival:
    """Every goal in 50 control steps, at no cost."""
    return Arrival(goal.new_full(goal.shape[:-1], 50.0), goal.new_zeros(goal.shape[:-1], dtype=torch.bool))
