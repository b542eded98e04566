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

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene

GIVE = 0.005
"""How far beyond the room that the box leaves it a ball may be and still be in the box: walls give [m]."""


def is_caught(tool_pos: Tensor, target_pos: Tensor, *, radius: float, half_width: float) -> Tensor:
    """Whether a box is down over the ball, as a planner sees it: ``(*B,)`` bool.

    Args:
        tool_pos: ``(*B, 3)`` centre of the box mouth [m, world].
        target_pos: ``(*B, 3)`` centre of the ball [m, world].
        radius: of the ball: a box whose rim is lower than that is down [m].
        half_width: inner, of the box [m].
    """
    away = (target_pos - tool_pos)[..., :2].abs().amax(-1)
    return (away <= half_width - radius + GIVE) & (tool_pos[..., 2] < radius) & (target_pos[..., 2] > 0.0)


@dataclass(frozen=True, kw_only=True)
class GoToAndKeep(GoTo):
    """Goes to the meeting place; a box that is down over the ball stays down, wherever the plan's meeting is.

    A fast and heavy ball pushes the box along by a decimetre. A planner that lifted it then, to go to its next meeting,
    would let out the ball that it has.
    """

    radius: float
    """Radius of the ball [m]."""
    half_width: float
    """Inner half-width of the box [m]."""

    def __post_init__(self) -> None:
        for name in ("radius", "half_width"):
            check_number(name, getattr(self, name), minimum=0.0)

    @classmethod
    def of(cls, scene: TrapperScene) -> Self:
        """The maneuver with the box and the ball of ``scene``."""
        return cls(radius=scene.ball_radius, half_width=scene.box_half_width)

    def __call__(self, plan: Plan, observation: Observation, holds: Tensor, state: NoState) -> tuple[Tensor, NoState]:
        """The plan's goal, or the place where the box is."""
        tool_pos, target_pos = observation.tool_pos, observation.target_pos
        caught = is_caught(tool_pos, target_pos, radius=self.radius, half_width=self.half_width)
        here = torch.cat([tool_pos[..., :2], target_pos[..., 2:]], dim=-1)
        return torch.where(caught.unsqueeze(-1), here, plan.goal), state
