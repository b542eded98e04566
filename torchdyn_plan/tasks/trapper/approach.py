"""How the box comes to its goal: from above, upright and square, clear of rails and ball."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.kinematics.dls import square_turn

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene


def metres(value: float) -> float:
    """A length without the last digits that sums of decimal fractions leave behind [m]."""
    return round(value, 9)


@dataclass(frozen=True, kw_only=True)
class BoxApproach:
    """How goals become places of the box mouth: where the table is, how high to travel, where the box may stand.

    Goals outside the table or the arm's reach are brought to a near place inside.
    """

    base_pos: tuple[float, float, float]
    """Position of the arm's base frame in the world, axes parallel [m]."""
    on_table_below: float
    """Goals at or below this height are on the table: the box is dropped over them [m]."""
    travel_height: float
    """Height of the box mouth on its way to a goal on the table, above the ball [m]."""
    clear_height: float
    """Below this the box slows sideways as it lifts [m]."""
    half_extent: float
    """The tool's place is clamped to the square of this half-side, which keeps the box clear of the rails [m]."""
    down_height: float = 0.006
    """Height of the box mouth when it is down [m]."""
    drop_distance: float = 0.045
    """Horizontal distance from the goal within which the box drops [m]."""
    drop_margin: float = 0.015
    """Over this distance the height of the approach goes from down to travel [m]."""
    lift_margin: float = 0.02
    """This far below the clear height the box stands still sideways [m]."""
    min_radius: float = 0.1
    """The tool keeps at least this distance from the arm's vertical axis [m]."""
    max_radius: float = 0.91
    """The tool keeps at most this distance from the arm's vertical axis [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_pos", tuple(self.base_pos))
        for name in ("travel_height", "down_height", "drop_distance", "half_extent", "min_radius", "max_radius"):
            check_number(name, getattr(self, name), minimum=0.0)
        for name in ("drop_margin", "lift_margin"):
            check_number(name, getattr(self, name), minimum=1e-9)

    @classmethod
    def of(cls, scene: TrapperScene) -> Self:
        """The approach for the box, the ball, the table and the arm of ``scene``."""
        ball = 2 * scene.ball_radius
        return cls(
            base_pos=(scene.base_pos[0], metres(scene.base_pos[1]), metres(scene.base_pos[2])),
            on_table_below=metres(scene.goal_on_table_below),
            travel_height=metres(ball + 0.015),
            clear_height=metres(ball + 0.005),
            half_extent=metres(scene.half_side - scene.box_outer - 0.004),
        )

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The way still to go, and the turn that makes the box upright and square: six rows, see `Approach.twist`.

        Sideways the way is taken in polar coordinates about the arm's axis (out of its own way, pan and reach at once).
        A goal on the table is approached at the travel height; the box drops within the drop distance, and a box far
        below the clear height lifts before it moves.
        """
        x, y, height = pose[3], pose[7], pose[11] + self.base_pos[2]
        goal_x, goal_y, goal_height, on_table = self._place(goal)
        away = torch.hypot(goal_x - x, goal_y - y)
        forward = torch.hypot(goal_x, goal_y) / torch.hypot(x, y).clamp_min(1e-6) - 1.0
        turn = torch.atan2(x * goal_y - y * goal_x, x * goal_x + y * goal_y)
        far = ((away - self.drop_distance) * (1.0 / self.drop_margin)).clamp(0.0, 1.0)
        lift = torch.where(on_table, far, 0.0) * (self.travel_height - self.down_height)
        low = torch.where(on_table, far, 1.0) * (self.clear_height - height) * (1.0 / self.lift_margin)
        free = 1.0 - low.clamp(0.0, 1.0)
        way_x, way_y = (x * forward - y * turn) * free, (y * forward + x * turn) * free
        # Straight down is the tilt z_tool × (-z), for small angles.
        return [way_x, way_y, goal_height + lift - height, -pose[6], pose[2], square_turn(pose[0], pose[4])]

    def within_reach(self, goal: Tensor) -> Tensor:
        """``goal`` (*B, 3) [m, world], or the nearest place to it where the tool can be, at the same height."""
        x, y, _, _ = self._place(goal.unbind(-1))
        base_x, base_y, _ = self.base_pos
        return torch.stack([x + base_x, y + base_y, goal[..., 2]], dim=-1)

    def _place(self, goal: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The box mouth's x, y [m, base frame] and height [m, world] for a goal, and whether that is on the table."""
        x, y, height = goal
        (base_x, base_y, _), half = self.base_pos, self.half_extent
        x, y = x.clamp(-half, half) - base_x, y.clamp(-half, half) - base_y
        radius = torch.hypot(x, y).clamp_min(1e-6)
        scale = radius.clamp(self.min_radius, self.max_radius) / radius
        x = (x * scale).clamp(-half - base_x, half - base_x)
        y = (y * scale).clamp(-half - base_y, half - base_y)
        on_table = height <= self.on_table_below
        return x, y, torch.where(on_table, self.down_height, height), on_table
