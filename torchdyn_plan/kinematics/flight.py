"""The flight of a point that falls and is slowed down by the air, in a few fixed steps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

LONGEST = 0.05
"""A step of the integration is no longer than this [s]."""
TINY = 1e-12
"""Below this the square of a speed is taken for none: its root would have no derivative."""


def fly(
    place: Tensor, velocity: Tensor, *, step: float, count: int, gravity: Sequence[float], drag: float | Tensor = 0.0
) -> tuple[Tensor, Tensor]:
    """Positions and velocities ``(*B, count, D)`` [m, m/s] after ``step``, 2 ``step`` … [s]; differentiable.

    Solves v' = g - k |v| v by Runge and Kutta's method of fourth order, in steps of at most `LONGEST` seconds. Between
    them the path is the cubic through positions and velocities at both ends (Hermite). For a tennis ball it is exact
    to a micrometre; steps must be short against 1 / k |v|.

    Args:
        place: ``(*B, D)`` now [m].
        velocity: ``(*B, D)`` now [m/s].
        step: time between two moments [s].
        count: of the moments.
        gravity: g, D numbers [m/s²].
        drag: k, deceleration over speed squared [1/m]: ½ ρ C A / m of a ball with area A and mass m; a number, or
            ``(*B, 1)``.
    """
    steps = max(math.ceil(step * count / LONGEST - 1e-9), 1)
    length, falls = step * count / steps, place.new_tensor(gravity)
    places, velocities = [place], [velocity]
    for _ in range(steps):
        moved, changed = _advance(velocities[-1], length, falls, drag)
        places.append(places[-1] + moved)
        velocities.append(velocities[-1] + changed)
    return _between(torch.stack(places, -2), torch.stack(velocities, -2), length, step, count)


def braked(velocity: Tensor, gravity: Tensor, drag: float | Tensor) -> Tensor:
    """The acceleration g - k |v| v at ``velocity`` (*B, D), with g (D,): ``(*B, D)`` [m/s²]."""
    speed = velocity.square().sum(-1, keepdim=True).clamp_min(TINY).sqrt()
    return gravity - drag * speed * velocity


def _advance(velocity: Tensor, length: float, gravity: Tensor, drag: float | Tensor) -> tuple[Tensor, Tensor]:
    """What a step of ``length`` [s] adds to place and ``velocity`` (*B, D): Nyström's form, as places do not matter."""
    first = braked(velocity, gravity, drag)
    second = braked(velocity + 0.5 * length * first, gravity, drag)
    third = braked(velocity + 0.5 * length * second, gravity, drag)
    fourth = braked(velocity + length * third, gravity, drag)
    moved = length * velocity + length**2 / 6.0 * (first + second + third)
    return moved, length / 6.0 * (first + 2.0 * (second + third) + fourth)


def _between(places: Tensor, velocities: Tensor, length: float, step: float, count: int) -> tuple[Tensor, Tensor]:
    """Places and velocities at ``count`` moments, from those ``(*B, S, D)`` at the ends of steps of ``length`` [s]."""
    moment = step / length * torch.arange(1, count + 1, dtype=places.dtype, device=places.device)
    index = moment.long().clamp(max=places.shape[-2] - 2)
    s = (moment - index).unsqueeze(-1)
    start, end = places[..., index, :], places[..., index + 1, :]
    out, into = length * velocities[..., index, :], length * velocities[..., index + 1, :]
    way = end - start
    square, cube = 3.0 * way - 2.0 * out - into, out + into - 2.0 * way
    return start + s * (out + s * (square + s * cube)), (out + s * (2.0 * square + 3.0 * s * cube)) / length
