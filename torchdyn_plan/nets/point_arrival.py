"""Arrival times of a point with limits on speed and acceleration, without training or simulation."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number, check_points
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.timing import TINY, travel_time
from torchdyn_plan.nets.arrival import ArrivalModel
from torchdyn_plan.nets.distributions import Arrival
from torchdyn_plan.precision import at_least_float32


class PointArrival(ArrivalModel):
    """Arrival of a point that turns its velocity towards the goal as fast as it can: a base, a drone, a gantry.

    The norms of speed and acceleration are limited. From rest, or when already moving towards the goal, the time is
    optimal; with velocity across the way it is approximately that of a `torchdyn_plan.planners.PointPlanner`.
    """

    def __init__(
        self, *, speed: float, acceleration: float, control_step: float, stops: bool = True, radius: float = 0.0
    ) -> None:
        """Move with at most ``speed`` [m/s] and ``acceleration`` [m/s²].

        Args:
            speed: as above.
            acceleration: as above.
            control_step: time between two control steps [s].
            stops: whether it comes to rest at the goal, or passes through at speed.
            radius: distance from the goal within which it has arrived [m]; if it stops, it must also be at rest.
        """
        super().__init__()
        for name, value in (("speed", speed), ("acceleration", acceleration), ("control_step", control_step)):
            check_number(name, value, minimum=1e-9)
        check_number("radius", radius, minimum=0.0)
        self.speed, self.acceleration, self.control_step = speed, acceleration, control_step
        self.stops, self.radius = stops, radius

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival ``(*B, K)`` at goals (*B, K, D) [m, world], with any estimator; every goal is reachable.

        ``robot_state`` (*B, 1, S) begins with the point's position [m] and velocity [m/s], D numbers each.
        """
        size = check_points("goal", goal)
        if robot_state.shape[-1] < 2 * size:
            raise InputError(
                f"robot_state must begin with position and velocity, {2 * size} numbers, got {robot_state.shape[-1]}"
            )
        goal = at_least_float32(goal)
        place, velocity = robot_state.to(goal.dtype)[..., : 2 * size].split(size, dim=-1)
        seconds = self.seconds(goal - place, velocity)
        return Arrival(seconds / self.control_step, torch.zeros_like(seconds, dtype=torch.bool))

    def seconds(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Time ``(*B,)`` [s] to a goal ``offset`` (*B, D) [m] away, with present ``velocity`` (*B, D) [m/s]."""
        square = offset.square().sum(-1, keepdim=True)
        far = square.clamp_min(TINY).sqrt()
        heading, way = offset / far, (far - self.radius).clamp_min(0.0)
        along = (velocity * heading).sum(-1, keepdim=True)
        if self.stops:
            limits = [offset.new_tensor([limit]) for limit in (self.speed, self.acceleration)]
            across = (velocity - along * heading).square().sum(-1).clamp_min(TINY).sqrt()
            found = torch.maximum(travel_time(way, along, *limits).squeeze(-1), across / self.acceleration)
        else:
            found = self._passing(way, heading, velocity, along).squeeze(-1)
        return torch.where(square.squeeze(-1) <= self.radius**2, 0.0, found)

    def _passing(self, way: Tensor, heading: Tensor, velocity: Tensor, along: Tensor) -> Tensor:
        """Time ``(*B, 1)`` [s] to pass a goal ``way`` (*B, 1) [m] away, at any speed.

        The velocity u becomes v, towards the goal, in the time T = |v - u| / a, over the distance T (u + v) / 2; the
        rest is covered at full speed. If it passes earlier, way = u t + b t² / 2 with b the acceleration along the way.
        """
        wanted = self.speed * heading
        change = (wanted - velocity).square().sum(-1, keepdim=True).clamp_min(TINY).sqrt()
        turning = change / self.acceleration
        left = way * heading - 0.5 * turning * (velocity + wanted)
        cruising = turning + left.square().sum(-1, keepdim=True).clamp_min(TINY).sqrt() / self.speed
        gained = self.acceleration * (self.speed - along) / change
        root = (along.square() + 2.0 * gained * way).clamp_min(TINY).sqrt()
        # This form of the root also holds for b = 0.
        early = 2.0 * way / (along + root).clamp_min(TINY)
        return torch.where((left * heading).sum(-1, keepdim=True) > 0.0, cruising, early)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        names = ("speed", "acceleration", "control_step", "stops", "radius")
        return {name: getattr(self, name) for name in names}
