"""How the box comes to its goal: where the tool is sent, and which way it goes from where it is.

The functions here take coordinates one by one, so that a compiler can fuse them into the loop around them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number

LIFT_MARGIN = 0.02
"""This far below the clear height the box stands still sideways [m]."""
DROP_MARGIN = 0.015
"""Over this distance the height of the approach goes from down to travel [m]."""
QUARTER_TURN = math.pi / 2


@dataclass(frozen=True, kw_only=True)
class Approach:
    """How goals become tool positions: where the table is, how high to travel, where the box may stand."""

    base_pos: tuple[float, float, float] = (0.0, -0.855, 0.05)
    """Position of the arm's base frame in the world, axes parallel [m]."""
    tool_length: float = 0.084
    """Distance of the box mouth from the flange [m]."""
    table_height: float = 0.052
    """Goals at or below this height are on the table: the box is dropped over them [m]."""
    down_height: float = 0.006
    """Height of the box mouth when it is down [m]."""
    travel_height: float = 0.099
    """Height of the box mouth on its way to a goal on the table, above the ball [m]."""
    clear_height: float = 0.089
    """Below this the box slows sideways as it lifts, and 2 cm below it stands still sideways [m]."""
    drop_distance: float = 0.045
    """Horizontal distance from the goal within which the box drops [m]."""
    half_extent: float = 0.722
    """The tool's place is clamped to the square of this half-side, which keeps the box clear of the rails [m]."""
    min_radius: float = 0.1
    """The tool keeps at least this distance from the arm's vertical axis [m]."""
    max_radius: float = 0.91
    """The tool keeps at most this distance from the arm's vertical axis [m]."""

    def __post_init__(self) -> None:
        for name in ("tool_length", "down_height", "travel_height", "drop_distance", "half_extent", "max_radius"):
            check_number(name, getattr(self, name), minimum=0.0)


def tool_target(goal: Sequence[Tensor], approach: Approach) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Place x, y [m, base frame] and height [m, world] of the box mouth for a goal x, y, z [m, world].

    The fourth value says whether the goal is on the table.
    """
    x, y, height = goal
    (base_x, base_y, _), half = approach.base_pos, approach.half_extent
    x, y = x.clamp(-half, half) - base_x, y.clamp(-half, half) - base_y
    radius = torch.hypot(x, y).clamp_min(1e-6)
    scale = radius.clamp(approach.min_radius, approach.max_radius) / radius
    x, y = (x * scale).clamp(-half - base_x, half - base_x), (y * scale).clamp(-half - base_y, half - base_y)
    on_table = height <= approach.table_height
    return x, y, torch.where(on_table, approach.down_height, height), on_table


def within_reach(goal: Tensor, approach: Approach) -> Tensor:
    """``goal`` (*B, 3) [m, world], or the nearest place to it where the tool can be, at the same height."""
    x, y, _, _ = tool_target(goal.unbind(-1), approach)
    base_x, base_y, _ = approach.base_pos
    return torch.stack([x + base_x, y + base_y, goal[..., 2]], dim=-1)


def way_to(
    tool: Sequence[Tensor], target: Sequence[Tensor], on_table: Tensor, approach: Approach
) -> tuple[Tensor, Tensor, Tensor]:
    """Displacement that a tool has still to make, x, y, z [m], as a velocity direction where it is.

    Sideways the way is taken in polar coordinates about the arm's axis (out of its own way, pan and reach at once).
    A goal on the table is approached at the travel height; the box drops within the drop distance, and a box more
    than 2 cm below the clear height lifts before it moves.

    Args:
        tool: place x, y [m, base frame] and height [m, world].
        target: place x, y [m, base frame] and height [m, world].
        on_table: whether the goal is.
        approach: heights and distances.
    """
    (x, y, height), (goal_x, goal_y, goal_height) = tool, target
    away = torch.hypot(goal_x - x, goal_y - y)
    forward = torch.hypot(goal_x, goal_y) / torch.hypot(x, y).clamp_min(1e-6) - 1.0
    turn = torch.atan2(x * goal_y - y * goal_x, x * goal_x + y * goal_y)
    far = ((away - approach.drop_distance) * (1.0 / DROP_MARGIN)).clamp(0.0, 1.0)
    lift = torch.where(on_table, far, 0.0) * (approach.travel_height - approach.down_height)
    low = torch.where(on_table, far, 1.0) * (approach.clear_height - height) * (1.0 / LIFT_MARGIN)
    free = 1.0 - low.clamp(0.0, 1.0)
    side_x, side_y = x * forward - y * turn, y * forward + x * turn
    return side_x * free, side_y * free, goal_height + lift - height


def square_turn(x: Tensor, y: Tensor) -> Tensor:
    """Turn about z [rad] to the nearest world axis of a square box, whose x axis shows along (x, y)."""
    yaw = torch.atan2(y, x)
    return torch.round(yaw * (1.0 / QUARTER_TURN)) * QUARTER_TURN - yaw
