"""The idea of this package: a planner for a static target, made to meet a moving one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan import keys
from torchdyn_plan.checks import POINT_SIZES, check_points, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners.judging import GOOD, LARGEST, act, judge
from torchdyn_plan.planners.observation import SEEN_BY_ALL, Observation
from torchdyn_plan.planners.parts import ComposedPlanner
from torchdyn_plan.planners.plan import Plan, input_status, usable_path
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.rows import apply_to_rows
from torchdyn_plan.planners.schedule import lateness
from torchdyn_plan.planners.search.meeting import SearchContext, later
from torchdyn_plan.planners.turn import Turn
from torchdyn_plan.precision import HALVES


class DynamicPlanner(ComposedPlanner):
    """Meets a moving target: history → forecast → meeting → goal → action. `ComposedPlanner` describes its parts.

    Writes ``goal`` (*B, 3 or 2) [m, world], ``arrival_steps`` (*B,), what the static planner writes, and under ``plan``
    the memory for the next step and each row's `PlanStatus`. A row plans when its schedule says so, and restarts at
    ``step_count`` 0. A row whose input or forecast is NaN or infinite, or whose target is lost, holds its tool still
    and tries again at each step; one with a bad robot state gets action 0.
    """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan where a plan is due, and act; raises `InputError` for a missing key or a wrong shape."""
        seen = observe(tensordict, self.forecaster, self.read_by_turn)
        obs, found = seen, GOOD
        if not are_sane(tensordict, self.read_besides, *seen[:3], *seen.seen):
            obs, found = judge(seen, tensordict, self.read_by_static, self.memory.names)
        # Not the cleaned one: a row that starts with bad input must not store zeros as its position.
        clock, plan, state, pending = self.memory.recall(tensordict, seen, found.spoiled)
        busy = None
        if self.delivery is not None:
            plan, busy = self.delivery.arrive(plan, pending, obs)
        late = partial(lateness, self.eta, obs, plan, self.chunk)
        ticked, due = self.schedule.tick(clock, obs, plan, busy=busy, late=late)
        trouble = input_status(obs, found.bad_input, self.lost)
        planned, holds = due, ~plan.usable
        if self.delivery is not None or torch.compiler.is_compiling() or debug_unwrap(due).any():
            able = due & (trouble == 0)
            make = partial(replan_rows, self.replan, chunk=self.chunk)
            if self.delivery is None:
                plan = made = make(able, obs, plan, plan)
            else:
                made, pending = self.delivery.order(make, able, obs, plan, pending)
            planned = able & made.usable
            if torch.compiler.is_compiling() or debug_unwrap(due & ~planned).any():
                ticked = ticked.retry(due & ~planned, clock)
            holds = (due & ~able) | ~plan.usable
        plan = plan.held(holds, obs.tool_pos)
        goal, state = self.maneuver(plan, obs, holds, state)
        status = plan.status(trouble, ticked.replans)
        self.memory.remember(tensordict, (ticked, plan, state, pending), replanned=planned, status=status)
        write_goal(tensordict, goal, plan.arrival_steps, turned=self.turn is not None)
        return self.static(tensordict) if found.blind is None else act(self.static, tensordict, found.blind)

    def replan(self, observation: Observation, plan: Plan) -> Plan:
        """A new plan for every row, from the observation and the plan in use: a pure function."""
        delay = 0 if self.delivery is None else self.delivery.delay
        forecaster, eta_model, capture = self.forecaster, self.eta, self.capture
        if self.prepared is not None and self.prepared.stands_for(observation.robot_state, *observation.seen):
            forecaster, eta_model, capture = self.prepared.copies
        forecast = forecaster.predict(*observation.seen[: len(self.forecaster.in_keys)])
        path, usable = usable_path(forecast.path, observation.target_pos)
        turn = None if self.turn is None else turn_after(delay, self.turn, path, observation)
        forecast, target_pos = Forecast(path, forecast.spread), observation.target_pos
        eta, planned_steps = eta_model.from_state(observation.robot_state), plan.arrival_steps
        if delay:
            # From here on, times count from the step at which the plan becomes available.
            forecast, eta = forecast.after(delay), later(eta, delay)
            target_pos, planned_steps = path[..., delay - 1, :], (planned_steps - delay).clamp_min(0)
        context = SearchContext(observation.tool_pos, planned_steps, self.lost, capture, turn)
        meeting = self.search(forecast, target_pos, eta, context)
        return Plan.make(meeting, usable, target_pos, forecast.path, self.memory.path_length)


def turn_after(delay: int, turn: Turn, path: Tensor, observation: Observation) -> Tensor:
    """Orientations (*B, F - delay, 4) along a forecast ``path`` (*B, F, 3), from ``delay`` control steps on."""
    # The forecaster's values come first.
    seen = observation.seen[len(observation.seen) - len(turn.in_keys) :]
    return turn(path, observation.target_pos, *seen)[..., delay:, :]


def write_goal(tensordict: TensorDictBase, goal: Tensor, arrival_steps: Tensor, *, turned: bool) -> None:
    """Write the goal (*B, 3 or 2), or the pose (*B, 7) if it is ``turned``, and the arrival time."""
    if turned:
        tensordict.set(keys.GOAL_POSE, goal)
        goal = goal[..., :3]
    tensordict.set(keys.GOAL, goal)
    tensordict.set(keys.ARRIVAL_STEPS, arrival_steps)


def observe(tensordict: TensorDictBase, forecaster: ForecastModel, besides: Sequence[Any] = ()) -> Observation:
    """The observation of a planner with this ``forecaster``; raises `InputError` for a missing key or a wrong shape.

    The keys ``besides`` are read after those of the forecaster. Half precision becomes float32, and a step count of any
    type int64.
    """
    wanted = (*SEEN_BY_ALL, *forecaster.in_keys, *besides)
    values = [tensordict.get(key, None) for key in wanted]
    if any(value is None for value in values):
        values = [read(tensordict, key, "DynamicPlanner") for key in wanted]
    values = [value.float() if value.dtype in HALVES else value for value in values]
    tool_pos, target_pos, robot_state, step_count, *seen = values
    if not torch.compiler.is_compiling():
        size = tool_pos.shape[-1] if tool_pos.ndim else 0
        if size not in POINT_SIZES or target_pos.shape[-1:] != (size,):
            size, other = check_points(keys.TOOL_POS, tool_pos), check_points(keys.TARGET_POS, target_pos)
            raise InputError(
                f"{keys.TOOL_POS} and {keys.TARGET_POS} must have equally many coordinates, got {size} and {other}"
            )
        if keys.TARGET_HISTORY in forecaster.in_keys:
            history = seen[forecaster.in_keys.index(keys.TARGET_HISTORY)]
            length = forecaster.history or (history.shape[-2] if history.ndim > 1 else 2)
            if history.shape[-2:] != (length, size):
                check_trailing_shape(keys.TARGET_HISTORY, history, length, size)
    step_count = step_count.reshape(tool_pos.shape[:-1])
    if step_count.dtype != torch.int64:
        step_count = step_count.long()
    return Observation(tool_pos, target_pos, robot_state, step_count, tuple(seen))


def are_sane(tensordict: TensorDictBase, read: Sequence[Any], *known: Tensor) -> bool:
    """Whether the tensors ``known`` and the present keys ``read`` can be examined, and are finite and not too large.

    This quick check nearly always passes; otherwise `judge` finds the bad rows.
    """
    plan = tensordict.get(keys.PLAN, None)
    # A plain dictionary: a nested look-up costs as much as a small tensor operation.
    stored = {} if plan is None else dict(plan.items())
    found = [tensordict.get(key, None) if isinstance(key, str) else stored.get(key[-1]) for key in read]
    values = [*known, *(value for value in found if value is not None)]
    if torch.compiler.is_compiling() or any(debug_unwrap(value) is not value for value in values):
        return False
    flat = torch.cat([value.reshape(-1) for value in values if value.is_floating_point()])
    if not len(flat):
        return True
    low, high = torch.aminmax(flat)
    return low.item() >= -LARGEST and high.item() <= LARGEST


def replan_rows(
    replan: Callable[[Observation, Plan], Plan],
    rows: Tensor,
    observation: Observation,
    plan: Plan,
    others: Plan,
    *,
    chunk: int | None,
) -> Plan:
    """New plans in some rows.

    Args:
        replan: makes a new plan for every row it is given.
        rows: ``(*B,)`` bool: rows that plan.
        observation: of this step.
        plan: in use.
        others: plans of the other rows.
        chunk: rows given to ``replan`` at a time; None for all.
    """
    # Planning does not read the old path, so rows are gathered without it.
    bare = plan._replace(path=plan.path[..., :0, :])
    # Models get one batch dimension, however many the planner has.
    plain = chunk is None and rows.ndim == 1 and not torch.compiler.is_compiling() and debug_unwrap(rows) is rows
    if plain and rows.all():
        made = replan(observation, bare)
        return Plan(*(new.to(old.dtype) for new, old in zip(made, others, strict=True)))
    count = len(bare)

    def flat(*tensors: Tensor) -> Plan:
        return replan(Observation.of(tensors[count:]), Plan(*tensors[:count]))

    return Plan(*apply_to_rows(flat, rows, (*bare, *observation.flat()), others, chunk=chunk))
