"""A baseline without training or forecast: the static plan, sped up or slowed down along a shifted path."""

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
"""Lower bound on the length of the way to the goal [m]: a way of length 0 has no pace."""


class Correction(NamedTuple):
    """Correction of the static plan to the target's present position."""

    goal: Tensor
    """``(*B, 3)`` its shifted end [m, world]."""
    pace: Tensor
    """``(*B,)`` factor on its speed."""
    time: Tensor
    """``(*B,)`` time from now to its end [s]."""


class PaceAndPath(Remembering):
    """Executes the static plan at another pace, shifted by the distance that the target moves meanwhile.

    Follows the idea of *Pace-and-Path Correction* (Zhang et al., arXiv:2605.11459, 2026), which corrects the action
    chunks of a policy trained for a static world. It is not a reimplementation: here the static plan is a straight line
    at known speed to the target's present position, and the target's velocity is that of the last step of its history.
    Target motion along the line is compensated by the pace, so that the plan takes as long as before; motion across it
    shifts the end of the path. If no allowed pace is enough, the plan takes longer.
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
            static: a planner for a static goal whose actions are speeds, so that a scaled action is the same path,
                slower.
            speed: of the tool on its way [m/s].
            control_step: time between two steps [s].
            settle: time at the end of a plan in which the tool gets no nearer, such as the drop of a box; always at
                pace 1 [s].
            slowest: smallest pace, as a factor on the static planner's actions.
            fastest: largest pace; 1 for a static planner that already moves as fast as it can.
            longest: longest time of a plan [s].
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
        """The correction for tools and targets at positions (*B, 3) [m]; ``velocity`` (*B, 3) is the target's [m/s].

        At pace p the tool covers p·speed·(t - settle) of its way in t seconds, and the target moves on by v·t along
        it: they meet at t = (way + p·speed·settle) / (p·speed - v). The returned pace is the one that covers the way to
        the shifted end in that time.
        """
        offset = target_pos - tool_pos
        way = offset.square().sum(-1).clamp_min(SHORTEST**2).sqrt()
        along = (velocity * offset).sum(-1) / way
        unchanged = way / self.speed + self.settle
        pace = (1.0 + along * unchanged / way).clamp(self.slowest, self.fastest)
        closing = pace * self.speed - along
        time = (way + pace * self.speed * self.settle) / closing.clamp_min(1e-9)
        # A target that moves away faster is never met; take its position at the longest time.
        time = torch.where(closing > 0.0, time, self.longest).clamp_max(self.longest)
        goal = target_pos + velocity * time.unsqueeze(-1)
        shifted = (goal - tool_pos).square().sum(-1).clamp_min(SHORTEST**2).sqrt()
        left = time - self.settle
        # What remains when the way is covered (settling) runs at pace 1.
        needed = shifted / (self.speed * left.clamp_min(1e-9))
        pace = torch.where(left > 0.0, needed.clamp(self.slowest, self.fastest), 1.0)
        return Correction(goal, pace, time)

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The static planner's memory, see `Remembering`."""
        return self.static.empty_memory(like) if isinstance(self.static, Remembering) else {}

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        names = ("static", "speed", "control_step", "settle", "slowest", "fastest", "longest", "scene")
        return {name: getattr(self, name) for name in names}
