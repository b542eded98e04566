"""Static planner for a velocity-controlled point with limited speed and acceleration: a mobile base, a drone."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_points, check_trailing_shape
from torchdyn_plan.nets.point_arrival import PointArrival
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.static.base import StaticPlannerModule

NEAR = 1e-9
"""Closer to its goal than this, a point has no direction to move in [m]."""
FADE = 0.25
"""Share of the last remaining distance that is covered in a control step."""


class PointPlanner(StaticPlannerModule):
    """Moves a point straight to ``goal`` as fast as allowed; ``action`` is velocity as a fraction of the speed limit.

    Reads ``tool_pos`` (*B, D) and ``goal`` (*B, D) [m, world], writes ``action`` (*B, D) of norm 0 to 1. It brakes
    within its acceleration limit, and has no memory.
    """

    def __init__(
        self, *, speed: float, acceleration: float, control_step: float, stops: bool = True, radius: float = 0.0
    ) -> None:
        """Move with at most ``speed``; for the arguments see `torchdyn_plan.nets.PointArrival`."""
        super().__init__()
        self.limits = PointArrival(
            speed=speed, acceleration=acceleration, control_step=control_step, stops=stops, radius=radius
        )
        self.in_keys = [keys.TOOL_POS, keys.GOAL]
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; raises `InputError` where a key is missing, a shape is wrong or the goal holds a NaN."""
        tool_pos, goal = (read(tensordict, key, "PointPlanner") for key in self.in_keys)
        check_trailing_shape(keys.GOAL, goal, check_points(keys.TOOL_POS, tool_pos))
        check_finite(keys.GOAL, goal)
        offset, limits = goal - tool_pos, self.limits
        far = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        fastest = torch.full_like(far, limits.speed).masked_fill(far <= NEAR, 0.0)
        if limits.stops:
            # Braking starts a step after the observation: v²/2a + v dt + a dt²/2 ≤ way. The last bit fades out.
            braked = limits.acceleration * limits.control_step
            fading = FADE * (far / limits.control_step).clamp(max=braked)
            fastest = fastest.minimum(((2.0 * limits.acceleration * far).sqrt() - braked).maximum(fading))
        tensordict.set(keys.ACTION, offset / far.clamp_min(NEAR) * (fastest / limits.speed))
        return tensordict

    def arrival_model(self) -> PointArrival:
        """Model of its arrival times; ``robot_state`` must begin with position and velocity."""
        return self.limits

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        return self.limits.part_settings()
