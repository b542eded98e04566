"""Time that joints need to come to rest at a position within speed and acceleration limits, in closed form."""

import torch
from torch import Tensor

TINY = 1e-12
"""Squares below this count as 0, because their root would have no finite derivative."""


def travel_time(offset: Tensor, velocity: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """Least time to stop ``offset`` away; each joint on its own, differentiable [s].

    The distance left after braking at once gives a joint's direction: it accelerates to its peak speed, cruises at the
    limit if it reaches it, and brakes at the end. The peak follows from v² = a·d + u²/2, with distance d and present
    speed u in that direction. A lower peak gives any longer time, so joints can arrive together with the slowest.

    Args:
        offset: ``(*B, N)`` distance to go [rad; m].
        velocity: ``(*B, N)`` now [rad/s; m/s].
        speed: ``(N,)`` limits, positive.
        acceleration: ``(N,)`` limits, positive.

    Returns:
        ``(*B, N)`` [s].
    """
    # Distance in which a joint stops if it brakes at once.
    left = offset - velocity * velocity.abs() * (0.5 / acceleration)
    heading = torch.where(left < 0.0, -1.0, 1.0)
    way, now = offset * heading, velocity * heading
    half_square = 0.5 * now.square()
    peak = (acceleration * way + half_square).clamp_min(TINY).sqrt().minimum(speed)
    changes = (peak - now).abs() + peak
    # A joint that is too fast brakes to its limit first, and on to rest.
    ramps = torch.where(now > speed, half_square, peak.square() - half_square) / acceleration
    return changes / acceleration + (way - ramps).clamp_min(0.0) / speed


def arrival_time(offset: Tensor, velocity: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """Least time until all joints have arrived, ``(*B,)`` [s]; for the arguments see `travel_time`."""
    return travel_time(offset, velocity, speed, acceleration).amax(-1)
