"""When a ball is covered by the box, touched by it, or swallowed by a pocket: functions of positions alone."""

import torch
from torch import Tensor

from torchdyn_plan.envs.trapper.scene import TrapperScene

SLACK = 0.002
"""How far contacts may give under load [m]."""


def is_covered(scene: TrapperScene, tool_pos: Tensor, tool_rotation: Tensor, ball_pos: Tensor) -> Tensor:
    """Whether the ball is inside the box's walls with the rim below the ball's centre all round, so it cannot leave.

    Args:
        scene: sizes of box and ball.
        tool_pos: ``(*B, 3)`` centre of the box mouth [m, world].
        tool_rotation: ``(*B, 3, 3)``, columns are the box's axes in the world.
        ball_pos: ``(*B, 3)`` [m, world].

    Returns:
        ``(*B,)`` bool.
    """
    offset, tilt = _in_box(scene, tool_pos, tool_rotation, ball_pos)
    room = scene.box_half_width - scene.ball_radius + SLACK
    return (offset <= room) & (tool_pos[..., 2] + tilt <= scene.ball_radius) & (ball_pos[..., 2] > 0.0)


def is_in_the_way(scene: TrapperScene, tool_pos: Tensor, tool_rotation: Tensor, ball_pos: Tensor) -> Tensor:
    """Whether the rim is below the top of a ball that is not wholly within the walls, so that the two would touch.

    Arguments and shape as for `is_covered`.
    """
    offset, tilt = _in_box(scene, tool_pos, tool_rotation, ball_pos)
    low = tool_pos[..., 2] - tilt < ball_pos[..., 2] + scene.ball_radius
    room = scene.box_half_width - scene.ball_radius + SLACK
    return low & (offset > room) & (offset < scene.box_outer + scene.ball_radius + SLACK)


def _in_box(scene: TrapperScene, tool_pos: Tensor, tool_rotation: Tensor, ball_pos: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of the ball from the box's middle along its axes, and how far the rim hangs down, ``(*B,)`` [m]."""
    offset = ((ball_pos - tool_pos).unsqueeze(-2) @ tool_rotation).squeeze(-2)
    return offset[..., :2].abs().amax(-1), tool_rotation[..., 2, :2].abs().sum(-1) * scene.box_outer


def is_touched(scene: TrapperScene, tool_pos: Tensor, ball_pos: Tensor) -> Tensor:
    """Whether the box, near the table, is against the ball from outside or stands on it: ``(*B,)`` bool."""
    offset = (ball_pos - tool_pos)[..., :2].abs().amax(-1)
    low = tool_pos[..., 2] < 2 * scene.ball_radius
    room = scene.box_half_width - scene.ball_radius + SLACK
    return low & (offset > room) & (offset < scene.box_outer + scene.ball_radius + SLACK)


def is_pocketed(scene: TrapperScene, ball_pos: Tensor) -> Tensor:
    """Whether the ball has sunk a whole diameter below the table: ``(*B,)`` bool."""
    return ball_pos[..., 2] < -scene.ball_radius


def is_reached(scene: TrapperScene, tool_pos: Tensor, goal: Tensor) -> Tensor:
    """Whether an upright box has arrived at ``goal``: (*B,) bool.

    A goal on the table is reached when a ball there would be covered; one above it, within 15 mm.
    """
    offset = tool_pos - goal
    room = scene.box_half_width - scene.ball_radius + SLACK
    covered = (offset[..., :2].abs().amax(-1) <= room) & (tool_pos[..., 2] <= scene.ball_radius)
    on_table = goal[..., 2] <= scene.goal_on_table_below
    return torch.where(on_table, covered, offset.norm(dim=-1) <= 0.015)
