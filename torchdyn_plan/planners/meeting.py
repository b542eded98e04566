"""Meeting a target rather than running after it: wait above the meeting place, and drop in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.adaptation import Adaptation, Course
from torchdyn_plan.planners.drop import Drop
from torchdyn_plan.planners.dynamic import PRETRAINED, SUNK, DynamicPlanner
from torchdyn_plan.planners.exact import ExactSearch
from torchdyn_plan.planners.latency import Delivery, where_rows
from torchdyn_plan.planners.protocol import ArrivalPredictor, StaticPlanner
from torchdyn_plan.planners.schedule import ReplanSchedule, Schedule
from torchdyn_plan.planners.search import SearchResult

if TYPE_CHECKING:
    from torchdyn_plan.nets.spread import SpreadNetwork

DROP_NAMES = ("drop_step", "tool_before")

FOLLOW_AFTER = 2
"""Control steps that a box goes straight down before it follows the target."""
WAITING = ExactSearch(
    height=0.105, half_extent=0.722, lead=7.0, margin=15.0, footprint=0.055, longest_stay=12, patience=0.01,
    loyalty=8.0, arrived=0.015, base_pos=(0.0, -0.855),
)  # fmt: skip
"""Meets Trapper's ball: waits with the rim 2 cm above it, as far out as the rails let the box stand, and rather not
close to the arm's axis, where a drop takes twice as long."""
CAUTIOUS = replace(WAITING, caution=30.0, margin=5.0)
"""The same by the probability of meeting, which makes most of the margin needless; reads a spread."""


class MeetingPlanner(DynamicPlanner):
    """Waits above the best place on the forecast, and drops when the box will enclose the target.

    History → forecast → meeting (`ExactSearch`, with goals above the table) → ``goal``: above the meeting place until
    `Drop` finds that now is the time, then down over the target, following it; and up to the next meeting if it was
    missed. The static planner hears of all that through the goal alone. It re-plans often, every 5 steps by default.
    Rows that cannot plan hold still as in `DynamicPlanner` and begin no drop on what they knew before; one that has
    begun goes on.
    """

    keeps_outlook, own_names = True, DROP_NAMES

    def __init__(
        self,
        static: StaticPlanner,
        forecaster: Callable[..., Tensor],
        eta: ArrivalPredictor,
        *,
        search: ExactSearch | None = None,
        schedule: Schedule | None = None,
        latency: int = 0,
        drop: Drop | None = None,
        adaptation: Adaptation | None = None,
        spread: SpreadNetwork | None = None,
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
            latency: as for `DynamicPlanner`. Whether to drop is decided at every step, on the forecast in use.
            drop: sizes and the descent of ``static``.
            adaptation: how the forecast learns from its own errors; None to take it as it is.
            spread: how sure the forecast is, from what ``forecaster`` describes, for a search with a ``caution``.
            table_height: height of a goal that brings the box down [m].
            pull: the goal of a dropping box is at most so far from it, sideways [m].
            lead: it is sent to where the target will be in so many steps: what ``static`` lags behind, and more.
            gone_below: as for `DynamicPlanner`.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        schedule = schedule or ReplanSchedule.every(5)
        super().__init__(
            static,
            forecaster,
            eta,
            search=search or WAITING,
            schedule=schedule,
            latency=latency,
            gone_below=gone_below,
            chunk=chunk,
        )
        self.search: ExactSearch
        self.drop, self.table_height, self.pull, self.lead = drop or Drop(), table_height, pull, lead
        self.adaptation, self.spread = adaptation, spread
        check_number("lead", lead, minimum=0, maximum=self.drop.outlook - 1, integer=True)
        for name, value in (("table_height", table_height), ("pull", pull)):
            check_number(name, value, minimum=0.0)
        self.kept_names = Course._fields if adaptation else ()
        self.set_latency(latency)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan where a plan is due, wait or drop, and act; raises what `DynamicPlanner.forward` raises."""
        tool_pos, target_pos, robot_state, step_count, *seen = self._read(tensordict)
        drop_step, tool_before = self._recall_drop(tensordict, tool_pos, step_count)
        meeting, outlook, holds = self._replan(tensordict, tool_pos, target_pos, robot_state, step_count, *seen)
        assert outlook is not None
        path = outlook.ahead(self.drop.outlook)
        # When plans stay away, what is known of the path ends too soon to begin a drop.
        known = (outlook.age >= 0) & (outlook.age + self.drop.outlook <= outlook.path.shape[-2])
        drop_step = self._drop_step(
            drop_step, path, tool_pos=tool_pos, tool_before=tool_before, target_pos=target_pos,
            known=known & ~holds,
        )  # fmt: skip
        entries = dict(zip(DROP_NAMES, (drop_step, tool_pos), strict=True))
        plan = tensordict.get(keys.PLAN)
        plan.update(TensorDict(entries, tensordict.batch_size, device=tensordict.device))
        tensordict.set(keys.GOAL, self._goal(meeting, path, tool_pos, drop_step))
        return self.static(tensordict)

    @classmethod
    def from_pretrained(
        cls,
        name: str,
        *,
        search: ExactSearch | None = None,
        adaptation: Adaptation | None = None,
        latency: int = 0,
        chunk: int | None = None,
    ) -> MeetingPlanner:
        """As `DynamicPlanner.from_pretrained`, with the search `CAUTIOUS`; one with a caution gets its spread."""
        from torchdyn_plan.nets import SpreadNetwork

        parts = DynamicPlanner.from_pretrained(name, chunk=chunk)
        search = search or CAUTIOUS
        spread = SpreadNetwork.from_pretrained(PRETRAINED[name][0]) if search.caution > 0.0 else None
        planner = cls(
            parts.static, parts.forecaster, parts.eta, search=search, adaptation=adaptation, spread=spread,
            latency=latency, gone_below=parts.gone_below, chunk=chunk,
        )  # fmt: skip
        return planner.eval().requires_grad_(False)

    def set_latency(self, latency: int, delivery: Delivery | None = None) -> None:
        """As `DynamicPlanner.set_latency`; an adaptation needs plans that take effect at once: else an `InputError`."""
        if self.kept_names and (latency or delivery):
            raise InputError(f"an adaptation judges each plan from when it was made: latency must be 0, got {latency}")
        super().set_latency(latency, delivery)

    def _forecast(self, *seen: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Forecast ``(R, F, 3)`` [m, world] and, if a search reads it, its spread from when the plan takes effect."""
        if self.spread is None:
            return super()._forecast(*seen)
        describing: Any = self.forecaster
        forecast, features, swapped = describing.describe(*seen)
        return forecast, {"spread": self.spread(features, swapped).after(self.latency)}

    def _adapt(self, forecast: Tensor, target_pos: Tensor, kept: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """The forecast with the drag that those before it showed."""
        if self.adaptation is None:
            return forecast, kept
        return self.adaptation.adapt(forecast, target_pos, Course(*kept))

    def _recall_kept(self, tensordict: TensorDictBase, target_pos: Tensor, step_count: Tensor) -> tuple[Tensor, ...]:
        """Entries of the `Course`; none without an adaptation."""
        if self.adaptation is None:
            return ()
        start, plan = self.adaptation.start(target_pos), tensordict.get(keys.PLAN, None)
        if plan is None or plan.get(Course._fields[0], None) is None:
            return start
        before = Course(*map(plan.get, Course._fields))
        before = before._replace(course_age=before.course_age + 1)
        return tuple(where_rows(step_count == 0, *pair) for pair in zip(start, before, strict=True))

    def _choose(self, robot_state: Tensor, forecast: Tensor, target_pos: Tensor, **hints: Any) -> SearchResult:
        """A place to wait at, which also depends on where the tool is and on the meeting planned before."""
        return self.search(forecast, target_pos, self._arrival(robot_state), **hints)

    @property
    def outlook_steps(self) -> int:
        """Positions kept from a forecast: those that a drop looks at before the next plan is there, or a little later.

        A plan that is due while another is under way waits for the next window.
        """
        return self.drop.outlook + max(8, self.schedule.longest) + 2 * self.latency

    def _recall_drop(self, tensordict: TensorDictBase, tool_pos: Tensor, step_count: Tensor) -> tuple[Tensor, Tensor]:
        """Steps since a drop began (-1: none) ``(*B,)``, and the tool a step ago ``(*B, 3)``."""
        none, plan = torch.full_like(step_count, -1), tensordict.get(keys.PLAN, None)
        drop_step = None if plan is None else plan.get(DROP_NAMES[0], None)
        if plan is None or drop_step is None:
            return none, tool_pos
        fresh = step_count == 0
        return torch.where(fresh, none, drop_step), where_rows(fresh, tool_pos, plan.get(DROP_NAMES[1]))

    def _drop_step(
        self,
        drop_step: Tensor,
        path: Tensor,
        *,
        tool_pos: Tensor,
        tool_before: Tensor,
        target_pos: Tensor,
        known: Tensor,
    ) -> Tensor:
        """Steps since the drop began, -1 for none: begins when it is best to begin now, ends when it has missed."""
        drop = self.drop
        step = torch.where(drop_step >= 0, drop_step + 1, drop_step)
        clearance = drop.clearance(path, tool_pos, tool_pos - tool_before)
        now = (clearance.argmax(-1) == 0) & (clearance[..., 0] > 0.0)
        above = (tool_pos[..., 2] > 0.95 * 2 * drop.radius) & (path[..., 2] > 0.0).all(-1)
        step = torch.where((step < 0) & known & now & above, 0, step)
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
