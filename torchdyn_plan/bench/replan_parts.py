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
from torchdyn_plan.nets.arrival import Arrival
from torchdyn_plan.nets.forecast import Forecast
from torchdyn_plan.planners import DynamicPlanner, IKPlanner, Observation, Plan, SearchContext

GOALS = (1, 4, 60)
"""Goals whose arrival is asked for at once."""
CONSTANT_STEPS = 50.0
"""Control steps to any goal, where a search is timed alone."""


class Part(NamedTuple):
    """Something that is timed."""

    call: Callable[..., Sequence[Tensor]]
    """From what is read to what is compared, both with rows in front."""
    inputs: Callable[[Moments], tuple[Any, ...]]
    """What it reads, tensors or tensordicts."""


Parts = dict[str, Part]
"""By name."""


def replans(name: str, planner: DynamicPlanner) -> Parts:
    """A whole re-plan of ``planner``: goal and arrival steps."""

    def inputs(seen: Moments) -> tuple[Tensor, ...]:
        observation = observe(planner, seen.planning)
        return (*Plan.hold(observation, 0), *observation.flat())

    return {f"re-plan, {name}": Part(flat_replan(planner), inputs)}


def flat_replan(planner: DynamicPlanner) -> Callable[..., tuple[Tensor, ...]]:
    """``planner.replan`` as compilers like it: from tensors of a `Plan` and an `Observation` to goal and arrival."""
    count = len(Plan._fields)

    def replan(*tensors: Tensor) -> tuple[Tensor, ...]:
        plan = planner.replan(Observation.of(tensors[count:]), Plan(*tensors[:count]))
        return plan.goal, plan.arrival_steps

    return replan


def networks(planner: DynamicPlanner) -> Parts:
    """The forecaster and the arrival model of ``planner`` alone."""

    def forecast(*seen: Tensor) -> tuple[Tensor]:
        return (planner.forecaster.predict(*seen).path,)

    def arrivals(state: Tensor, goals: Tensor) -> tuple[Tensor]:
        return (planner.eta.from_state(state)(goals, estimator="expectation").steps,)

    def goals(seen: Moments, *, count: int) -> tuple[Tensor, Tensor]:
        observation = observe(planner, seen.planning)
        path = planner.forecaster.predict(*observation.seen).path
        spread = torch.linspace(0, path.shape[-2] - 1, count, device=path.device).long()
        return observation.robot_state, path[:, spread]

    found = {"forecast": Part(forecast, lambda seen: observe(planner, seen.planning).seen)}
    for count in GOALS:
        found[f"ETA, {count} goal{'s' * (count > 1)}"] = Part(arrivals, partial(goals, count=count))
    return found


def searches(name: str, planner: DynamicPlanner) -> Parts:
    """The search of ``planner`` alone, on its own forecast and with arrivals that cost nothing."""

    def search(path: Tensor, target_pos: Tensor, tool_pos: Tensor, planned_steps: Tensor) -> tuple[Tensor, Tensor]:
        context = SearchContext(tool_pos, planned_steps, planner.lost)
        meeting = planner.search(Forecast(path), target_pos, _constant_arrival, context)
        return meeting.goal, meeting.arrival_steps

    def inputs(seen: Moments) -> tuple[Tensor, ...]:
        observation = observe(planner, seen.planning)
        path = planner.forecaster.predict(*observation.seen).path
        return path, observation.target_pos, observation.tool_pos, torch.zeros_like(observation.step_count)

    return {f"search alone, {name}": Part(search, inputs)}


def steps(name: str, planner: DynamicPlanner, seen: Moments) -> Parts:
    """A whole control step of ``planner``: one that plans, and one between plans if ``seen`` has any."""

    def step(before: TensorDictBase) -> tuple[Tensor]:
        return (planner(before.copy())[keys.ACTION],)

    found = {f"step that plans, {name}": Part(step, lambda seen: (seen.planning,))}
    if seen.between is not None:
        found[f"step between plans, {name}"] = Part(step, lambda seen: (seen.between,))
    return found


def static_steps(static: Callable[[TensorDictBase], TensorDictBase]) -> Parts:
    """A control step of a static planner alone, and a path of an `IKPlanner`."""

    def step(before: TensorDictBase) -> tuple[Tensor]:
        return (static(before.copy())[keys.ACTION],)

    def inputs(seen: Moments) -> tuple[TensorDictBase]:
        before = seen.planning.copy()
        return (before.set(keys.GOAL, before[keys.TARGET_POS]),)

    found = {"static planner's step": Part(step, inputs)}
    if isinstance(static, IKPlanner):
        path = Part(
            lambda joint_pos, goal: (static.path(joint_pos, goal),),
            lambda seen: (seen.planning[keys.JOINT_POS], seen.planning[keys.TARGET_POS]),
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
    return Arrival(goal.new_full(goal.shape[:-1], CONSTANT_STEPS), never)
