"""What an episode's record says about its decisive moment: where ball and arm were, and what had been promised."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.envs.trapper.contact import is_reached, is_touched
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.evaluation.traces import Trace

NOTICE = 25
"""A forecast is judged by the plan that was in force so long before the decisive moment: one that could be acted on."""
ABOUT = (-5, 10)
"""A ball is at the promised place about the promised time if it is there within these control steps of it."""
GONE = 10.0
"""Distance of a ball that has left the table [m]."""
NEVER = 1000
"""How late an arm is that never comes [control steps]."""
MOVED, SOON = 0.002, 2
"""A box that is beside a ball, or low over it, has touched it if the ball is so far off the path of a ball that nothing
touched [m], so soon after [control steps]."""
RECEDING = 0.001
"""A ball that moves away from the box faster than this was not waited for [m/step]."""


class Evidence(NamedTuple):
    """What decides the cause of a failure, ``(*B,)`` each.

    The decisive moment is the first contact of the ball with the outside of the box; if there is none, the moment for
    which the last meeting was promised, or the end if that comes before.
    """

    planned: Tensor
    """Bool: plans were made at all; a pursuit makes none."""
    promised: Tensor
    """Bool: before the decisive moment a plan promised a meeting that the arm could be in time for."""
    forecast_error: Tensor
    """How near the ball came to the promised place about the promised time, by the plan `NOTICE` before the decisive
    moment: the larger of the two distances along the table's edges [m]; 0 without a promise."""
    eta_error: Tensor
    """When the arm came to the goal of the last promise, less the time promised, int64 [control steps]: `NEVER` if it
    had not come when the decisive moment was over; 0 without a promise."""
    contact_step: Tensor
    """Control step of the first contact with the outside of the box, int64, -1 for none."""
    receding: Tensor
    """Bool: at that contact the ball was moving away from the box."""

    @classmethod
    def none(cls, *batch: int) -> Evidence:
        """Of episodes of which nothing was recorded."""
        planned, promised, receding = torch.zeros(3, *batch, dtype=torch.bool)
        late, contact = torch.zeros(2, *batch, dtype=torch.int64)
        return cls(planned, promised, torch.zeros(batch), late, contact - 1, receding)


def find_evidence(scene: TrapperScene, trace: Trace, future: Tensor) -> Evidence:
    """What the records ``trace`` of R episodes say.

    Args:
        scene: sizes of box and ball.
        trace: ``(R, T, …)`` each.
        future: ``(R, F, 3)`` paths of the balls at steps 0 … F-1, had nothing touched them [m, world].
    """
    step = torch.arange(trace.target_pos.shape[1])
    contact = _first(_is_struck(scene, trace, future) & (step <= trace.length.unsqueeze(-1)))
    cut = torch.where(contact >= 0, contact, trace.length)

    acting = step < trace.length.unsqueeze(-1)
    made = torch.where(trace.planned & acting, step, -1).cummax(-1).values
    plan = made.clamp_min(0)
    due = plan + trace.arrival_steps.gather(-1, plan)
    # A place below the table is where the ball is lost, and no meeting.
    meets = trace.reachable & (trace.goal[..., 2] > 0.0)
    kept = (made >= 0) & acting & meets.gather(-1, plan) & (step <= cut.unsqueeze(-1))
    last = _last(kept)
    promised = last >= 0
    event = torch.where(contact >= 0, contact, torch.minimum(_at(due, last), trace.length))
    acted_on = _last(kept & (step <= (event - NOTICE).unsqueeze(-1)))
    acted_on = torch.where(acted_on >= 0, acted_on, _first(kept))

    place, when = _at(trace.goal, _at(plan, acted_on)), _at(due, acted_on)
    nearest = _nearest(trace, future, place, when, cut)
    goal, when = _at(trace.goal, _at(plan, last)), _at(due, last)
    there = is_reached(scene, trace.tool_pos, goal.unsqueeze(1).expand_as(trace.tool_pos))
    came = _first(there & (step <= trace.length.unsqueeze(-1)))
    late = torch.where(came >= 0, came - when, torch.where(event >= when, NEVER, 0))
    return Evidence(
        planned=(made >= 0).any(-1),
        promised=promised,
        forecast_error=nearest.masked_fill(~promised, 0.0),
        eta_error=late.masked_fill(~promised, 0),
        contact_step=contact,
        receding=_is_receding(trace, contact),
    )


def _is_struck(scene: TrapperScene, trace: Trace, future: Tensor) -> Tensor:
    """Whether the box's outside is against a ball that leaves its path by it, ``(R, T)``."""
    steps = trace.target_pos.shape[1]
    after = (torch.arange(steps) + SOON).clamp(max=min(steps, future.shape[1]) - 1)
    after = torch.minimum(after, trace.length.unsqueeze(-1)).unsqueeze(-1).expand_as(trace.target_pos)
    moved = (trace.target_pos.gather(1, after) - future.gather(1, after))[..., :2].square().sum(-1) > MOVED**2
    return is_touched(scene, trace.tool_pos, trace.target_pos) & moved


def _nearest(trace: Trace, future: Tensor, place: Tensor, when: Tensor, cut: Tensor) -> Tensor:
    """How near the balls come to ``place`` (R, 3) `ABOUT` step ``when`` (R,), ``(R,)`` [m].

    Up to step ``cut`` (R,) the record is the truth, after it the ``future`` of a ball that nothing touched.
    """
    index = (when.unsqueeze(-1) + torch.arange(ABOUT[0], ABOUT[1] + 1)).clamp_min(0)
    seen, untouched = (
        path.gather(1, index.clamp(max=path.shape[1] - 1).unsqueeze(-1).expand(*index.shape, 3))
        for path in (trace.target_pos, future)
    )
    ball = torch.where((index <= cut.unsqueeze(-1)).unsqueeze(-1), seen, untouched)
    away = (ball - place.unsqueeze(1))[..., :2].abs().amax(-1)
    return away.masked_fill(ball[..., 2] < 0.0, GONE).amin(-1)


def _is_receding(trace: Trace, contact: Tensor) -> Tensor:
    """Whether balls moved away from the box in the step before their first contact (R,)."""
    before = (contact - 1).clamp_min(1)
    ball, tool = _at(trace.target_pos, before), _at(trace.tool_pos, contact)
    speed, way = (ball - _at(trace.target_pos, before - 1))[..., :2], (tool - ball)[..., :2]
    towards = (speed * way).sum(-1) / way.square().sum(-1).sqrt().clamp_min(1e-9)
    return (contact >= 0) & (towards < -RECEDING)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """Entry ``index`` (R,) of each row of ``values`` (R, T, …); the first for a negative index."""
    return values[torch.arange(len(index)), index.clamp_min(0)]


def _first(flags: Tensor) -> Tensor:
    """Index of the first true entry of each row (R, T), -1 for none."""
    return torch.where(flags.any(-1), flags.to(torch.int64).argmax(-1), -1)


def _last(flags: Tensor) -> Tensor:
    """Index of the last true entry of each row (R, T), -1 for none."""
    return (flags * torch.arange(1, flags.shape[-1] + 1)).amax(-1) - 1
