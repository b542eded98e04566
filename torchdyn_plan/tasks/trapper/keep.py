"""Going to the meeting place, and staying there once the box holds the ball."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.maneuver import GoTo, NoState
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.tasks.trapper.approach import metres

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene


@dataclass(frozen=True, kw_only=True)
class GoToAndKeep(GoTo):
    """Goes to the meeting place; a box that is down over the ball stays down, wherever the plan's meeting is.

    A fast and heavy ball pushes the box along by a decimetre. A planner that lifted it then, to go to its next meeting,
    would let out the ball that it has.
    """

    down_below: float
    """A box whose rim is below this height is down [m]."""
    half_room: float
    """The ball's centre is at most this far from the box's middle along each axis while the box holds it [m]."""

    def __post_init__(self) -> None:
        for name in ("down_below", "half_room"):
            check_number(name, getattr(self, name), minimum=0.0)

    @classmethod
    def of(cls, scene: TrapperScene) -> Self:
        """The maneuver with the box and the ball of ``scene``."""
        return cls(down_below=scene.ball_radius, half_room=metres(scene.box_half_width - scene.ball_radius + 0.005))

    def __call__(self, plan: Plan, observation: Observation, holds: Tensor, state: NoState) -> tuple[Tensor, NoState]:
        """The plan's goal, or the place where the box is."""
        tool_pos, target_pos = observation.tool_pos, observation.target_pos
        away = (target_pos - tool_pos)[..., :2].abs().amax(-1)
        kept = (away <= self.half_room) & (tool_pos[..., 2] < self.down_below) & (target_pos[..., 2] > 0.0)
        here = torch.cat([tool_pos[..., :2], target_pos[..., 2:]], dim=-1)
        return torch.where(kept.unsqueeze(-1), here, plan.goal), state
