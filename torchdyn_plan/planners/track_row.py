"""The usual update of a track of one target in Python numbers: for so few, each tensor operation is mostly overhead."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable

import torch
from torch import Tensor

LARGEST_EXPONENT = 700.0
"""Python's exponential of more is an error."""
CODES = {torch.float32: "f", torch.float64: "d"}
"""What arrays call the types of tensors."""


def numbers_of(row: Tensor) -> list[float]:
    """The numbers of a tensor (1, …, 1, D)."""
    found = row.tolist()
    while isinstance(found[0], list):
        found = found[0]
    return found


def row_of(numbers: list[float], like: Tensor) -> Tensor:
    """A tensor of ``numbers`` with the shape and type of ``like`` on the CPU."""
    code = CODES.get(like.dtype)
    if code is None:
        return like.new_tensor(numbers).view_as(like)
    # A third of the time that a tensor of a list takes.
    return torch.frombuffer(array(code, numbers), dtype=like.dtype).view_as(like)


def updated_row(
    motion: list[float],
    pos: list[float],
    passed: float,
    variance: float,
    *,
    drift: Iterable[tuple[int, int, int, float]],
    forgets: float,
    gate: float,
) -> list[float] | None:
    """The motion after a measurement that is not late, by the Kalman filter's update; None if it does not fit.

    Args:
        motion: Dn + n(n+1)/2 numbers, as in `TrackState`.
        pos: the D coordinates of the measurement [m, world].
        passed: time since the newest earlier measurement, not negative [s].
        variance: of the measurement's error along each axis [m²].
        drift: process noise, entries (i, j, power, factor) that each add factor·passed^power to the covariance.
        forgets: rate at which past measurements are forgotten [1/s].
        gate: a measurement fits if it is within this many standard deviations along each axis.
    """
    size = len(pos)
    place, velocity = motion[:size], motion[size : 2 * size]
    place = [here + passed * speed for here, speed in zip(place, velocity, strict=True)]
    if len(motion) == 2 * size + 3:
        triangle, further = _spread_pair(motion[2 * size :], passed), None
    else:
        triangle, further = _spread_triple(motion[3 * size :], passed), motion[2 * size : 3 * size]
        place = [here + 0.5 * passed * passed * change for here, change in zip(place, further, strict=True)]
        velocity = [speed + passed * change for speed, change in zip(velocity, further, strict=True)]
    if forgets:
        weaker = math.exp(forgets * passed) if forgets * passed < LARGEST_EXPONENT else math.inf
        triangle = [entry * weaker for entry in triangle]
    for i, j, power, factor in drift:
        # Where the triangle has entry (i, j), row by row: only the second and third row are shorter than the first.
        triangle[i + j + (i > 0 and further is not None)] += factor * passed**power
    scale, innovation = triangle[0] + variance, [seen - here for seen, here in zip(pos, place, strict=True)]
    farthest = scale * gate**2
    # Comparisons are false for what is no number.
    if not 0.0 < scale < math.inf:
        return None
    for off in innovation:
        if not off * off <= farthest:
            return None
    if further is None:
        own, both, rate = triangle
        a, b = own / scale, both / scale
        means, covariances = ((place, a), (velocity, b)), (own - a * own, both - a * both, rate - b * both)
    else:
        own, both, last, rate, cross, rest = triangle
        a, b, c = own / scale, both / scale, last / scale
        means = (place, a), (velocity, b), (further, c)
        covariances = (
            own - a * own,
            both - a * both,
            last - a * last,
            rate - b * both,
            cross - b * last,
            rest - c * last,
        )
    found = [entry + gain * off for mean, gain in means for entry, off in zip(mean, innovation, strict=True)]
    found += covariances
    return found


def _spread_pair(triangle: list[float], passed: float) -> list[float]:
    """The upper triangle of F P Fᵀ, with F of a chain of two integrators."""
    own, both, rate = triangle
    return [own + passed * (2.0 * both + passed * rate), both + passed * rate, rate]


def _spread_triple(triangle: list[float], passed: float) -> list[float]:
    """The same of three integrators."""
    own, both, last, rate, cross, rest = triangle
    half = 0.5 * passed * passed
    own, both, last = own + passed * both + half * last, both + passed * rate + half * cross, last + passed * cross
    last += half * rest
    rate, cross = rate + passed * cross, cross + passed * rest
    return [own + passed * both + half * last, both + passed * last, last, rate + passed * cross, cross, rest]
