"""Meeting a target rather than running after it: wait above the meeting place, and drop in time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.drop import Drop
from torchdyn_plan.planners.dynamic import SUNK, DynamicPlanner
from torchdyn_plan.planners.exact import ExactSearch
from torchdyn_plan.planners.memory import carry_on, recall, remember
from torchdyn_plan.planners.protocol import ArrivalPredictor, StaticPlanner
from torchdyn_plan.planners.rows import apply_to_rows
from torchdyn_plan.planners.schedule import ReplanSchedule
from torchdyn_plan.planners.search import SearchResult
from torchdyn_plan.planners.status import held, input_status, plan_status, try_again, usable_forecast

DROP_NAMES = ("outlook", "outlook_age", "drop_step", "tool_before")

FOLLOW_AFTER = 2
"""Control steps that a box goes straight down before it follows the target."""
WAITING = ExactSearch(
    height=0.105, half_extent=0.722, lead=7.0, margin=15.0, footprint=0.055, longest_stay=12, patience=0.01,
    loyalty=8.0, arrived=0.015,
)  # fmt: skip
"""Meets Trapper's ball: waits with the rim 2 cm above it, as far out as the rails let the box stand."""


class MeetingPlanner(DynamicPlanner):
    """Waits above the best place on the forecast, and drops when the box will enclose the target.

    History → forecast → meeting (`ExactSearch`, with goals above the table) → ``goal``: above the meeting place until
    `Drop` finds that now is the time, then down over the target, following it; and up to the next meeting if it was
    missed. The static planner hears of all that through the goal alone. It re-plans often, every 5 steps by default.
    Rows that cannot plan hold still as in `DynamicPlanner` and begin no drop on what they knew before; one that has
    begun goes on.
    """

    def __init__(
        self,
        static: StaticPlanner,
        forecaster: Callable[..., Tensor],
        eta: ArrivalPredictor,
        *,
        search: ExactSearch | None = None,
        schedule: ReplanSchedule | None = None,
        drop: Drop | None = None,
        table_height: float = 0.042,
        pull: float = 0.044,
        lead: int = 7,
        gone_below: float | None = SUNK,
        chunk: int | None = None,
    ) -> None:
        """Join the parts.

        Args:
            static: planner for a static goal.
            forecaster: as for `DynamicPlanner`.
            eta: tells how long ``static`` needs to a goal.
            search: chooses where to wait, and when for.
            schedule: when to plan anew; every 5 steps from step 13 by default. A multiple of the search's stride keeps
                its candidates on the same places of the path, and so the tool still while it waits.
            drop: sizes and the descent of ``static``.
            table_height: height of a goal that brings the box down [m].
            pull: the goal of a dropping box is at most so far from it, sideways [m].
            lead: it is sent to where the target will be in so many steps: what ``static`` lags behind, and more.
            gone_below: as for `DynamicPlanner`.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        schedule = schedule or ReplanSchedule(window=5, shrink=1.0, minimum=5)
        super().__init__(
            static, forecaster, eta, search=search or WAITING, schedule=schedule, gone_below=gone_below, chunk=chunk
        )
        self.search: ExactSearch
        self.drop, self.table_height, self.pull, self.lead = drop or Drop(), table_height, pull, lead
        check_number("lead", lead, minimum=0, maximum=self.drop.outlook - 1, integer=True)
        for name, value in (("table_height", table_height), ("pull", pull)):
            check_number(name, value, minimum=0.0)
        written: list[Any] = list(self.out_keys)
        self.out_keys = written + [(keys.PLAN, name) for name in DROP_NAMES]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan where a plan is due, wait or drop, and act; raises what `DynamicPlanner.forward` raises."""
        tool_pos, target_pos, robot_state, step_count, *seen = self._read(tensordict)
        memory = recall(tensordict)
        clock, due = self.schedule.tick(None if memory is None else memory.clock, step_count)
        meeting = carry_on(memory, tool_pos, step_count)
        outlook, age, drop_step, tool_before = self._recall_drop(tensordict, tool_pos, target_pos, step_count)
        trouble = input_status(target_pos, seen, self.gone_below)
        able = due & (trouble == 0)
        outputs = (*meeting, outlook, age, able)
        inputs = (robot_state, target_pos, tool_pos, meeting.arrival_steps, *seen)
        *planned, outlook, age, usable = apply_to_rows(self.plan_ahead, able, inputs, outputs, chunk=self.chunk)
        failed = due & ~usable
        meeting = held(SearchResult(*planned), failed, tool_pos)
        clock = try_again(clock, failed, memory, self.schedule, step_count)

        path = self._path(outlook, age)
        drop_step = self._drop_step(
            drop_step, path, tool_pos=tool_pos, tool_before=tool_before, target_pos=target_pos,
            started=(clock.replans > 0) & ~failed,
        )  # fmt: skip
        status = plan_status(trouble, failed, clock, meeting.reachable)
        remember(tensordict, clock, meeting, replanned=due & usable, status=status)
        entries = dict(zip(DROP_NAMES, (outlook, age + 1, drop_step, tool_pos), strict=True))
        plan = tensordict.get(keys.PLAN)
        plan.update(TensorDict(entries, tensordict.batch_size, device=tensordict.device))
        tensordict.set(keys.GOAL, self._goal(meeting, path, tool_pos, drop_step))
        return self.static(tensordict)

    def plan_ahead(
        self, robot_state: Tensor, target_pos: Tensor, tool_pos: Tensor, planned_steps: Tensor, *seen: Tensor
    ) -> tuple[Tensor, ...]:
        """Forecast and choose a meeting: a `SearchResult`'s entries, outlook, its age (0), and the forecast's use.

        Args:
            robot_state: ``(R, S)``.
            target_pos: ``(R, 3)`` [m, world].
            tool_pos: ``(R, 3)`` [m, world].
            planned_steps: ``(R,)`` control steps from now to the meeting planned before.
            seen: what the forecaster reads.
        """
        known, usable = usable_forecast(self.forecaster(*seen), target_pos)
        eta = partial(self.eta.arrival, robot_state.unsqueeze(-2))
        found = self.search(known, target_pos, eta, tool_pos=tool_pos, planned_steps=planned_steps)
        path = torch.cat([target_pos.unsqueeze(-2), known], dim=-2)
        ahead = torch.arange(self._outlook, device=path.device).clamp(max=path.shape[-2] - 1)
        return (
            *found, path[..., ahead, :], torch.zeros_like(found.arrival_steps), usable,
        )  # fmt: skip

    @property
    def _outlook(self) -> int:
        """Positions kept from a forecast: those that a drop looks at before the next plan is due, or a little later."""
        return self.drop.outlook + 8

    def _recall_drop(
        self, tensordict: TensorDictBase, tool_pos: Tensor, target_pos: Tensor, step_count: Tensor
    ) -> tuple[Tensor, ...]:
        """Outlook (*B, T, 3) and its age, steps since a drop began (-1: none), and the tool a step ago (*B, 3)."""
        nothing = target_pos.unsqueeze(-2).expand(*target_pos.shape[:-1], self._outlook, 3)
        zero = torch.zeros_like(step_count)
        start = (nothing, zero, zero - 1, tool_pos)
        plan = tensordict.get(keys.PLAN, None)
        if plan is None or plan.get(DROP_NAMES[0], None) is None:
            return start
        fresh = step_count == 0
        old = map(plan.get, DROP_NAMES)
        return tuple(
            torch.where(fresh[(..., *[None] * (new.ndim - fresh.ndim))], new, value)
            for new, value in zip(start, old, strict=True)
        )

    def _path(self, outlook: Tensor, age: Tensor) -> Tensor:
        """The outlook from now on, ``(*B, drop.outlook, 3)``; its last position is repeated beyond its end."""
        ahead = torch.arange(self.drop.outlook, device=age.device)
        index = (age.unsqueeze(-1) + ahead).clamp(max=outlook.shape[-2] - 1)
        return outlook.gather(-2, index.unsqueeze(-1).expand(*index.shape, 3))

    def _drop_step(
        self,
        drop_step: Tensor,
        path: Tensor,
        *,
        tool_pos: Tensor,
        tool_before: Tensor,
        target_pos: Tensor,
        started: Tensor,
    ) -> Tensor:
        """Steps since the drop began, -1 for none: begins when it is best to begin now, ends when it has missed."""
        drop = self.drop
        step = torch.where(drop_step >= 0, drop_step + 1, drop_step)
        clearance = drop.clearance(path, tool_pos, tool_pos - tool_before)
        now = (clearance.argmax(-1) == 0) & (clearance[..., 0] > 0.0)
        above = (tool_pos[..., 2] > 0.95 * 2 * drop.radius) & (path[..., 2] > 0.0).all(-1)
        step = torch.where((step < 0) & started & now & above, 0, step)
        outside = (target_pos - tool_pos)[..., :2].abs().amax(-1) > drop.half_width + 0.01
        down = tool_pos[..., 2] < 1.2 * drop.radius
        return torch.where(outside & (step > 8) & (down | (step > 40)), -1, step)

    def _goal(self, meeting: SearchResult, path: Tensor, tool_pos: Tensor, drop_step: Tensor) -> Tensor:
        """Above the meeting place, or down: first where the tool is, then after the target."""
        level = tool_pos[..., :2]
        follow = (drop_step >= FOLLOW_AFTER).unsqueeze(-1)
        down = torch.where(follow, pulled(level, path[..., self.lead, :2], self.pull), level)
        if self.search.half_extent is not None:
            down = down.clamp(-self.search.half_extent, self.search.half_extent)
        down = torch.cat([down, torch.full_like(down[..., :1], self.table_height)], dim=-1)
        return torch.where((drop_step >= 0).unsqueeze(-1), down, meeting.goal)


def pulled(level: Tensor, place: Tensor, pull: float) -> Tensor:
    """``place`` (*B, 2), or the point on the way there that is ``pull`` away from ``level`` (*B, 2) [m, world]."""
    way = place - level
    length = way.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-9)
    return level + way * (length.clamp_max(pull) / length)
