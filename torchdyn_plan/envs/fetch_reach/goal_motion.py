"""How a goal moves in front of a gripper: a pure function of an episode's start and of how often it has moved."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.envs.episodes import draw_uniform

MOTIONS = ("straight", "circle", "random")
"""Straight along +x and the circle are DHER's; random is straight in any level direction."""
HEIGHT = 0.5
"""Moving goals stay at this height [m]."""
CENTRE, CENTRE_RANGE, RADIUS = (0.8, 0.5), 0.05, 0.1
"""Circles: middle of their centres, how far a centre is off it along either axis, and their radius [m]."""


class GoalStarts(NamedTuple):
    """How the goals of M episodes start; float64."""

    place: Tensor
    """``(M, 3)``: where a goal on a line is before its first step, or its circle's centre [m, world]."""
    angle: Tensor
    """``(M,)``: direction of a line from +x, or where on its circle a goal is, from +y towards +x [rad]."""


def draw_goals(
    indices: Tensor, tool_pos: Tensor, *, motion: str, goal_range: float, split: str, seed: int, level: bool = True
) -> GoalStarts:
    """Starts of the episodes ``indices`` (M,).

    Args:
        indices: numbers of episodes.
        tool_pos: ``(3,)`` of the gripper at the start [m, world].
        motion: one of `MOTIONS`.
        goal_range: goals on lines start within this of the gripper, along either axis [m].
        split: family of series of episodes.
        seed: which series.
        level: goals on lines start at `HEIGHT`; else within the range of the gripper in height as well.
    """
    check_choice("motion", motion, MOTIONS)
    drawn = draw_uniform(indices, 4, split=split, seed=seed)
    height = torch.full((len(drawn), 1), HEIGHT, dtype=torch.float64)
    if motion == "circle":
        centre = torch.tensor(CENTRE, dtype=torch.float64) + drawn[:, :2] * CENTRE_RANGE
        return GoalStarts(torch.cat([centre, height], dim=-1), drawn[:, 3] * math.pi)
    place = tool_pos + drawn[:, :3] * goal_range
    if level:
        place = torch.cat([place[:, :2], height], dim=-1)
    angle = drawn[:, 3] * math.pi
    return GoalStarts(place, angle if motion == "random" else torch.zeros_like(angle))


def goal_places(starts: GoalStarts, moves: Tensor, *, motion: str, velocity: float | Tensor) -> Tensor:
    """Where goals are after ``moves`` (M,) steps of ``velocity`` [m per control step, one or (M,)]: ``(M, 3)`` [m].

    DHER gives a circle's velocity as an angle; here it is the length of the arc, as along a line.
    """
    way = moves * velocity
    if motion == "circle":
        turned = starts.angle + way / RADIUS
        offset = RADIUS * torch.stack([turned.sin(), turned.cos(), torch.zeros_like(turned)], dim=-1)
        return starts.place + offset
    direction = torch.stack([starts.angle.cos(), starts.angle.sin(), torch.zeros_like(starts.angle)], dim=-1)
    return starts.place + way.unsqueeze(-1) * direction
