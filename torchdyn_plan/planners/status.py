"""How a row's plan stands, and what is done about rows that cannot plan: they hold, and try again at the next step."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import torch
from torch import Tensor

from torchdyn_plan.planners.memory import Memory
from torchdyn_plan.planners.schedule import Clock, Schedule
from torchdyn_plan.planners.search import SearchResult

FARTHEST = 1e3
"""A forecast that leads farther than this is none [m]."""


class PlanStatus(IntEnum):
    """Codes of ``plan.status``, row by row; from `BAD_FORECAST` on a row whose plan is due holds its tool still."""

    OK = 0
    """The robot can be in time for the planned meeting."""
    WAITING = 1
    """The first plan is still to come."""
    UNREACHABLE = 2
    """The robot cannot be in time for any meeting on the forecast; the goal is only a direction."""
    BAD_FORECAST = 3
    """The forecast holds a NaN or an infinity, or leads out of the world."""
    TARGET_GONE = 4
    """The target has left the table."""
    BAD_INPUT = 5
    """The target's position, or what the forecaster reads, holds a NaN or an infinity."""


def input_status(target_pos: Tensor, seen: Sequence[Tensor], gone_below: float) -> Tensor:
    """`BAD_INPUT`, `TARGET_GONE` or `OK` for each row, ``(*B,)`` int64.

    Args:
        target_pos: ``(*B, 3)`` [m, world].
        seen: what the forecaster reads, ``(*B, …)`` each.
        gone_below: a target whose centre is lower has left the table [m].
    """
    batch = target_pos.shape[:-1]
    # A sum is finite only if all its terms are.
    sums = [torch.isfinite(value.reshape(*batch, -1).sum(-1)) for value in (target_pos, *seen)]
    bad = ~torch.stack(sums).all(0)
    gone = (target_pos[..., 2] < gone_below) * int(PlanStatus.TARGET_GONE)
    return torch.where(bad, int(PlanStatus.BAD_INPUT), gone)


def usable_forecast(forecast: Tensor, target_pos: Tensor) -> tuple[Tensor, Tensor]:
    """The forecast ``(*B, F, 3)``, a target at rest at ``target_pos`` (*B, 3) where it is no use, and its use (*B,)."""
    usable = forecast.flatten(-2).abs().amax(-1) <= FARTHEST
    return torch.where(usable[..., None, None], forecast, target_pos.unsqueeze(-2)), usable


def plan_status(trouble: Tensor, failed: Tensor, clock: Clock, reachable: Tensor) -> Tensor:
    """Code of each row, ``(*B,)`` int64, from its input's, whether its plan failed, its clock and its meeting."""
    code = torch.where(reachable, int(PlanStatus.OK), int(PlanStatus.UNREACHABLE))
    code = torch.where(clock.replans == 0, int(PlanStatus.WAITING), code)
    return torch.where(trouble > 0, trouble, torch.where(failed, int(PlanStatus.BAD_FORECAST), code))


def held(meeting: SearchResult, failed: Tensor, tool_pos: Tensor) -> SearchResult:
    """``meeting``, but rows that ``failed`` (*B,) to plan stay where their tool is, (*B, 3) [m, world]."""
    return SearchResult(
        torch.where(failed.unsqueeze(-1), tool_pos, meeting.goal),
        meeting.arrival_steps.masked_fill(failed, 0),
        meeting.clamped & ~failed,
        meeting.reachable & ~failed,
    )


def try_again(clock: Clock, failed: Tensor, memory: Memory | None, schedule: Schedule, step_count: Tensor) -> Clock:
    """``clock``, but rows that ``failed`` (*B,) to plan are due again at the next step, as if not due at this one."""
    window = schedule.start(step_count).window
    if memory is not None:
        window = torch.where(step_count == 0, window, memory.clock.window)
    return Clock(
        torch.where(failed, window, clock.window), clock.countdown.masked_fill(failed, 1), clock.replans - failed.long()
    )
