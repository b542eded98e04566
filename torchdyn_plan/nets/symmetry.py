"""The eight symmetries of a square table, as matrices that map any motion into one octant."""

import torch
from torch import Tensor


def square_symmetries() -> Tensor:
    """The group D4 acting on x and y, ``(8, 3, 3)`` float32; entry 4·swap + 2·(y < 0) + (x < 0) of `octant`."""
    swap = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    flips = [torch.diag(torch.tensor([x, y, 1.0])) for y in (1.0, -1.0) for x in (1.0, -1.0)]
    return torch.stack(flips + [flip @ swap for flip in flips])


def octant(direction: Tensor) -> Tensor:
    """Which of the eight symmetries maps ``direction`` into the octant x ≥ y ≥ 0.

    Args:
        direction: ``(*B, 2)``; rows are multiplied by the symmetry from the right: ``direction @ symmetry``.

    Returns:
        ``(*B,)`` int64 index into `square_symmetries`.
    """
    left, below = (direction < 0).long().unbind(-1)
    x, y = direction.abs().unbind(-1)
    return torch.add(torch.add(left, below, alpha=2), (y > x).long(), alpha=4)
