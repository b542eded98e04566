"""Recorded paths as unreflected lines, which run on through cushions: the training target on tables with cushions."""

from typing import NamedTuple

import torch
from torch import Tensor

MARGIN = 0.03
"""Reversals farther than this from a cushion are not bounces off it [m]."""
SLOWEST = 2e-6
"""Steps shorter than this have no direction [m]."""


class Lines(NamedTuple):
    """Unreflected lines of all paths, concatenated, and the map from each sample's stretch of table to its line."""

    track: Tensor
    """(T, 3): horizontal coordinates on the line, and the height [m]."""
    side: Tensor
    """(T, 2): 1 or -1, the direction in which the path follows its line."""
    shift: Tensor
    """(T, 2): offset of the sample's stretch of table along the line [m]."""


def unreflect_paths(positions: Tensor, start: Tensor, half_extent: float | None) -> Lines:
    """Mirror each path at each of its bounces, so that it runs on as one line.

    At a bounce a coordinate changes from approaching the nearest cushion to leaving it; contact with a soft cushion
    counts once, however long it lasts. Coordinates beyond a cushion, also of a lost target, count as on it.

    Args:
        positions: ``(T, 3)`` [m, world], one per control step, paths concatenated.
        start: ``(E,)`` index of each path's first sample, ascending from 0.
        half_extent: where the target's centre turns back, |x| or |y| [m]; None leaves paths as they are.

    Returns:
        `Lines`, equal to each path until its first bounce.
    """
    level = positions[:, :2]
    if half_extent is None:
        return Lines(positions, torch.ones_like(level), torch.zeros_like(level))
    bounced = _bounces(level, start, half_extent)
    # Bounces alternate between the two directions along the line, counted from the start of each path.
    count = bounced.to(torch.int32).cumsum(0, dtype=torch.int32)
    lengths = torch.diff(start, append=start.new_tensor([len(positions)]))
    count -= count[start].repeat_interleave(lengths, 0)
    side = 1.0 - 2.0 * (count % 2).to(level.dtype)
    crossing = torch.where(bounced, -side * level.sign(), 0.0).cumsum(0, dtype=torch.float64)
    branch = (crossing - crossing[start].repeat_interleave(lengths, 0)).to(level.dtype)
    shift = 2.0 * half_extent * branch
    line = side * level.clamp(-half_extent, half_extent) + shift
    return Lines(torch.cat([line, positions[:, 2:]], dim=-1), side, shift)


def _bounces(level: Tensor, start: Tensor, half_extent: float) -> Tensor:
    """Samples that are the first to leave a cushion, ``(T, 2)`` bool; never a path's first two."""
    step = torch.nn.functional.pad(level.diff(dim=0), (0, 0, 1, 0))
    step[start] = 0.0
    index = torch.arange(len(level), device=level.device).unsqueeze(-1)
    directed = torch.where(step.abs() > SLOWEST, index, -1)
    latest = directed.cummax(dim=0).values
    before = torch.nn.functional.pad(latest[:-1], (0, 0, 1, 0), value=-1)
    first = torch.zeros_like(index.squeeze(-1))
    first[start] = start
    known = before > first.cummax(dim=0).values.unsqueeze(-1)
    heading = torch.where(known, step.gather(0, before.clamp(min=0)).sign(), 0.0)
    wall = torch.nn.functional.pad(level[:-1], (0, 0, 1, 0))
    near = wall.abs() > half_extent - MARGIN
    inward, outward = heading * wall.sign() > 0, (directed >= 0) & (step * wall.sign() < 0)
    return near & inward & outward
