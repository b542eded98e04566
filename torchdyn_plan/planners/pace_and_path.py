"""A rival that needs no training and no forecast: the static plan at another pace, along a path that is shifted."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.judging import act, judge_rows
from torchdyn_plan.planners.memory import Remembering
from torchdyn_plan.planners.planner import are_sane
from torchdyn_plan.planners.protocol import StaticPlanner, keys_read, keys_written, read
from torchdyn_plan.planners.rows import where_rows
from torchdyn_plan.planners.static.callable import TensorDictFunction

SHORTEST = 1e-3
"""A way is taken for no shorter than this [m]: along one that is nothing there is no pace."""


class Correction(NamedTuple):
    """What becomes of the static plan to where the target is now."""

    goal: Tensor
    """``(*B, 3)`` where it ends instead [m, world]."""
    pace: Tensor
    """``(*B,)`` how much faster it is gone through."""
    time: Tensor
    """``(*B,)`` from now to its end [s]."""


class PaceAndPath(Remembering):
    """Goes through the static plan at another pace, and shifts it by how far the target comes meanwhile.

    Built from the published idea of *Pace-and-Path Correction* (Zhang et al., arXiv:2605.11459, 2026), which corrects
    the action chunks of a policy that takes the world for static; no reimplementation: here the static plan is a
    straight way at a known speed to where the target is now, and the target's velocity is that of the last step of its
    history. What the target covers along that way is made up for by the pace, so that the plan takes as long as
    before; what it covers across shifts the end of the path. Where no pace will do, the plan takes longer.
    """

    def __init__(
        self,
        static: StaticPlanner,
        *,
        speed: float,
        control_step: float,
        settle: float = 0.0,
        slowest: float = 0.0,
        fastest: float = 1.0,
        longest: float = 1.0,
        scene: str | None = None,
    ) -> None:
        """Correct the plans of ``static``.

        Args:
            static: a planner for a static goal, whose actions are speeds: a share of one is the same way, slower.
            speed: of the tool on its way [m/s].
            control_step: time between two steps [s].
            settle: time at the end of a plan in which the tool gets no nearer, as it drops a box; at its own pace [s].
            slowest: least pace, a share of the static planner's actions.
            fastest: greatest pace; 1 for a static planner that goes as fast as it can.
            longest: a plan takes no longer [s].
            scene: digest of the static planner's scene, if it has one.
        """
        super().__init__()
        for name, value in (("speed", speed), ("control_step", control_step), ("longest", longest)):
            check_number(name, value, minimum=1e-6)
        check_number("settle", settle, minimum=0.0)
        check_number("slowest", slowest, minimum=0.0)
        check_number("fastest", fastest, minimum=max(slowest, 1e-6))
        self.static, self.scene = TensorDictFunction.wrap(static), scene
        self.speed, self.control_step, self.settle = speed, control_step, settle
        self.slowest, self.fastest, self.longest = slowest, fastest, longest
        self.in_keys = keys_read(self.static, keys.TOOL_POS, keys.TARGET_POS, keys.TARGET_HISTORY)
        self.out_keys = keys_written(self.static, keys.GOAL, keys.ARRIVAL_STEPS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``goal`` (*B, 3) [m, world], ``arrival_steps`` (*B,) and ``action``; bad rows get action 0."""
        tool_pos, target_pos, history = (
            read(tensordict, key, "PaceAndPath") for key in (keys.TOOL_POS, keys.TARGET_POS, keys.TARGET_HISTORY)
        )
        check_trailing_shape(keys.TOOL_POS, tool_pos, 3)
        check_trailing_shape(keys.TARGET_POS, target_pos, 3)
        check_trailing_shape(keys.TARGET_HISTORY, history, history.shape[-2] if history.ndim > 1 else 2, 3)
        if history.shape[-2] < 2:
            raise InputError(f"target_history must have two positions at least, got {history.shape[-2]}")
        bad = None
        if not are_sane(tensordict, self.in_keys):
            bad = judge_rows(tensordict, self.in_keys, target_pos.shape[:-1])
            tool_pos, target_pos, history = (
                where_rows(bad, torch.zeros_like(value), value) for value in (tool_pos, target_pos, history)
            )
        velocity = (history[..., -1, :] - history[..., -2, :]) / self.control_step
        found = self.correct(tool_pos, target_pos, velocity)
        tensordict.set(keys.GOAL, found.goal)
        tensordict.set(keys.ARRIVAL_STEPS, (found.time / self.control_step).round().long())
        tensordict = self.static(tensordict) if bad is None else act(self.static, tensordict, bad)
        action = tensordict.get(keys.ACTION) * found.pace.unsqueeze(-1)
        return tensordict.set(keys.ACTION, action.clamp(-1.0, 1.0))

    def correct(self, tool_pos: Tensor, target_pos: Tensor, velocity: Tensor) -> Correction:
        """The correction for tools and targets at places (*B, 3) [m], targets with ``velocity`` (*B, 3) [m/s, world].

        At pace p the tool covers p·speed·(t - settle) of its way in t seconds, and the target is farther along that
        way by v·t: both are at one place at t = (way + p·speed·settle) / (p·speed - v). The pace that is told is that
        of the way to the shifted end in that time.
        """
        offset = target_pos - tool_pos
        way = offset.square().sum(-1).clamp_min(SHORTEST**2).sqrt()
        along = (velocity * offset).sum(-1) / way
        unchanged = way / self.speed + self.settle
        pace = (1.0 + along * unchanged / way).clamp(self.slowest, self.fastest)
        closing = pace * self.speed - along
        time = (way + pace * self.speed * self.settle) / closing.clamp_min(1e-9)
        # One that runs away faster is never met: its place at the longest time is as good as any.
        time = torch.where(closing > 0.0, time, self.longest).clamp_max(self.longest)
        goal = target_pos + velocity * time.unsqueeze(-1)
        shifted = (goal - tool_pos).square().sum(-1).clamp_min(SHORTEST**2).sqrt()
        left = time - self.settle
        # What is still to be done when nothing is left of the way is done at its own pace.
        needed = shifted / (self.speed * left.clamp_min(1e-9))
        pace = torch.where(left > 0.0, needed.clamp(self.slowest, self.fastest), 1.0)
        return Correction(goal, pace, time)

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The static planner's, as `Remembering` says."""
        return self.static.empty_memory(like) if isinstance(self.static, Remembering) else {}

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same planner."""
        names = ("static", "speed", "control_step", "settle", "slowest", "fastest", "longest", "scene")
        return {name: getattr(self, name) for name in names}
