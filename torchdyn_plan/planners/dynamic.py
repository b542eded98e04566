"""The idea of this package: a planner for a static target, made to meet a moving one."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_number, check_same_device, check_trailing_shape
from torchdyn_plan.nets.eta import Arrival
from torchdyn_plan.planners.arrivals import arrivals_from
from torchdyn_plan.planners.ik import IKPlanner
from torchdyn_plan.planners.latency import AtOnce, Delayed, Delivery, Job, Values, arrival_after, skip_steps
from torchdyn_plan.planners.memory import MEMORY_KEYS, USABLE, carry_on, carry_use, recall, remember
from torchdyn_plan.planners.outlook import OUTLOOK_NAMES, Outlook, cut, recall_outlook
from torchdyn_plan.planners.policy import PolicyPlanner
from torchdyn_plan.planners.proportional import ProportionalController
from torchdyn_plan.planners.protocol import ArrivalPredictor, GoalSearch, StaticPlanner, keys_read, keys_written, read
from torchdyn_plan.planners.rows import apply_to_rows
from torchdyn_plan.planners.schedule import Drift, ReplanSchedule, Schedule
from torchdyn_plan.planners.search import CornerSearch, SearchResult
from torchdyn_plan.planners.status import held, input_status, plan_status, try_again, usable_forecast

STATIC_PLANNERS: dict[str, dict[str, Callable[..., TensorDictModuleBase]]] = {
    "trapper": {"ik": IKPlanner, "rl": partial(PolicyPlanner.from_pretrained, "trapper")},
    "reach": {"proportional": ProportionalController, "rl": partial(PolicyPlanner.from_pretrained, "reach")},
}
"""What makes the static planners that ship, by task and name; each takes ``chunk``."""
PRETRAINED = {f"{task}-{name}": (task, name) for task, names in STATIC_PLANNERS.items() for name in names}
"""Name of a planner → its task, which names the forecaster's weights, and the name of its static planner."""
SCHEDULES = {"reach": ReplanSchedule.every(1, first_step=0)}
"""When to plan anew where it is not the paper's schedule, by task."""

SUNK = -0.042
"""A ball of Trapper whose centre is lower is in a pocket [m, world]."""
GONE_BELOW = {"trapper": SUNK}
"""Height below which a target has left the table [m, world], by task."""


class DynamicPlanner(TensorDictModuleBase):
    """Meets a moving target: history → forecast → goal search → ``goal``, ``arrival_steps`` → static planner → action.

    Rows plan anew when their schedule says so and keep their goal in between; before its first plan a row stays where
    its tool is. A tensordict goes in, of any batch size, and the same one comes out, with `goal` (*B, 3) [m, world],
    `arrival_steps` (*B,), whatever the static planner writes, and the memory for the next step under ``plan``. Rows
    with ``step_count`` 0 start afresh, so that one planner serves environments that reset at different moments.

    ``plan.status`` (*B,) says how each row stands, in the codes of `PlanStatus`. A row that cannot plan when a plan is
    due, because its input or its forecast is no number or its target is gone, holds its tool still and tries again at
    every step; other rows do not notice.
    """

    keeps_outlook = False
    """Whether it looks at the forecast between plans, whatever the schedule."""
    own_names: tuple[str, ...] = ()
    """What it remembers under ``plan`` beside its plans."""
    kept_names: tuple[str, ...] = ()
    """What a plan hands on to the next one in its row."""

    def __init__(
        self,
        static: StaticPlanner,
        forecaster: Callable[..., Tensor],
        eta: ArrivalPredictor,
        *,
        search: GoalSearch | None = None,
        schedule: Schedule | None = None,
        latency: int = 0,
        gone_below: float | None = None,
        chunk: int | None = None,
    ) -> None:
        """Join the parts.

        Args:
            static: planner for a static goal.
            forecaster: maps what it reads, ``target_history`` (*B, H, 3) or its own ``in_keys``, to the target's
                positions in the next F control steps, ``(*B, F, 3)`` [m, world].
            eta: tells how long ``static`` needs to a goal.
            search: chooses the goal on the forecast; the paper's corner search by default.
            schedule: when to plan anew; the paper's by default.
            latency: as `set_latency` takes it.
            gone_below: a target whose centre is lower has left the table [m, world]; None if it cannot.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        super().__init__()
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        if gone_below is not None:
            check_number("gone_below", gone_below)
        self.gone_below = -math.inf if gone_below is None else gone_below
        self.static, self.forecaster, self.eta = static, forecaster, eta
        self.search, self.schedule, self.chunk = search or CornerSearch(), schedule or ReplanSchedule(), chunk
        self.seen_keys = tuple(getattr(forecaster, "in_keys", (keys.TARGET_HISTORY,)))
        state = (keys.ROBOT_STATE, keys.TARGET_POS, keys.TOOL_POS, keys.STEP_COUNT)
        self.in_keys = keys_read(static, *state, *self.seen_keys)
        self.set_latency(latency)

    def set_latency(self, latency: int, delivery: Delivery | None = None) -> None:
        """Plan for what will be in ``latency`` control steps, when a plan takes effect.

        Until then the row goes on as planned before, and begins no other plan. The static planner has no latency: it
        is a servo, and acts at every step on the goal of the plan in use.

        Args:
            latency: from seeing to acting on it.
            delivery: how plans come into use; after ``latency`` steps by default.
        """
        check_number("latency", latency, minimum=0, integer=True)
        self.latency = latency
        self.delivery: Delivery = delivery or (Delayed(latency) if latency else AtOnce())
        names = self._value_names[len(SearchResult._fields) :] + self.delivery.keys(self._value_names)
        own = [(keys.PLAN, name) for name in (*names, *self.own_names)]
        self.out_keys = keys_written(self.static, keys.GOAL, keys.ARRIVAL_STEPS, *MEMORY_KEYS, *own)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan where a plan is due, and act.

        Raises:
            InputError: a key is missing, a shape is wrong, or data and networks are on different devices.
        """
        self._replan(tensordict, *self._read(tensordict))
        return self.static(tensordict)

    def plan(self, robot_state: Tensor, target_pos: Tensor, *seen: Tensor) -> SearchResult:
        """Forecast and choose a meeting, for robot states (*B, S), targets (*B, 3) and what the forecaster reads."""
        forecast, target_pos = skip_steps(self.forecaster(*seen), target_pos, self.latency)
        return self._choose(robot_state, forecast, target_pos)

    def plan_ahead(
        self, robot_state: Tensor, target_pos: Tensor, tool_pos: Tensor, planned_steps: Tensor, *seen: Tensor
    ) -> tuple[Tensor, ...]:
        """Forecast and choose a meeting.

        Args:
            robot_state: ``(R, S)``.
            target_pos: ``(R, 3)`` [m, world].
            tool_pos: ``(R, 3)`` [m, world].
            planned_steps: ``(R,)`` control steps to the meeting planned before, from when the plan takes effect.
            seen: what the plan before handed on, and what the forecaster reads.

        Returns:
            A `SearchResult`'s entries, whether the forecast was of any use ``(R,)``, the outlook and its age if it is
            kept, and what is handed on.
        """
        kept, seen = seen[: len(self.kept_names)], seen[len(self.kept_names) :]
        forecast, hints = self._forecast(*seen)
        forecast, usable = usable_forecast(forecast, target_pos)
        forecast, kept = self._adapt(forecast, target_pos, kept)
        forecast, target_pos = skip_steps(forecast, target_pos, self.latency)
        hints |= {"tool_pos": tool_pos, "planned_steps": planned_steps}
        meeting = self._choose(robot_state, forecast, target_pos, **hints)
        return (*meeting, usable, *self._outlook(forecast, target_pos), *kept)

    def _forecast(self, *seen: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """The forecast, and what else a search may want to know of it."""
        return self.forecaster(*seen), {}

    def _adapt(self, forecast: Tensor, target_pos: Tensor, kept: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """The forecast in the light of those before it, and what to hand on."""
        return forecast, kept

    def _choose(self, robot_state: Tensor, forecast: Tensor, target_pos: Tensor, **hints: Any) -> SearchResult:
        """A meeting on the forecast from when the plan takes effect; the paper's search knows nothing of the tool."""
        return self.search(forecast, target_pos, self._arrival(robot_state))

    def _arrival(self, robot_state: Tensor) -> Callable[..., Arrival]:
        """Maps goals (*B, K, 3) to arrivals from when the plan takes effect."""
        return arrival_after(arrivals_from(self.eta, robot_state), self.latency)

    def _outlook(self, forecast: Tensor, target_pos: Tensor) -> tuple[Tensor, ...]:
        """What is kept of a forecast, ``(R, T, 3)``, and its age, 0; nothing where nobody looks at it."""
        if not self._with_outlook:
            return ()
        age = torch.zeros(target_pos.shape[:-1], dtype=torch.int64, device=target_pos.device)
        return cut(forecast, target_pos, self.outlook_steps), age

    @property
    def outlook_steps(self) -> int:
        """Positions kept from a forecast: until the next plan is there, were it due while another is under way."""
        return self.schedule.longest + 2 * self.latency + 1

    @property
    def _with_outlook(self) -> bool:
        return self.keeps_outlook or self.schedule.watches

    @property
    def _value_names(self) -> tuple[str, ...]:
        """What a plan consists of: a meeting, whether its forecast was of use, and an outlook if it is kept."""
        outlook = OUTLOOK_NAMES if self._with_outlook else ()
        return (*SearchResult._fields, USABLE, *outlook, *self.kept_names)

    def _replan(
        self, tensordict: TensorDictBase, tool_pos: Tensor, target_pos: Tensor, robot_state: Tensor,
        step_count: Tensor, *seen: Tensor,
    ) -> tuple[SearchResult, Outlook | None, Tensor]:  # fmt: skip
        """Take up what has arrived, plan where a plan is due, and remember.

        Returns:
            The meeting and the outlook in use, and ``(*B,)`` bool: the rows that have to hold.
        """
        memory, kept = recall(tensordict), tensordict.get(keys.PLAN, None)
        used = (*carry_on(memory, tool_pos, step_count), carry_use(tensordict, step_count))
        if self._with_outlook:
            used += recall_outlook(tensordict, target_pos, step_count, self.outlook_steps)
        used += self._recall_kept(tensordict, target_pos, step_count)
        values, busy = self.delivery.arrive(kept, dict(zip(self._value_names, used, strict=True)), step_count)
        look = partial(self._look, values, target_pos, robot_state)
        clock, due = self.schedule.tick(None if memory is None else memory.clock, step_count, busy=busy, look=look)
        trouble = input_status(target_pos, seen, self.gone_below)
        able = due & (trouble == 0)
        planned_steps = (values["arrival_steps"] - self.latency).clamp_min(0)
        handed_on = [values[name] for name in self.kept_names]
        inputs = (robot_state, target_pos, tool_pos, planned_steps, *handed_on, *seen)
        job = Job(self.plan_ahead, able, inputs, step_count, self.chunk)
        values, pending = self.delivery.order(job, kept, values)
        goal, arrival_steps, clamped, reachable, usable = (values[name] for name in (*SearchResult._fields, USABLE))
        failed = due & ~(able & pending.get(f"pending_{USABLE}", usable))
        holds = (due & ~able) | ~usable
        meeting = held(SearchResult(goal, arrival_steps, clamped, reachable), holds, tool_pos)
        clock = try_again(clock, failed, memory, self.schedule, step_count)
        status = plan_status(trouble, ~usable, clock, meeting.reachable)
        others = {name: values[name] for name in self._value_names[len(SearchResult._fields) :]} | pending
        remember(tensordict, clock, meeting, replanned=due & ~failed, status=status, **others)
        outlook = Outlook(values["outlook"], values["outlook_age"]) if self._with_outlook else None
        return meeting, outlook, holds

    def _recall_kept(self, tensordict: TensorDictBase, target_pos: Tensor, step_count: Tensor) -> tuple[Tensor, ...]:
        """What the plan before handed on, one step older."""
        return ()

    def _look(self, values: Values, target_pos: Tensor, robot_state: Tensor, rows: Tensor) -> Drift:
        """How far the plan in use has drifted, in ``rows`` (*B,)."""
        steps, outlook = values["arrival_steps"], Outlook(values["outlook"], values["outlook_age"])
        miss = torch.linalg.vector_norm(outlook.ahead(1).squeeze(-2) - target_pos, dim=-1)
        inputs = (robot_state, values["goal"], steps)
        (late,) = apply_to_rows(self._late, rows, inputs, (torch.zeros_like(miss),), chunk=self.chunk)
        return Drift(miss, late, steps == 0)

    def _late(self, robot_state: Tensor, goal: Tensor, planned_steps: Tensor) -> tuple[Tensor]:
        """Predicted steps to the goal less the planned ones, ``(R,)``."""
        arrival = self.eta.arrival(robot_state.unsqueeze(-2), goal.unsqueeze(-2), reading="expectation")
        needed = arrival.steps.masked_fill(arrival.never, torch.inf).squeeze(-1)
        return (needed - planned_steps,)

    def folded(self) -> Self:
        """A planner for inference: the same parts, but copies of the networks in fewer operations, where there are any.

        What becomes of the weights later does not reach it: fold again.
        """
        other = copy.copy(self)
        other._modules = dict(self._modules)
        for name in ("forecaster", "eta"):
            part = getattr(self, name)
            setattr(other, name, part.folded() if hasattr(part, "folded") else part)
        return other

    def _read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Tool and target (*B, 3) [m, world], robot state (*B, S), step count (*B,), and what the forecaster reads."""
        get = partial(read, tensordict, reader=self._get_name())
        tool_pos, target_pos, robot_state = get(keys.TOOL_POS), get(keys.TARGET_POS), get(keys.ROBOT_STATE)
        seen = [get(key) for key in self.seen_keys]
        if not torch.compiler.is_compiling():
            self._check(tool_pos, target_pos, dict(zip(self.seen_keys, seen, strict=True)))
        return [tool_pos, target_pos, robot_state, get(keys.STEP_COUNT).reshape(tool_pos.shape[:-1]), *seen]

    def _check(self, tool_pos: Tensor, target_pos: Tensor, seen: dict[str, Tensor]) -> None:
        check_trailing_shape(keys.TOOL_POS, tool_pos, 3)
        check_trailing_shape(keys.TARGET_POS, target_pos, 3)
        parameter = next(self.parameters(), None)
        if parameter is not None:
            check_same_device(keys.TARGET_POS, target_pos, parameter.device, "the planner")
        history = seen.get(keys.TARGET_HISTORY)
        if history is not None:
            length = getattr(getattr(self.forecaster, "config", None), "history", history.shape[-2])
            check_trailing_shape(keys.TARGET_HISTORY, history, length, 3)

    @classmethod
    def from_pretrained(cls, name: str, *, latency: int = 0, chunk: int | None = None) -> DynamicPlanner:
        """A planner with the weights that ship with the package, as ``"trapper-ik"`` or ``"reach-proportional"``.

        ``latency`` is as in `set_latency`.

        Raises:
            InputError: there is no planner of that name; the message lists those there are.
            WeightsError: the weights cannot be read.
        """
        check_choice("planner", name, PRETRAINED)
        from torchdyn_plan.nets import ETANetwork, Forecaster

        task, static = PRETRAINED[name]
        networks = Forecaster.from_pretrained(task), ETANetwork.from_pretrained(name)
        planner = cls(STATIC_PLANNERS[task][static](chunk=chunk), *networks, latency=latency, chunk=chunk)
        planner.schedule = SCHEDULES.get(task, planner.schedule)
        planner.gone_below = GONE_BELOW.get(task, -math.inf)
        return planner.eval().requires_grad_(False)
