"""The reward of reaching a goal: one pure function for the environment's step and for hindsight alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.trapper.contact import is_covered, is_in_the_way
from torchdyn_plan.envs.trapper.scene import TrapperScene


@dataclass(frozen=True, kw_only=True)
class GoalReward:
    """What the terms of the reward weigh (paper, Section III-A, Equation 1)."""

    tolerance: float = 0.01
    """A goal is reached within this distance, on the table along each axis sideways [m]."""
    alignment: float = 0.2
    """β at the goal: what an upright box is worth there."""
    alignment_range: float = 0.15
    """Distance from the goal at which β has fallen to a half [m]."""
    touch: float = 4.0
    """Cost of standing where a ball at a goal on the table would be pushed away; 0 for the paper's reward."""

    def __post_init__(self) -> None:
        for name in ("alignment", "touch"):
            check_number(name, getattr(self, name), minimum=0.0)
        for name in ("tolerance", "alignment_range"):
            check_number(name, getattr(self, name), minimum=1e-6)


def goal_reward(
    scene: TrapperScene, weights: GoalReward, tool_pos: Tensor, tool_rotation: Tensor, goal: Tensor
) -> Tensor:
    """1(box == g) + β(d)·R(θ), less the cost of touching a ball at g (paper, Section III-A, Equation 1).

    A goal on the table is reached when a ball there would be covered (`is_covered`) and the box is centred over it
    within the tolerance; one above it by an upright box within the tolerance. θ is the angle between the box mouth's
    normal and the table's, R(θ) = 1 - 2 (θ / 60°)², at least -1, and β(d) = ``alignment`` / (1 + (d /
    ``alignment_range``)²) grows as the box nears the goal.

    Args:
        scene: sizes of box and ball.
        weights: what the terms weigh.
        tool_pos: ``(*B, 3)`` centre of the box mouth [m, world].
        tool_rotation: ``(*B, 3, 3)``, columns are the box's axes in the world; z shows out of the mouth.
        goal: ``(*B, 3)`` [m, world].

    Returns:
        ``(*B, 1)``.
    """
    reached = is_goal_reached(scene, weights, tool_pos, tool_rotation, goal)
    away = (goal - tool_pos).norm(dim=-1)
    tilt = torch.arccos((-tool_rotation[..., 2, 2]).clamp(-1.0, 1.0))
    upright = (1.0 - 2.0 * (tilt / (math.pi / 3)).square()).clamp_min(-1.0)
    near = weights.alignment / (1.0 + (away / weights.alignment_range).square())
    reward = reached + near * upright
    if weights.touch:
        touched = is_in_the_way(scene, tool_pos, tool_rotation, resting_ball(scene, goal))
        reward = reward - weights.touch * (is_on_table(scene, goal) & touched)
    return reward.unsqueeze(-1)


def is_goal_reached(
    scene: TrapperScene, weights: GoalReward, tool_pos: Tensor, tool_rotation: Tensor, goal: Tensor
) -> Tensor:
    """1(box == g) of `goal_reward`, whose arguments these are: ``(*B,)`` bool."""
    away = (goal - tool_pos).norm(dim=-1)
    above = (away <= weights.tolerance) & (tool_rotation[..., 2, 2] < UPRIGHT)
    centred = (goal - tool_pos)[..., :2].abs().amax(-1) <= weights.tolerance
    covered = is_covered(scene, tool_pos, tool_rotation, resting_ball(scene, goal))
    return torch.where(is_on_table(scene, goal), centred & covered, above)


UPRIGHT = -math.cos(math.radians(15.0))
"""A box whose mouth's normal has a vertical part below this is upright enough to wait above the table."""


def is_on_table(scene: TrapperScene, goal: Tensor) -> Tensor:
    """Whether a goal (*B, 3) [m, world] says *be here, box down*: ``(*B,)`` bool."""
    return goal[..., 2] <= scene.goal_on_table_below


def resting_ball(scene: TrapperScene, goal: Tensor) -> Tensor:
    """``goal`` (*B, 3) [m, world] with the height of a ball on the table."""
    return torch.cat([goal[..., :2], torch.full_like(goal[..., 2:], scene.ball_radius)], dim=-1)
