"""What the dynamic planner remembers between steps, in the tensordict under ``plan``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.planners.schedule import Clock
from torchdyn_plan.planners.search import SearchResult

MEMORY_NAMES = (*Clock._fields, *SearchResult._fields, "replanned", "status")
USABLE = "usable"
"""Whether the forecast, from which the plan in use was made, was of any use."""
MEMORY_KEYS: tuple[NestedKey, ...] = tuple((keys.PLAN, name) for name in (*MEMORY_NAMES, USABLE))


class Memory(NamedTuple):
    """What was planned up to the step before."""

    clock: Clock
    meeting: SearchResult


def recall(tensordict: TensorDictBase) -> Memory | None:
    """Memory in ``tensordict``; None if it holds none yet."""
    plan = tensordict.get(keys.PLAN, None)
    if plan is None or plan.get(MEMORY_NAMES[0], None) is None:
        return None
    return Memory(Clock(*map(plan.get, Clock._fields)), SearchResult(*map(plan.get, SearchResult._fields)))


def remember(
    tensordict: TensorDictBase,
    clock: Clock,
    meeting: SearchResult,
    *,
    replanned: Tensor,
    status: Tensor,
    **others: Tensor,
) -> None:
    """Write the memory, and ``goal`` and ``arrival_steps`` for everybody to read, into ``tensordict``."""
    plan = tensordict.get(keys.PLAN, None)
    entries = {} if plan is None else dict(plan.items())
    entries.update(zip(MEMORY_NAMES, (*clock, *meeting, replanned, status), strict=True))
    entries.update(others)
    # A new one each step: tensordicts of earlier steps may share the old one.
    tensordict.set(keys.PLAN, TensorDict(entries, tensordict.batch_size, device=tensordict.device))
    tensordict.set(keys.GOAL, meeting.goal)
    tensordict.set(keys.ARRIVAL_STEPS, meeting.arrival_steps)


def hold(tool_pos: Tensor, step_count: Tensor) -> SearchResult:
    """Meeting of rows without a plan: the goal is where the tool is, ``(*B, 3)`` [m, world], now."""
    no = torch.zeros_like(step_count, dtype=torch.bool)
    return SearchResult(tool_pos, torch.zeros_like(step_count), no, ~no)


def carry_on(memory: Memory | None, tool_pos: Tensor, step_count: Tensor) -> SearchResult:
    """Meeting of the step before, one step nearer; rows at step 0, and all rows without a memory, `hold`."""
    holding = hold(tool_pos, step_count)
    if memory is None:
        return holding
    old = memory.meeting
    fresh = step_count == 0
    return SearchResult(
        torch.where(fresh.unsqueeze(-1), holding.goal, old.goal),
        torch.where(fresh, 0, (old.arrival_steps - 1).clamp_min(0)),
        old.clamped & ~fresh,
        old.reachable | fresh,
    )


def carry_use(tensordict: TensorDictBase, step_count: Tensor) -> Tensor:
    """Whether the plan in use came from a usable forecast, ``(*B,)``; true where there is none yet."""
    plan = tensordict.get(keys.PLAN, None)
    usable = None if plan is None else plan.get(USABLE, None)
    return torch.ones_like(step_count, dtype=torch.bool) if usable is None else usable | (step_count == 0)
