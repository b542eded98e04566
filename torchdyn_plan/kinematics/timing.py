"""How long joints take to be somewhere, at rest, within limits of speed and acceleration: in closed form."""

import torch
from torch import Tensor

TINY = 1e-12
"""Below this a square is taken for none: its root would have no derivative."""


def travel_time(offset: Tensor, velocity: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """Least time to stop ``offset`` away; each joint on its own, differentiable [s].

    From where a joint would stop if it braked at once, the way that is left says in which direction it goes: it
    changes to its peak speed at full acceleration, keeps to the limit if it gets there, and brakes at the end. The
    peak follows from v² = a·d + u²/2, with way d and present speed u in that direction. Every longer time can be had
    by a lower peak, so that joints arrive together with the slowest.

    Args:
        offset: ``(*B, N)`` way to go [rad; m].
        velocity: ``(*B, N)`` now [rad/s; m/s].
        speed: ``(N,)`` limits, positive.
        acceleration: ``(N,)`` limits, positive.

    Returns:
        ``(*B, N)`` [s].
    """
    # Braking at once, a joint stops this far away.
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
    """Least time until all joints are there, ``(*B,)`` [s]; arguments as of `travel_time`."""
    return travel_time(offset, velocity, speed, acceleration).amax(-1)
