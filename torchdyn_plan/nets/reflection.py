"""A path between parallel cushions: a continuous line, mirrored at each of them."""

import torch
from torch import Tensor


def reflect(line: Tensor, half_extent: float) -> Tensor:
    """Reflect a path that runs on through the cushions back onto the table: a triangle wave of period 4L.

    Args:
        line: ``(*B,)`` coordinates along one axis, any value [m].
        half_extent: L, where the path is mirrored: at -L and L [m].

    Returns:
        ``(*B,)`` coordinates within [-L, L] [m]; an odd function (up to rounding) with slope 1 or -1.
    """
    period = 4 * half_extent
    return half_extent - (torch.remainder(line + half_extent, period) - period / 2).abs()
