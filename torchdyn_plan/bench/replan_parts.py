"""What `torchdyn-plan bench replan` times: a re-plan, its parts, and the planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.bench.observations import Moments, observe
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import Planner
from torchdyn_plan.nets.arrival import Arrival
from torchdyn_plan.nets.distributions import Spread
from torchdyn_plan.nets.forecast import Forecast
from torchdyn_plan.planners import Background, DynamicPlanner, IKPlanner, Observation, Plan, SearchContext

GOALS = (1, 4, 60)
"""Goals whose arrival is asked for at once."""
CONSTANT_STEPS, BIN_WIDTH, BINS = 50.0, 5, 100
"""Control steps to any goal where a search is timed alone, and the bins of time in which they are told."""


class Part(NamedTuple):
    """Something that is timed."""

    call: Callable[..., Sequence[Tensor]]
    """From what is read to what is compared, both with rows in front."""
    inputs: Callable[[Moments], tuple[Any, ...]]
    """What it reads, tensors or tensordicts."""
    before: Callable[[], object] | None = None
    """Called before each call, and not timed; None for nothing to be done."""


Parts = dict[str, Part]
"""By name."""


def replans(name: str, planner: DynamicPlanner) -> Parts:
    """A whole re-plan of ``planner``: goal and arrival steps."""

    def inputs(seen: Moments) -> tuple[Tensor, ...]:
        observation = observe(planner, seen.first)
        return (*Plan.hold(observation, 0), *observation.flat())

    return {f"re-plan, {name}": Part(flat_replan(planner), inputs)}


def flat_replan(planner: DynamicPlanner) -> Callable[..., tuple[Tensor, ...]]:
    """``planner.replan`` as compilers like it: from tensors of a `Plan` and an `Observation` to goal and arrival."""
    count = len(Plan._fields)

    def replan(*tensors: Tensor) -> tuple[Tensor, ...]:
        plan = planner.replan(Observation.of(tensors[count:]), Plan(*tensors[:count]))
        return plan.goal, plan.arrival_steps

    return replan


def forecasts(planner: DynamicPlanner) -> Parts:
    """The forecaster of ``planner`` alone."""

    def forecast(*seen: Tensor) -> tuple[Tensor, ...]:
        found = planner.forecaster.predict(*seen)
        return found.path, *(found.spread or ())

    return {"forecast": Part(forecast, lambda seen: observe(planner, seen.first).seen)}


def arrivals(planner: DynamicPlanner) -> Parts:
    """The arrival model of ``planner`` alone."""

    def arrive(state: Tensor, goals: Tensor) -> tuple[Tensor]:
        return (planner.eta.from_state(state)(goals, estimator="expectation").steps,)

    def inputs(seen: Moments, *, count: int) -> tuple[Tensor, Tensor]:
        observation = observe(planner, seen.first)
        path = planner.forecaster.predict(*observation.seen).path
        spread = torch.linspace(0, path.shape[-2] - 1, count, device=path.device).long()
        return observation.robot_state, path[:, spread]

    return {f"ETA, {count} goal{'s' * (count > 1)}": Part(arrive, partial(inputs, count=count)) for count in GOALS}


def searches(name: str, planner: DynamicPlanner) -> Parts:
    """The search of ``planner`` alone, on its own forecast and with arrivals that cost nothing."""

    def search(
        path: Tensor, target_pos: Tensor, tool_pos: Tensor, planned_steps: Tensor, *spread: Tensor
    ) -> tuple[Tensor, Tensor]:
        forecast = Forecast(path, Spread(*spread) if spread else None)
        context = SearchContext(tool_pos, planned_steps, planner.lost)
        meeting = planner.search(forecast, target_pos, _constant_arrival, context)
        return meeting.goal, meeting.arrival_steps

    def inputs(seen: Moments) -> tuple[Tensor, ...]:
        observation = observe(planner, seen.first)
        forecast = planner.forecaster.predict(*observation.seen)
        steps = torch.zeros_like(observation.step_count)
        return forecast.path, observation.target_pos, observation.tool_pos, steps, *(forecast.spread or ())

    return {f"search alone, {name}": Part(search, inputs)}


def steps(name: str, planner: Planner, seen: Moments) -> Parts:
    """A whole control step of ``planner``: one that plans, and one between plans, as far as it has such steps."""
    if not isinstance(planner, DynamicPlanner):
        return {f"step, {name}": Part(partial(_step, planner), lambda seen: (seen.between,))}
    # Plans that a thread makes are no part of what is seen: each step begins without one under way.
    drop = planner.delivery.drop if isinstance(planner.delivery, Background) else None

    def inputs(seen: Moments, *, plans: bool) -> tuple[Any]:
        before = seen.planning if plans else seen.between
        _check_step(planner, before, drop, plans=plans)
        return (before,)

    found = {}
    for what, plans, rows in (("that plans", True, seen.planning), ("between plans", False, seen.between)):
        if rows is not None:
            found[f"step {what}, {name}"] = Part(partial(_step, planner), partial(inputs, plans=plans), drop)
    return found


def _step(planner: Planner, before: TensorDictBase) -> tuple[Tensor]:
    return (planner(before.copy())[keys.ACTION],)


def _check_step(planner: Planner, before: Any, drop: Callable[[], object] | None, *, plans: bool) -> None:
    """Raise `InputError` if the step, repeated, does not plan as it did in an episode, where it ``plans`` or not."""
    if drop is not None:
        drop()
    planned = planner(before.copy()).get((keys.PLAN, "replanned"))
    if bool((planned != plans).any()):
        raise InputError(
            f"the step {'plans' if plans else 'does not plan'} in an episode, but not when it is repeated: "
            "what the planner remembers must lie in the tensordict"
        )


def static_steps(static: Callable[[TensorDictBase], TensorDictBase]) -> Parts:
    """A control step of a static planner alone, and a path of an `IKPlanner`."""

    def inputs(seen: Moments) -> tuple[TensorDictBase]:
        before = seen.first.copy()
        return (before.set(keys.GOAL, before[keys.TARGET_POS]),)

    found = {"static planner's step": Part(partial(_step, static), inputs)}
    if isinstance(static, IKPlanner):
        path = Part(
            lambda joint_pos, goal: (static.path(joint_pos, goal),),
            lambda seen: (seen.first[keys.JOINT_POS], seen.first[keys.TARGET_POS]),
        )
        found[f"IK path of {static.PATH_LENGTH} steps"] = path
    return found


def in_blocks(call: Callable[..., Sequence[Tensor]], rows: int, *inputs: Any) -> Sequence[Tensor]:
    """``call`` of at most ``rows`` rows at a time: larger ones leave the processor's caches."""
    if len(inputs[0]) <= rows:
        return call(*inputs)
    blocks = zip(*(value.split(rows) for value in inputs), strict=True)
    return [torch.cat(values) for values in zip(*(call(*block) for block in blocks), strict=True)]


def _constant_arrival(goal: Tensor, *, estimator: str = "mode") -> Arrival:
    """Every goal in as many control steps, at no cost."""
    never = goal.new_zeros(goal.shape[:-1], dtype=torch.bool)
    steps = goal.new_full(goal.shape[:-1], CONSTANT_STEPS)
    if estimator != "distribution":
        return Arrival(steps, never)
    bins = (torch.arange(BINS, device=goal.device) == CONSTANT_STEPS // BIN_WIDTH).to(goal.dtype)
    return Arrival(steps, never, bins.expand(*goal.shape[:-1], BINS), BIN_WIDTH)
