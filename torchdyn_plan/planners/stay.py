"""A maneuver that goes to the meeting place and stays there, whatever becomes of a target that has been met."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan


class StayState(NamedTuple):
    """Where each row stays."""

    stay_left: Tensor
    """``(*B,)`` int64 control steps for which it stays, 0 for one that goes where its plan says."""
    stay_at: Tensor
    """``(*B, 7)`` goal at which it stays: place [m, world] and quaternion; zeros where there is less of it."""


@dataclass(frozen=True, kw_only=True)
class GoAndStay:
    """Goes to the meeting place, and keeps to it from shortly before the meeting on, or from when the target is there.

    Plans that are made when a target has been met are of no use: it no longer moves as it did.
    """

    State: ClassVar[type[StayState]] = StayState

    before: int = 3
    """Control steps before the meeting from which on it stays: more than the `first` step of the search."""
    within: float = 0.0
    """A target within this distance of the tool has come, even if the robot was to be late by its plan [m]."""
    steps: int = 100
    """Control steps for which it stays; it is free to meet the target again after them."""

    def __post_init__(self) -> None:
        check_number("before", self.before, minimum=0, integer=True)
        check_number("within", self.within, minimum=0.0)
        check_number("steps", self.steps, minimum=1, integer=True)

    @property
    def lookahead(self) -> int:
        """None of the path."""
        return 0

    def start(self, observation: Observation) -> StayState:
        """It stays nowhere."""
        tool_pos = observation.tool_pos
        place = torch.nn.functional.pad(torch.zeros_like(tool_pos), (0, 7 - tool_pos.shape[-1]))
        return StayState(torch.zeros_like(observation.step_count), place)

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: StayState
    ) -> tuple[Tensor, StayState]:
        """The plan's goal, or the one at which it stays."""
        left = (state.stay_left - 1).clamp_min(0)
        away = torch.linalg.vector_norm(observation.target_pos - observation.tool_pos, dim=-1)
        comes = (plan.reachable & (plan.arrival_steps <= self.before)) | (away < self.within)
        begins = (left == 0) & comes & (plan.age >= 0) & ~holds
        left = left.masked_fill(begins, self.steps)
        size = plan.goal.shape[-1]
        new = torch.nn.functional.pad(plan.goal, (0, 7 - size))
        place = torch.where(begins.unsqueeze(-1), new, state.stay_at)
        return torch.where((left > 0).unsqueeze(-1), place[..., :size], plan.goal), StayState(left, place)
